"""Real processes that share motors, some of them killed or paused at random; and what they did.

    outcome = run(Plan(work="my_module:work", seconds=10.0, kill_period_s=0.05))
    print(outcome.table())
    outcome.require_sound()

`run` starts an *arena*, a process of its own. It forks the workers before it has had any lock
itself, kills and pauses them as the plan says, and starts others in their place. A worker is a
function `work(desk: Desk)` named as "module:function"; it goes on until `desk.is_over`, and notes
whatever it does in `desk.history`, in which every use is in a file before it can have an effect: so
that what a killed one did is known, but for its last use, of which it is known what it would have
been. The workers here are `work_lock` below, and those of `harness.sharing.drivers`, which work
motors on a hub or on SocketCAN.

What must hold: the history is that of motors with one owner at a time, first come, first served;
nobody who was overtaken, and no token that does not grow; and it goes on after every death.
"""

import ctypes
import importlib
import json
import mmap
import os
import random
import select
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final, cast, final

from harness.sharing.history import (
    Action,
    Answer,
    History,
    SharingViolated,
    Use,
    ended_by_death,
    from_lines,
    overtaken,
    to_line,
    tokens_that_did_not_grow,
    worst_gap_s,
)
from harness.sharing.linearizability import require_linearizable
from motorapi.errors import MotorBusyError
from motorapi.lock_directory import VARIABLE, LockDirectory
from motorapi.process_lock import ProcessLock
from motorapi.runtime import Runtime
from motorapi.wall_runtime import WallRuntime

_PAGE: Final = struct.Struct("<q")
_OVER_AT: Final = 0
_INSIDE_AT: Final = 8
_VALUE_AT: Final = 16
_PATIENCE_S: Final = 10.0
_GRACE_S: Final = 2.0
_LOOK_S: Final = 0.1
_PR_SET_PDEATHSIG: Final = 1
_ENDED_LATE_S: Final = 30.0


@final
@dataclass(frozen=True, slots=True)
class Plan:
    """What is to happen.

    work: the worker, "module:function".
    facts: what the worker is told.
    plant: "module:function" that breaks something in every worker before it begins, for tests.
    kill_inside, pause_inside: it is done to those that have the motor just then, by their own word.
    """

    work: str = "harness.sharing.processes:work_lock"
    seconds: float = 1.0
    workers: int = 5
    kill_period_s: float = 0.0
    kill_inside: bool = False
    pause_period_s: float = 0.0
    pause_s: float = 0.02
    pause_inside: bool = False
    seed: int = 1
    plant: str = ""
    facts: dict[str, object] = field(default_factory=dict)


