"""Where the workers of `harness.sharing.processes` run, are killed, and are paused.

    python -m harness.sharing.arena FOLDER PLAN

A process of its own, which forks the workers before it has had any lock itself, and has no threads.
"""

import ctypes
import importlib
import json
import mmap
import os
import random
import select
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final, final

from harness.sharing.desk import INSIDE_AT, OVER_AT, PAGE, Desk
from harness.sharing.history import Action, History, Use, to_line
from harness.sharing.processes import GRACE_S, Plan
from motorapi.lock_directory import VARIABLE

_LOOK_S: Final = 0.1
_PR_SET_PDEATHSIG: Final = 1


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
        self.counts["killed inside"] += PAGE.unpack_from(self.page, INSIDE_AT)[0] == pid
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
        until_s = time.monotonic() + GRACE_S
        while time.monotonic() < until_s:
            pid: int = PAGE.unpack_from(self.page, INSIDE_AT)[0]
            if pid in self.numbers and self._stop(pid):
                if PAGE.unpack_from(self.page, INSIDE_AT)[0] == pid:
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
        self.counts["paused inside"] += PAGE.unpack_from(self.page, INSIDE_AT)[0] == pid
        self.counts["paused"] += 1
        _pass(self.plan.pause_s)
        os.kill(pid, signal.SIGCONT)

    def end(self) -> None:
        """All have ended; those who do not end by themselves are killed."""
        PAGE.pack_into(self.page, OVER_AT, 1)
        watches = {os.pidfd_open(pid): pid for pid in self.numbers}
        until_s = time.monotonic() + GRACE_S
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
