"""The lock between processes, compared with flock and with no lock in the same run.

Each worker keeps a processor busy. The scheduler stops some of them. Behind a stopped owner, all
others wait. The same work without a lock shows how long a stop is, which bounds the worst wait.
flock has no order, so its owner mostly takes it again at once. Turns of others during a wait show
the order alone, whatever the scheduler does.
"""

import fcntl
import os
import statistics
import tempfile
import time
from bisect import bisect_right
from collections.abc import Callable

from motorhil.harness.sharing_tests.history import Action, Answer, SharingViolated
from motorhil.harness.sharing_tests.processes import Outcome, Plan
from motorhil.harness.sharing_tests.processes import run as contested
from motorhil.harness.sharing_tests.workers import Desk
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.runtime.wall import WallRuntime

ROUNDS = 5
SHORT_ROUNDS = 200  # shorter than a time slice, so that some rounds run undisturbed
TIMES = 100
CONTEST_S, INSIDE_S = 1.5, 50e-6
OURS, FLOCK, FREE = (
    "motorhil.harness.sharing_tests.workers:work_lock",
    "tests.benchmarks.bench_locks:work_flock",
    "tests.benchmarks.bench_locks:work_free",
)


def _best_us(action: Callable[[], object]) -> float:
    rounds = []
    for _ in range(SHORT_ROUNDS):
        begun = time.perf_counter()
        for _ in range(TIMES):
            action()
        rounds.append((time.perf_counter() - begun) / TIMES * 1e6)
    return min(rounds)


def _uncontended_us() -> tuple[float, float]:
    """Return the times (ours, flock) [us] of acquiring and releasing without contention."""
    runtime = WallRuntime()
    with tempfile.TemporaryDirectory() as folder:
        lock = ProcessLock("lock", "the lock", LockDirectory(folder))
        peer = os.open(f"{folder}/peer", os.O_RDWR | os.O_CREAT)

        def flock() -> None:
            fcntl.flock(peer, fcntl.LOCK_EX)
            fcntl.flock(peer, fcntl.LOCK_UN)

        try:
            ours_us = _best_us(lambda: lock.acquire(runtime, "bench").release())
            return ours_us, _best_us(flock)
        finally:
            os.close(peer)
            lock.close()
            runtime.close()


def _held_us() -> tuple[float, float, float]:
    """Return the times [us] of a write section, a lease renewal and a takeover."""
    runtime = WallRuntime()
    with tempfile.TemporaryDirectory() as folder:
        locks = [ProcessLock("lock", "the lock", LockDirectory(folder)) for _ in range(2)]
        holds = [lock.acquire(runtime, "bench", take_over=True) for lock in locks]

        def write() -> None:
            locks[1].begin_write()
            locks[1].end_write()

        def take_over() -> None:
            for place in (0, 1):  # each takes over from the other, which then releases
                taken = locks[place].acquire(runtime, "bench", take_over=True)
                holds[1 - place].release()
                holds[place] = taken

        try:
            write_us = _best_us(write)
            holds[1].set_lease(1.0)
            renew_us = _best_us(holds[1].renew)
            return write_us, renew_us, _best_us(take_over) / 2
        finally:
            for hold in holds:
                hold.release()
            for lock in locks:
                lock.close()
            runtime.close()


def work_flock(desk: Desk) -> None:
    """Work as `work_lock` does, with flock: no order, no token."""
    lock = os.open(desk.folder / "flock", os.O_RDWR | os.O_CREAT)
    while not desk.is_over:
        take = desk.history.call(desk.name, "lock", Action.TAKE)
        fcntl.flock(lock, fcntl.LOCK_EX)
        take.returned()
        desk.spend(INSIDE_S)
        desk.history.call(desk.name, "lock", Action.COMMAND, value=1).returned()
        desk.history.call(desk.name, "lock", Action.READ).returned(value=1)
        give = desk.history.call(desk.name, "lock", Action.GIVE)
        fcntl.flock(lock, fcntl.LOCK_UN)
        give.returned()


def work_free(desk: Desk) -> None:
    """Work as long as one owner, without a lock; a wait is the time of a turn."""
    while not desk.is_over:
        take = desk.history.call(desk.name, "lock", Action.TAKE)
        desk.spend(INSIDE_S)
        take.returned()


def _contested(work: str) -> Outcome:
    facts: dict[str, object] = {"inside_s": INSIDE_S, "commands": 1}
    return contested(Plan(work, seconds=CONTEST_S, workers=4, facts=facts))


def _turns_waited(outcome: Outcome) -> int:
    """Return the most turns of others that began during a wait."""
    takes = [one for one in outcome.uses if (one.action, one.answer) == (Action.TAKE, Answer.DONE)]
    begun_ns = sorted(one.returned_ns for one in takes)
    return max(
        bisect_right(begun_ns, one.returned_ns) - 1 - bisect_right(begun_ns, one.called_ns)
        for one in takes
    )


def _violations(outcome: Outcome) -> int:
    try:
        outcome.require_sound()
    except SharingViolated:
        return 1
    return 0


def run() -> list[tuple[str, float, str]]:
    """Return the figures as (name, figure, unit)."""
    ours_us, flock_us = _uncontended_us()
    write_us, renew_us, over_us = _held_us()
    rounds = [  # alternately, so that all meet the same disturbances
        [_contested(work) for work in (OURS, FLOCK, FREE)] for _ in range(ROUNDS)
    ]
    ours, peer, free = zip(*rounds, strict=True)
    ours_s, peer_s, free_s = (
        statistics.median(one.waits_s[-1] for one in them) for them in (ours, peer, free)
    )
    order, peer_order = (max(map(_turns_waited, them)) for them in (ours, peer))
    turns, peer_turns = (sum(len(one.waits_s) for one in them) for them in (ours, peer))
    killed = contested(Plan(OURS, seconds=10.0, kill_period_s=0.05))
    return [
        ("taking it and letting it go, nobody else there", ours_us, "us"),
        ("  with flock", flock_us, "us"),
        ("begin_write and end_write", write_us, "us"),
        ("renewing a lease", renew_us, "us"),
        ("taking it over from one who lives, and his giving it back", over_us, "us"),
        ("4 processes, 50 us inside: worst wait (median of 5 runs)", ours_s * 1e3, "ms"),
        ("  with flock", peer_s * 1e3, "ms"),
        ("  ours against that", ours_s / peer_s, "x"),
        ("  without a lock: longest turn", free_s * 1e3, "ms"),
        ("4 processes, 50 us inside: most turns of others during a wait", order, ""),
        ("  with flock", peer_order, ""),
        ("  ours against that", order / peer_order, "x"),
        ("4 processes, 50 us inside: turns a second", turns / ROUNDS / CONTEST_S, "1/s"),
        ("  with flock", peer_turns / ROUNDS / CONTEST_S, "1/s"),
        ("5 processes, one killed every 50 ms for 10 s: killed", killed.counts["killed"], ""),
        ("  turns", len(killed.waits_s), ""),
        ("  1 if anybody intruded, was overtaken, or had an old token", _violations(killed), ""),
        ("  longest time in which nobody had a turn", killed.worst_gap_s * 1e3, "ms"),
    ]