@final
@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of it: the uses of all, how often what was done, from when to when."""

    uses: tuple[Use, ...]
    counts: dict[str, int]
    begun_ns: int
    ended_ns: int
    last_kill_ns: int
    complaints: tuple[str, ...]

    @property
    def worst_gap_s(self) -> float:
        """The longest time [s] in which nobody was given the motor."""
        return worst_gap_s(self.uses, self.begun_ns, self.ended_ns)

    @property
    def waits_s(self) -> list[float]:
        """How long each who was given it had waited [s], shortest first."""
        return sorted(
            (use.returned_ns - use.called_ns) / 1e9
            for use in self.uses
            if use.action is Action.TAKE and use.answer is Answer.DONE
        )

    @property
    def taken_after_last_kill(self) -> int:
        """How often somebody was given it after the last one was killed."""
        return sum(
            use.called_ns > self.last_kill_ns
            for use in self.uses
            if use.action is Action.TAKE and use.answer is Answer.DONE
        )

    def reached(self) -> "Counter[str]":
        """How often what was put to the test."""
        reached = Counter(self.counts)
        for use in self.uses:
            forced = " from a living owner" if use.forced and use.token else ""
            reached[f"{use.action.value}: {use.answer.value}{forced}"] += 1
        return reached

    def table(self) -> str:
        """That, and how long it took, for people."""
        waits_s = self.waits_s or [0.0]
        lines = [f"{count:8d}  {name}" for name, count in sorted(self.reached().items())]
        lines.append(f"{self.worst_gap_s * 1e3:8.1f}  ms in which nobody was given it, at most")
        lines.append(f"{waits_s[-1] * 1e3:8.1f}  ms to wait, at most")
        lines.append(f"{waits_s[len(waits_s) * 99 // 100] * 1e3:8.1f}  ms to wait, 99 of 100")
        return "\n".join(lines)

    def require_sound(self) -> None:
        """Raises SharingViolated if it was not as it must be."""
        if self.complaints:
            raise SharingViolated("\n".join(self.complaints))
        for earlier, later in tokens_that_did_not_grow(self.uses):
            raise SharingViolated(f"the token did not grow from\n    {earlier}\nto\n    {later}")
        for first, second in overtaken(self.uses):
            raise SharingViolated(f"this one was overtaken:\n    {first}\nby\n    {second}")
        require_linearizable(self.uses)


def run(plan: Plan) -> Outcome:
    """What came of the plan, once all its processes have ended.

    Raises:
        SharingViolated: the arena itself failed.
    """
    with tempfile.TemporaryDirectory(prefix="motorhil-") as folder:
        command = [sys.executable, "-m", __name__, folder, json.dumps(asdict(plan))]
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=plan.seconds + _GRACE_S + _ENDED_LATE_S,
            check=False,
        )
        if done.returncode:
            raise SharingViolated(f"the arena failed ({done.returncode}): {done.stderr}")
        told = json.loads(done.stdout)
        uses = from_lines(Path(folder, "notes").read_text().splitlines())
    complaints = tuple(line for line in done.stderr.splitlines() if line)
    return Outcome(ended_by_death(uses), complaints=complaints, **told)


# ---- in a worker


@final
class Desk:
    """What a worker has: its name and number, its own chance, a history, and a page that all share.

    Attributes: name, number, random, history, folder (a private one of all workers), facts.
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
        """Whether it is time to end."""
        return self._read(_OVER_AT) != 0

    def note_inside(self, inside: bool) -> None:
        """He has the motor, or not, by his own word."""
        if inside:
            self._write(_INSIDE_AT, os.getpid())
        elif self._read(_INSIDE_AT) == os.getpid():
            self._write(_INSIDE_AT, 0)

    @property
    def value(self) -> int:
        """What stands in the page: the simplest of all things to command."""
        return self._read(_VALUE_AT)

    @value.setter
    def value(self, value: int) -> None:
        self._write(_VALUE_AT, value)

    def fact(self, name: str, otherwise: float) -> float:
        """A number of the plan's facts."""
        return float(cast("float", self.facts.get(name, otherwise)))

    def spend(self, time_s: float) -> None:
        """So much of the wall's time has passed, at work."""
        until_ns = time.monotonic_ns() + round(time_s * 1e9)
        while time.monotonic_ns() < until_ns:
            pass

    def _read(self, at: int) -> int:
        value: int = _PAGE.unpack_from(self._page, at)[0]
        return value

    def _write(self, at: int, value: int) -> None:
        _PAGE.pack_into(self._page, at, value)


