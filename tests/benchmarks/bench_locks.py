"""The lock between processes, against flock in the same run."""

import fcntl
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict

from motorapi.lock_directory import LockDirectory
from motorapi.process_lock import ProcessLock
from motorapi.wall_runtime import WallRuntime
from tests.wall.lock_stress import Plan, Verdict

ROUNDS = 5
SHORT_ROUNDS = 200  # each shorter than a turn on a busy processor, so that one goes undisturbed
TIMES = 100


def _best_us(action: Callable[[], object]) -> float:
    rounds = []
    for _ in range(SHORT_ROUNDS):
        begun = time.perf_counter()
        for _ in range(TIMES):
            action()
        rounds.append((time.perf_counter() - begun) / TIMES * 1e6)
    return min(rounds)


def _uncontended_us() -> tuple[float, float]:
    """(ours, flock) of taking it and letting it go, nobody else there."""
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
    """(a write section, renewing a lease, taking it over from one who lives), one of each."""
    runtime = WallRuntime()
    with tempfile.TemporaryDirectory() as folder:
        locks = [ProcessLock("lock", "the lock", LockDirectory(folder)) for _ in range(2)]
        holds = [lock.acquire(runtime, "bench", take_over=True) for lock in locks]

        def write() -> None:
            locks[1].begin_write()
            locks[1].end_write()

        def take_over() -> None:
            for place in (0, 1):  # each from the other, who lives; then the loser gives it back
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


def _stress(plan: Plan) -> Verdict:
    command = [sys.executable, "-m", "tests.wall.lock_stress", json.dumps(asdict(plan))]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return Verdict(**json.loads(done.stdout))


def run() -> list[tuple[str, float, str]]:
    """(name, figure, unit) of each figure."""
    ours_us, flock_us = _uncontended_us()
    write_us, renew_us, over_us = _held_us()
    pairs = [  # in turn, so that both meet the same disturbances
        (_stress(Plan(3.0, 4)), _stress(Plan(3.0, 4, lock="flock"))) for _ in range(ROUNDS)
    ]
    ours_s = statistics.median(ours.worst_wait_s for ours, _ in pairs)
    peer_s = statistics.median(peer.worst_wait_s for _, peer in pairs)
    killed = _stress(Plan(10.0, 5, kill_period_s=0.05))
    violations = killed.intruders + killed.overtaken + killed.tokens_repeated
    return [
        ("taking it and letting it go, nobody else there", ours_us, "us"),
        ("the same with flock", flock_us, "us"),
        ("begin_write and end_write", write_us, "us"),
        ("renewing a lease", renew_us, "us"),
        ("taking it over from one who lives, and his giving it back", over_us, "us"),
        ("4 processes, 50 us inside: worst wait (median of 5 runs of 3 s)", ours_s * 1e3, "ms"),
        ("the same with flock", peer_s * 1e3, "ms"),
        ("ours against that", ours_s / peer_s, "x"),
        ("turns a second", sum(ours.turns for ours, _ in pairs) / ROUNDS / 3.0, "1/s"),
        ("the same with flock", sum(peer.turns for _, peer in pairs) / ROUNDS / 3.0, "1/s"),
        ("5 processes, one killed every 50 ms for 10 s: killed", killed.killed, ""),
        ("turns", killed.turns, ""),
        ("violations: intruders, overtaken, tokens repeated", violations, ""),
        ("longest time in which nobody had a turn", killed.longest_gap_s * 1e3, "ms"),
    ]
