"""Processes that fight for one lock, some of them killed or paused, and what came of it: JSON.

    python -m tests.wall.lock_stress '{"seconds": 2.0, "kill_period_s": 0.05, ...}'

The workers are forked here, in a process that has never had the lock, and are nobody's relatives
to one another. Each of them notes of every turn it gets: when it asked, when it had its place in
the queue, when it was in, and its token. From that, and from a page of memory in which whoever is
in writes its name, the verdict follows:

- *exclusion*: nobody else writes its name there while one is in.
- *order*: if one had its place before another began to ask, it has the smaller token.
- *tokens* grow: no two turns have the same.
- *life*: the longest time in which nobody got a turn, though somebody always asked.

`plant` breaks the lock on purpose, for the tests of this judge; `lock` = "flock" is the peer.
"""

import contextlib
import fcntl
import json
import mmap
import os
import random
import select
import signal
import struct
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

from motorapi import lock_file
from motorapi.lock_directory import LockDirectory
from motorapi.lock_file import LockFile
from motorapi.process_lock import ProcessLock
from motorapi.wall_runtime import WallRuntime

NOTE = struct.Struct("<6q")  # pid, asked, queued, in, token, 1 if somebody else was in
PAGE = struct.Struct("<q")
PATIENCE_S = 10.0


@dataclass(frozen=True)
class Plan:
    """What is to happen."""

    seconds: float = 1.0
    workers: int = 5
    inside_us: int = 50
    kill_period_s: float = 0.0
    kill_inside: bool = False
    pause_period_s: float = 0.0
    pause_s: float = 0.02
    seed: int = 1
    lock: str = "ours"
    plant: str = ""


@dataclass(frozen=True)
class Verdict:
    """What came of it."""

    turns: int
    killed: int
    paused: int
    killed_inside: int
    turns_after_last_kill: int
    intruders: int
    overtaken: int
    tokens_repeated: int
    longest_gap_s: float
    worst_wait_s: float
    wait_p99_s: float


# --- a worker


class Ours:
    """The lock that is judged."""

    def __init__(self, folder, plan):
        self.queued_ns = 0
        plant(plan.plant, folder)
        for name in ("take_at_once", "queue_up"):
            self._note_time_of(name)
        self._runtime = WallRuntime()
        self._lock = ProcessLock("lock", "the lock", LockDirectory(folder))

    def _note_time_of(self, name):
        original = getattr(LockFile, name)

        def noted(file, *args):
            answer = original(file, *args)
            self.queued_ns = time.monotonic_ns()
            return answer

        setattr(LockFile, name, noted)

    def acquire(self):
        self._hold = self._lock.acquire(self._runtime, "stress", PATIENCE_S)
        return self._hold.token

    def release(self):
        self._hold.release()


class Flock:
    """The peer: no order, no token."""

    def __init__(self, folder, plan):
        self.queued_ns = 0
        self._fd = os.open(f"{folder}/flock", os.O_RDWR | os.O_CREAT)
        self._token = 0

    def acquire(self):
        fcntl.flock(self._fd, fcntl.LOCK_EX)
        self._token += 1
        return self._token

    def release(self):
        fcntl.flock(self._fd, fcntl.LOCK_UN)