def work_lock(desk: Desk) -> None:
    """Takes a bare lock again and again, and commands a number in memory while it has it.

    Facts: inside_s, lease_s (0: none), take_over (how often of 1), commands (each time).
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
        unsure = Answer.UNKNOWN if can_be_lost else Answer.DONE  # between looking and giving
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


# ---- the arena


@final
class _Arena:
    """The workers there are."""

    def __init__(self, folder: Path, plan: Plan) -> None:
        self.folder, self.plan = folder, plan
        (folder / "locks").mkdir(mode=0o700)
        os.environ[VARIABLE] = str(folder / "locks")
        self.page = mmap.mmap(-1, mmap.PAGESIZE)
        self.log = os.open(folder / "notes", os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        self.random = random.Random(plan.seed)
        self.counts: Counter[str] = Counter()
        self.last_kill_ns = 0
        self.spawned = 0
        self.numbers: dict[int, int] = {}
        self.work = _named(plan.work)
        self.plant = _named(plan.plant) if plan.plant else None
        for _ in range(plan.workers):
            self.spawn()

    def spawn(self) -> None:
        """One more worker."""
        number = self.spawned
        self.spawned += 1
        arena = os.getpid()
        pid = os.fork()
        if pid:
            self.numbers[pid] = number
            return
        status = 1
        try:
            _die_with(arena)
            if self.plant is not None:
                self.plant(self.folder)
            self.work(Desk(self.folder, self.plan, number, self.page, self.log))
            status = 0
        except Exception as error:
            print(f"worker {number}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
        finally:
            os._exit(status)

    def goes_on(self) -> bool:
        """Whether anybody has not come to an end by himself."""
        for pid in self.pids:
            if os.waitpid(pid, os.WNOHANG)[0]:
                del self.numbers[pid]
                self.counts["ended by itself"] += 1
        return bool(self.numbers)

    def kill_one(self) -> None:
        """Somebody is dead, and somebody new is there."""
        pid = self.stop_inside() if self.plan.kill_inside else self.random.choice(self.pids)
        if pid is None:
            return
        self.counts["killed inside"] += _PAGE.unpack_from(self.page, _INSIDE_AT)[0] == pid
        self.counts["killed"] += 1
        self._kill(pid)
        self.last_kill_ns = time.monotonic_ns()
        self.spawn()

    def _kill(self, pid: int) -> None:
        number = self.numbers.pop(pid)
        history = History(time.monotonic_ns, self._tell)
        death = history.call(str(number), "", Action.DIE)
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        death.returned()

    def _tell(self, use: Use) -> None:
        os.write(self.log, f"{to_line(use)}\n".encode())

    @property
    def pids(self) -> list[int]:
        """Of those who live."""
        return list(self.numbers)

    def _stop(self, pid: int) -> bool:
        """Whether he stands still; if he had ended by himself, somebody new is there."""
        os.kill(pid, signal.SIGSTOP)
        if os.WIFSTOPPED(os.waitpid(pid, os.WUNTRACED)[1]):
            return True
        del self.numbers[pid]
        self.counts["ended by itself"] += 1
        self.spawn()
        return False

    def stop_inside(self) -> int | None:
        """One that says he has the motor is stopped there; None: nobody says so for a while."""
        until_s = time.monotonic() + _GRACE_S
        while time.monotonic() < until_s:
            pid: int = _PAGE.unpack_from(self.page, _INSIDE_AT)[0]
            if pid in self.numbers and self._stop(pid):
                if _PAGE.unpack_from(self.page, _INSIDE_AT)[0] == pid:
                    return pid
                os.kill(pid, signal.SIGCONT)
            _pass(0.001)
        self.counts["nobody inside"] += 1
        return None

    def pause_one(self) -> None:
        """Somebody was stopped for a while, and goes on."""
        pid = self.stop_inside() if self.plan.pause_inside else self.random.choice(self.pids)
        if pid is None or not (self.plan.pause_inside or self._stop(pid)):
            return
        self.counts["paused inside"] += _PAGE.unpack_from(self.page, _INSIDE_AT)[0] == pid
        self.counts["paused"] += 1
        _pass(self.plan.pause_s)
        os.kill(pid, signal.SIGCONT)

    def end(self) -> None:
        """All have ended; those who do not end by themselves are killed."""
        _PAGE.pack_into(self.page, _OVER_AT, 1)
        watches = {os.pidfd_open(pid): pid for pid in self.numbers}
        until_s = time.monotonic() + _GRACE_S
        while watches and (left_s := until_s - time.monotonic()) > 0:
            for watch in select.select(list(watches), [], [], left_s)[0]:
                pid = watches.pop(watch)
                os.waitpid(pid, 0)
                os.close(watch)
                del self.numbers[pid]
        for watch, pid in watches.items():
            self.counts["killed at the end"] += 1
            self._kill(pid)
            os.close(watch)


def _die_with(parent: int) -> None:
    """This process is killed when the arena dies, however it dies, and even if it is paused."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def _pass(seconds: float) -> None:
    select.select([], [], [], max(0.0, seconds))


def _named(name: str) -> Callable[..., object]:
    module, _, function = name.partition(":")
    named: Callable[..., object] = getattr(importlib.import_module(module), function)
    return named


def _act(arena: _Arena, plan: Plan) -> tuple[int, int]:
    begun_s = time.monotonic()
    acts = ((plan.kill_period_s, arena.kill_one), (plan.pause_period_s, arena.pause_one))
    due = [(begun_s + period_s, period_s, act) for period_s, act in acts if period_s]
    end_s = begun_s + plan.seconds
    while (now_s := time.monotonic()) < end_s and (due or arena.goes_on()):
        for place, (due_s, period_s, act) in enumerate(due):
            if now_s >= due_s:
                due[place] = (max(due_s + period_s, now_s), period_s, act)
                act()
        next_s = min([end_s, now_s + _LOOK_S, *(one[0] for one in due)])
        _pass(next_s - time.monotonic())
    return round(begun_s * 1e9), time.monotonic_ns()


def main() -> None:
    """In the arena: the plan of the command line has been carried out, and told on stdout."""
    plan = Plan(**json.loads(sys.argv[2]))
    arena = _Arena(Path(sys.argv[1]), plan)
    try:
        begun_ns, ended_ns = _act(arena, plan)
    finally:
        arena.end()
    told = {
        "counts": dict(arena.counts),
        "begun_ns": begun_ns,
        "ended_ns": ended_ns,
        "last_kill_ns": arena.last_kill_ns,
    }
    print(json.dumps(told))


if __name__ == "__main__":
    main()
