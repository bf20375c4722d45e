"""Several programs at one lock, stopped before any system call and killed there, from a seed.

The lock is the kernel's. The programs are threads of one process, of which one runs at a time, so
that a seed determines the order of all system calls. Their history must be that of a lock with one
owner at a time, as in the attack on real processes.
"""

import os
from collections import Counter
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Final, final
from unittest.mock import patch

from motorhil.harness.sharing_tests.history import (
    Action,
    Answer,
    History,
    SharingViolated,
    overtaken,
    to_line,
    tokens_that_did_not_grow,
)
from motorhil.harness.sharing_tests.linearizability import require_linearizable
from motorhil.motorapi.errors import MotorBusyError
from motorhil.motorapi.locking import lock_file, process_lock, witness
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import LockHandle, ProcessLock
from motorhil.motorapi.runtime.api import Runtime
from tests.attack.campaign import Attack, Attempt, Done
from tests.support.sharing.stepwise import Program, Turns, stopped_at_calls

STOPS: Final = 12
"""The largest number of stops in a schedule, which then runs to its end."""
STEPS_MAX: Final = 40
"""The largest number of system calls between two stops; an acquisition has about 20."""
LOOKS: Final = 4
"""How often a waiting program looks before it gives up; others may run in between."""
_EXPIRED_S: Final = 1e-9
_LONG_S: Final = 1000.0


@final
class Shared:
    """The commanded number, and who is in a write section."""

    def __init__(self) -> None:
        self._ticks: Final = count(1)
        self.history: Final = History(self.now)
        self.value = 0
        self.writers: set[str] = set()

    def now(self) -> int:
        """Return the number of this look at the clock, greater than any before."""
        return next(self._ticks)

    def write(self, party: "Party", value: int) -> None:
        """Write the number in a write section, with a stop on each side."""
        self.writers.add(party.name)
        if len(self.writers) > 1:
            raise SharingViolated(f"{' and '.join(sorted(self.writers))} write at the same time")
        party.program.step()
        self.value = value
        party.program.step()
        self.writers.discard(party.name)


@final
class Party:
    """A program that takes the lock a few times, and commands the number while it owns it."""

    def __init__(self, shared: Shared, path: Path, number: int, dice: Random) -> None:
        self.name: Final = f"{number}"
        self.shared: Final = shared
        self._number: Final = number
        self._by_force: Final = dice.choice(((), (0, 1), (0, 1)))
        self._lease_s: Final = dice.choice((None, _EXPIRED_S, _LONG_S))
        self.program: Final = Program(path, self._work)

    def kill(self) -> None:
        """Kill the program before its next system call, and note its death."""
        death = self.shared.history.call(self.name, "", Action.DIE)
        self.program.kill()
        self.shared.writers.discard(self.name)
        death.returned()

    def _work(self) -> None:
        for turn in range(2):
            self._take(turn, turn in self._by_force)

    def _take(self, turn: int, by_force: bool) -> None:
        history = self.shared.history
        take = history.call(self.name, "lock", Action.TAKE, forced=by_force)

        def wait(runtime: Runtime, done: Callable[[], bool], timeout_s: float | None) -> bool:
            if not by_force:
                take.queued()
            return self._wait(done)

        try:
            hold = self.program.lock.acquire(
                Turns(),  # type: ignore[arg-type]
                "schedule",
                1.0,
                wait=wait,
                lease_s=self._lease_s,
                take_over=by_force,
            )
        except MotorBusyError:
            take.returned(Answer.UNKNOWN)  # refused also by an attempt of a stopped program
            return
        take.returned(token=hold.token, forced=hold.was_taken_over)
        for number in range(2):
            self._command(hold, 100 * turn + 10 * number + self._number + 1)
        give = history.call(self.name, "lock", Action.GIVE)
        is_lost = hold.lost_to is not None
        hold.release()
        give.returned(Answer.LOST if is_lost else Answer.UNKNOWN)

    def _wait(self, done: Callable[[], bool]) -> bool:
        for _ in range(LOOKS):
            if done():
                return True
            self.program.give_way()
        return False

    def _command(self, hold: LockHandle, value: int) -> None:
        history = self.shared.history
        command = history.call(self.name, "lock", Action.COMMAND, value=value)
        try:
            self.program.lock.begin_write()
        except MotorBusyError:
            command.returned(Answer.UNKNOWN if hold.lost_to is None else Answer.LOST)
            return
        self.shared.write(self, value)
        self.program.lock.end_write()
        command.returned()
        read = history.call(self.name, "lock", Action.READ)
        read.returned(value=self.shared.value)