def plant(fault, folder):
    """The lock is broken in the way that `fault` says."""
    if fault == "no order":  # whoever is quickest
        LockFile.take = lambda file, place: file._take(lock_file._HOLD)
    elif fault == "no token":
        LockFile.last = lambda file: (0, b"", False)
    elif fault == "no exclusion":
        LockFile.take = lambda file, place: True
        LockFile.tell_holder = lambda file, token, record, *lease: None
    elif fault == "stays after death":  # a file that is there, or is not: what so many do
        flag, mine = f"{folder}/flag", set()
        let_go = LockFile.let_go

        def take_flag(file):
            try:
                os.close(os.open(flag, os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                return False
            mine.add(file)
            return True

        def drop_flag(file):
            let_go(file)
            if file in mine:
                mine.remove(file)
                Path(flag).unlink()

        LockFile.take_at_once = take_flag
        LockFile.take = lambda file, place: take_flag(file)
        LockFile.let_go = drop_flag
        LockFile.tell_holder = lambda file, token, record, *lease: None
    elif fault:
        raise ValueError(fault)


def work(folder, plan, page, notes):
    """Asks for the lock until the page says that it is over."""
    lock = {"ours": Ours, "flock": Flock}[plan.lock](folder, plan)
    pid = os.getpid()
    log = os.open(notes, os.O_WRONLY | os.O_APPEND)
    while PAGE.unpack_from(page, 8)[0] == 0:
        asked_ns = time.monotonic_ns()
        token = lock.acquire()
        inside_ns = time.monotonic_ns()
        PAGE.pack_into(page, 0, pid)
        until_ns = inside_ns + plan.inside_us * 1000
        while time.monotonic_ns() < until_ns:
            pass
        somebody = PAGE.unpack_from(page, 0)[0] != pid
        os.write(log, NOTE.pack(pid, asked_ns, lock.queued_ns, inside_ns, token, somebody))
        PAGE.pack_into(page, 0, 0)
        lock.release()


# --- the arena


class Arena:
    """The workers there are."""

    def __init__(self, folder, plan):
        self.folder, self.plan = folder, plan
        self.page = mmap.mmap(-1, mmap.PAGESIZE)
        self.notes = f"{folder}/notes"
        Path(self.notes).touch()
        self.pids = [self.spawn() for _ in range(plan.workers)]
        self.random = random.Random(plan.seed)
        self.killed = self.paused = self.killed_inside = self.last_kill_ns = 0

    def spawn(self):
        pid = os.fork()
        if pid:
            return pid
        status = 1
        try:
            work(self.folder, self.plan, self.page, self.notes)
            status = 0
        except Exception as error:
            print(f"worker {os.getpid()}: {error!r}", file=sys.stderr, flush=True)
        finally:
            os._exit(status)

    def kill_one(self):
        pid = self.random.choice(self.pids)
        if self.plan.kill_inside:
            pid = self.stop_inside()
            self.killed_inside += 1
        self.pids.remove(pid)
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        self.last_kill_ns = time.monotonic_ns()
        self.killed += 1
        self.pids.append(self.spawn())

    def stop_inside(self):
        """One that is in has been stopped there."""
        while True:
            pid = PAGE.unpack_from(self.page, 0)[0]
            if pid in self.pids:
                os.kill(pid, signal.SIGSTOP)
                os.waitpid(pid, os.WUNTRACED)
                if PAGE.unpack_from(self.page, 0)[0] == pid:
                    return pid
                os.kill(pid, signal.SIGCONT)
            wait(0.001)

    def pause_one(self):
        pid = self.random.choice(self.pids)
        os.kill(pid, signal.SIGSTOP)
        wait(self.plan.pause_s)
        os.kill(pid, signal.SIGCONT)
        self.paused += 1

    def end(self):
        """All have ended; those who do not end by themselves are killed."""
        PAGE.pack_into(self.page, 8, 1)
        watches = {os.pidfd_open(pid): pid for pid in self.pids}
        until_s = time.monotonic() + 1.0
        while watches and (left_s := until_s - time.monotonic()) > 0:
            for watch in select.select(list(watches), [], [], left_s)[0]:
                os.waitpid(watches.pop(watch), 0)
                os.close(watch)
        for watch, pid in watches.items():
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            os.close(watch)
        self.pids.clear()


def wait(seconds):
    """This much of the wall's time has passed."""
    select.select([], [], [], max(0.0, seconds))


def run(plan):
    """The verdict."""
    with tempfile.TemporaryDirectory() as folder:
        arena = Arena(folder, plan)
        try:
            begun_s = time.monotonic()
            acts = [(plan.kill_period_s, arena.kill_one), (plan.pause_period_s, arena.pause_one)]
            due = [[begun_s + period_s, period_s, act] for period_s, act in acts if period_s]
            end_s = begun_s + plan.seconds
            while (now_s := time.monotonic()) < end_s:
                for one in due:
                    if now_s >= one[0]:
                        one[0] = max(one[0] + one[1], now_s)
                        one[2]()
                next_s = min([end_s, *[one[0] for one in due]])
                wait(next_s - time.monotonic())
            ended_ns = time.monotonic_ns()
        finally:
            arena.end()
        notes = [NOTE.unpack(data) for data in chunks(Path(arena.notes).read_bytes())]
    return judge(notes, arena, round(begun_s * 1e9), ended_ns)


def chunks(data):
    return [data[at : at + NOTE.size] for at in range(0, len(data), NOTE.size)]


def judge(notes, arena, begun_ns, ended_ns):
    """From what was noted in arena, and when."""
    by_token = sorted(notes, key=lambda note: note[4])
    overtaken, queued_later_ns = 0, ended_ns * 2
    for _, asked_ns, queued_ns, _, _, _ in reversed(by_token):
        overtaken += queued_later_ns < asked_ns
        queued_later_ns = min(queued_later_ns, queued_ns)
    waits = sorted(inside_ns - asked_ns for _, asked_ns, _, inside_ns, _, _ in notes) or [0]
    times = sorted([begun_ns, *(note[3] for note in notes if note[3] < ended_ns), ended_ns])
    return Verdict(
        turns=len(notes),
        killed=arena.killed,
        paused=arena.paused,
        killed_inside=arena.killed_inside,
        turns_after_last_kill=sum(note[3] > arena.last_kill_ns for note in notes),
        intruders=sum(note[5] for note in notes),
        overtaken=overtaken,
        tokens_repeated=len(notes) - len({note[4] for note in notes}),
        longest_gap_s=max(b - a for a, b in pairwise(times)) / 1e9,
        worst_wait_s=waits[-1] / 1e9,
        wait_p99_s=waits[len(waits) * 99 // 100] / 1e9,
    )


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps(asdict(run(Plan(**json.loads(sys.argv[1]))))))
