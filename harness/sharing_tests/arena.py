"""Arena: the process that runs, kills and pauses the worker processes.

    python -m motorhil.harness.sharing_tests.arena FOLDER PLAN

The arena is a separate process without threads, and forks the workers before it has held any lock.
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

from motorhil.harness.sharing_tests.history import Action, History, Use, to_note
from motorhil.harness.sharing_tests.processes import GRACE_S, Plan
from motorhil.harness.sharing_tests.workers import INSIDE, OVER, Desk
from motorhil.motorapi.locking.directory import VARIABLE

_POLL_S: Final = 0.1
_PR_SET_PDEATHSIG: Final = 1


@final
class _Arena:
    """The running workers."""

    def __init__(self, folder: Path, plan: Plan) -> None:
        self.folder, self.plan = folder, plan
        (folder / "locks").mkdir(mode=0o700)
        os.environ[VARIABLE] = str(folder / "locks")
        self.page = memoryview(mmap.mmap(-1, mmap.PAGESIZE)).cast("q")
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
        """Fork one more worker."""
        number = self.spawned
        self.spawned += 1
        arena = os.getpid()
        pid = os.fork()
        if pid:
            self.numbers[pid] = number
            return
        status = 1
        try:
            die_with(arena)
            if self.plant is not None:
                self.plant(self.folder)
            self.work(Desk(self.folder, self.plan, number, self.page, self.log))
            status = 0
        except Exception as error:
            print(f"worker {number}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
        finally:
            os._exit(status)

    def is_running(self) -> bool:
        """Return True while a worker is running; count those that have ended by themselves."""
        for pid in self.pids:
            if os.waitpid(pid, os.WNOHANG)[0]:
                del self.numbers[pid]
                self.counts["ended by itself"] += 1
        return bool(self.numbers)

    def kill_one(self) -> None:
        """Kill one worker and start a new one."""
        pid = self.stop_inside() if self.plan.kill_inside else self.random.choice(self.pids)
        if pid is None:
            return
        self.counts["killed inside"] += self.page[INSIDE] == pid
        self.counts["killed"] += 1
        self._kill(pid)
        self.last_kill_ns = time.monotonic_ns()
        self.spawn()

    def _kill(self, pid: int) -> None:
        number = self.numbers.pop(pid)
        history = History(time.monotonic_ns, self._write_use)
        death = history.call(str(number), "", Action.DIE)
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        death.returned()

    def _write_use(self, use: Use) -> None:
        os.write(self.log, to_note(use))

    @property
    def pids(self) -> list[int]:
        """The process IDs of the running workers."""
        return list(self.numbers)

    def _stop(self, pid: int) -> bool:
        """Stop a worker and return True; if it has ended by itself, replace it and return False."""
        os.kill(pid, signal.SIGSTOP)
        if os.WIFSTOPPED(os.waitpid(pid, os.WUNTRACED)[1]):
            return True
        del self.numbers[pid]
        self.counts["ended by itself"] += 1
        self.spawn()
        return False

    def stop_inside(self) -> int | None:
        """Stop a worker that reports to have the motor; return None if none does for a while."""
        until_s = time.monotonic() + GRACE_S
        while time.monotonic() < until_s:
            pid = self.page[INSIDE]
            if pid in self.numbers and self._stop(pid):
                if self.page[INSIDE] == pid:
                    return pid
                os.kill(pid, signal.SIGCONT)
            _pass(0.001)
        self.counts["no owner inside"] += 1
        return None

    def pause_one(self) -> None:
        """Stop one worker for a while, then continue it."""
        pid = self.stop_inside() if self.plan.pause_inside else self.random.choice(self.pids)
        if pid is None or not (self.plan.pause_inside or self._stop(pid)):
            return
        self.counts["paused inside"] += self.page[INSIDE] == pid
        self.counts["paused"] += 1
        _pass(self.plan.pause_s)
        os.kill(pid, signal.SIGCONT)

    def end(self) -> None:
        """End all workers; kill those that do not end by themselves."""
        self.page[OVER] = 1
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


def die_with(parent: int) -> None:
    """Have this process killed when its parent dies in any way, even while it is paused."""
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
    while (now_s := time.monotonic()) < end_s and (due or arena.is_running()):
        for place, (due_s, period_s, act) in enumerate(due):
            if now_s >= due_s:
                due[place] = (max(due_s + period_s, now_s), period_s, act)
                act()
        next_s = min([end_s, now_s + _POLL_S, *(one[0] for one in due)])
        _pass(next_s - time.monotonic())
    return round(begun_s * 1e9), time.monotonic_ns()


def main() -> None:
    """Carry out the plan of the command line and print the outcome on stdout."""
    plan = Plan(**json.loads(sys.argv[2]))
    arena = _Arena(Path(sys.argv[1]), plan)
    try:
        begun_ns, ended_ns = _act(arena, plan)
    finally:
        arena.end()
    result = {
        "counts": dict(arena.counts),
        "begun_ns": begun_ns,
        "ended_ns": ended_ns,
        "last_kill_ns": arena.last_kill_ns,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
