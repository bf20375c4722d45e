"""Desk of a worker process: its name, history and shared page; and the simplest worker."""

import mmap
import os
import random
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, cast, final

from harness.sharing.history import Action, Answer, History, Use, to_line
from harness.sharing.processes import Plan
from motorapi.errors import MotorBusyError
from motorapi.lock_directory import LockDirectory
from motorapi.process_lock import ProcessLock
from motorapi.runtime import Runtime
from motorapi.wall_runtime import WallRuntime

PAGE: Final = struct.Struct("<q")
OVER_AT: Final = 0
INSIDE_AT: Final = 8
_VALUE_AT: Final = 16
_PATIENCE_S: Final = 10.0


@final
class Desk:
    """The equipment of a worker.

    Attributes:
        folder: a private folder of all workers.
        facts: the facts of the plan.
        number, name: identify the worker.
        random: its own random generator.
        history: notes the worker's uses.
    """

    def __init__(self, folder: Path, plan: Plan, number: int, page: mmap.mmap, log: int) -> None:
        self.folder: Final = folder
        self.facts: Final = plan.facts
        self.number: Final = number
        self.name: Final = f"{number}"
        self.random: Final = random.Random(f"{plan.seed}:{number}")
        self.history: Final = History(time.monotonic_ns, self._tell)
        self._page = page
        self._log = log

    def _tell(self, use: Use) -> None:
        os.write(self._log, f"{to_line(use)}\n".encode())

    @property
    def is_over(self) -> bool:
        """True when the worker has to end."""
        return self._read(OVER_AT) != 0

    def note_inside(self, inside: bool) -> None:
        """Note whether this worker has the motor, by its own account."""
        if inside:
            self._write(INSIDE_AT, os.getpid())
        elif self._read(INSIDE_AT) == os.getpid():
            self._write(INSIDE_AT, 0)

    @property
    def value(self) -> int:
        """The number in the shared page, the simplest thing to command."""
        return self._read(_VALUE_AT)

    @value.setter
    def value(self, value: int) -> None:
        self._write(_VALUE_AT, value)

    def fact(self, name: str, otherwise: float) -> float:
        """Return a number of the plan's facts."""
        return float(cast("float", self.facts.get(name, otherwise)))

    def spend(self, time_s: float) -> None:
        """Keep the processor busy for this wall time [s]."""
        until_ns = time.monotonic_ns() + round(time_s * 1e9)
        while time.monotonic_ns() < until_ns:
            pass

    def _read(self, at: int) -> int:
        value: int = PAGE.unpack_from(self._page, at)[0]
        return value

    def _write(self, at: int, value: int) -> None:
        PAGE.pack_into(self._page, at, value)


def work_lock(desk: Desk) -> None:
    """Take a bare lock repeatedly, and command a number in memory while holding it.

    Facts: inside_s, lease_s (0: none), take_over (probability), commands (each time).
    """
    lock = ProcessLock("lock", "the lock", LockDirectory(desk.folder / "locks"))
    runtime = WallRuntime()
    lease_s = desk.fact("lease_s", 0.0) or None
    commands = round(desk.fact("commands", 2))
    turn = 0
    while not desk.is_over:
        turn += 1
        by_force = desk.random.random() < desk.fact("take_over", 0.0)
        take = desk.history.call(desk.name, "lock", Action.TAKE, forced=by_force)

        def wait(runtime: Runtime, done: Callable[[], bool], timeout_s: float | None) -> bool:
            if not by_force:  # noqa: B023 -- of this turn
                take.queued()  # noqa: B023 -- likewise
            return runtime.wait_until(done, timeout_s)

        try:
            hold = lock.acquire(
                runtime, "stress", _PATIENCE_S, wait=wait, lease_s=lease_s, take_over=by_force
            )
        except MotorBusyError:
            take.returned(Answer.REFUSED)
            continue
        take.returned(token=hold.token, forced=hold.was_taken_over)
        desk.note_inside(True)
        for number in range(commands):
            desk.spend(desk.fact("inside_s", 50e-6) / commands)
            _command(desk, lock, turn * 1_000_000 + number * 1000 + desk.number % 1000)
        desk.note_inside(False)
        give = desk.history.call(desk.name, "lock", Action.GIVE)
        is_lost = hold.lost_to is not None
        hold.release()
        can_be_lost = bool(lease_s) or desk.fact("take_over", 0.0) > 0.0
        unsure = Answer.UNKNOWN if can_be_lost else Answer.DONE  # lost after the check
        give.returned(Answer.LOST if is_lost else unsure)


def _command(desk: Desk, lock: ProcessLock, value: int) -> None:
    command = desk.history.call(desk.name, "lock", Action.COMMAND, value=value)
    try:
        lock.begin_write()
    except MotorBusyError:
        command.returned(Answer.LOST)
        return
    desk.value = value
    lock.end_write()
    command.returned()
    read = desk.history.call(desk.name, "lock", Action.READ)
    read.returned(value=desk.value)