@final
class Files:
    """The lock files of a schedule, of which each keeps its inode until the end.

    Otherwise the chance of the file system would decide about the order of their witnesses.
    """

    def __init__(self) -> None:
        self._numbers: Final[dict[int, int]] = {}
        self._kept: Final[list[int]] = []

    def number_of(self, inode: int) -> int:
        """Return the inode's number in the order of first use, in place of its hash."""
        return self._numbers.setdefault(inode, len(self._numbers))

    def remove(self, path: Path) -> None:
        """Remove the file from its folder, if it is there, and keep it open."""
        with suppress(FileNotFoundError):
            self._kept.append(os.open(path, os.O_RDONLY))
            path.unlink()

    def close(self) -> None:
        """Close the files that were removed."""
        for fd in self._kept:
            os.close(fd)


def _run(
    parties: list[Party], folder: Path, files: Files, dice: Random, reached: Counter[str]
) -> None:
    left, is_removed = list(parties), dice.random() < 0.2
    for _ in range(dice.randint(1, STOPS)):
        if is_removed and dice.random() < 0.3:
            files.remove(folder / "pan")
            reached["file removed"] += 1
        one = dice.choice(left)
        if dice.random() < 0.1:
            one.kill()
            reached["killed"] += 1
        elif one.program.advance(dice.randint(1, STEPS_MAX)):
            reached["stopped"] += 1
            continue
        left.remove(one)
        if not left:
            return
    dice.shuffle(left)
    for one in left:
        one.program.advance()


def attack(seed: str, folder: Path) -> Done:
    """Carry out one schedule and judge its history."""
    dice, reached = Random(seed), Counter[str]()
    shared, files = Shared(), Files()
    with (
        closing(files),
        stopped_at_calls(),
        patch.object(witness, "_hash_of", files.number_of),
        patch.object(process_lock, "_TAKER_PATIENCE_NS", -1),
        patch.object(lock_file, "first_token", shared.now),
    ):
        is_new = dice.random() < 0.3
        if not is_new:
            _last(folder)
        parties = [Party(shared, folder, number, dice) for number in range(dice.choice((2, 3, 4)))]
        _run(parties, folder, files, dice, reached)
        token = _last(folder)  # all have ended: the lock is free
    uses = shared.history.uses()
    if is_new or reached["file removed"]:  # an owner may have to ask again, behind others
        uses = tuple(replace(use, queued_ns=None) for use in uses)
    if token <= max((use.token for use in uses), default=0):
        raise SharingViolated(f"the next token, {token}, is not greater than all before it")
    for first, second in [*tokens_that_did_not_grow(uses), *overtaken(uses)]:
        raise SharingViolated(f"wrong order:\n    {first}\n    {second}")
    require_linearizable(uses)
    for use in uses:
        how = " from a living owner" if use.forced and use.token else ""
        reached[f"{use.action.value}: {use.answer.value}{how}"] += 1
    return Done(1, "\n".join(map(to_line, uses)).encode(), reached)


def _last(folder: Path) -> int:
    """Take and release the lock; return the token."""
    lock = ProcessLock("pan", "the pan", LockDirectory(folder))
    with lock.acquire(Turns(), "alone") as hold:  # type: ignore[arg-type]
        token = hold.token
    lock.close()
    return token


def begin(seed: int) -> Attempt:
    """Return the attempts: one schedule each."""

    def attempt(number: int) -> Done:
        with TemporaryDirectory(prefix="motorhil-") as folder:
            return attack(f"{seed}:{number}", Path(folder))

    return attempt


SCHEDULES: Final = Attack("schedules", "schedules", begin)
