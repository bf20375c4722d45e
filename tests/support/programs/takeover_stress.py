"""Processes that take one lock from each other; prints JSON.

    python -m tests.support.programs.takeover_stress SECONDS SEED [FAULT]

The test lasts that long; then until there were enough events of each kind (ENOUGH, or the effect of
FAULT), but SPARE_S at most, as a busy machine may be slow.

Each worker takes the lock, mostly with a short lease, sometimes on demand, and writes while it
holds it, and a little longer; some are paused anywhere, some killed. A write is made like a
commanding one: between begin_write and end_write it stores its token in a page of shared memory.

- *intruders*: writes during which another worker wrote as well.
- *stale*: writes under a token that is smaller than that of an earlier write.
- *repeated*: tokens that two workers have had.

FAULT breaks the lock on purpose: "no fence" (a write does not exclude takeovers), "no look" (the
epoch is not checked before a write).
"""

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
from pathlib import Path

from motorhil.motorapi.errors import MotorBusyError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.lock_file import LockFile
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.runtime.wall import WallRuntime

PAGE = struct.Struct("<qqqqqq")  # over, last token, writing token, intruders, stale, writes
NOTE = struct.Struct("<qq")  # token, 1 if taken over
WORKERS = 4
ENOUGH = {"killed": 3, "paused": 3, "taken_over": 10, "writes": 200}
FOUND = {"no fence": {"intruders": 1}, "no look": {"stale": 1}}
SPARE_S = 40.0


def put(page, place, value):
    struct.pack_into("<q", page, 8 * place, value)


def add(page, place):
    put(page, place, PAGE.unpack_from(page)[place] + 1)


def plant(fault):
    if fault == "no fence":
        LockFile.try_write = lambda file: True
    elif fault == "no look":
        LockFile.is_current = property(lambda file: True)
    elif fault:
        raise ValueError(fault)


def write(lock, page, chance):
    token = lock.begin_write()
    try:
        _, last, _, _, _, _ = PAGE.unpack_from(page)
        put(page, 2, token)
        if token < last:
            add(page, 4)
        put(page, 1, max(token, last))
        if chance.random() < 0.05:  # as on a slow bus: detects a defect reliably
            select.select([], [], [], 0.005)
        else:
            until_ns = time.monotonic_ns() + 50_000
            while time.monotonic_ns() < until_ns:
                pass
        if PAGE.unpack_from(page)[2] != token:
            add(page, 3)
        add(page, 5)
    finally:
        lock.end_write()


def work(folder, page, notes, chance, fault):
    plant(fault)
    lock = ProcessLock("lock", "the lock", LockDirectory(folder))
    runtime = WallRuntime()
    log = os.open(notes, os.O_WRONLY | os.O_APPEND)
    while not PAGE.unpack_from(page)[0]:
        on_demand = chance.random() < 0.6
        lease_s = chance.choice([None, 0.001, 0.003, 0.01])
        try:
            hold = lock.acquire(runtime, "x", 5.0, lease_s=lease_s, take_over=on_demand)
        except MotorBusyError:
            continue
        os.write(log, NOTE.pack(hold.token, hold.was_taken_over))
        try:
            for _ in range(chance.randrange(30)):
                write(lock, page, chance)
                if chance.random() < 0.2:
                    select.select([], [], [], chance.random() * 0.004)
        except MotorBusyError:
            pass
        finally:
            hold.release()


def told(page, notes, counts):
    """Return the results so far."""
    data = Path(notes).read_bytes()
    taken = [NOTE.unpack_from(data, at) for at in range(0, len(data), NOTE.size)]
    _, _, _, intruders, stale, writes = PAGE.unpack_from(page)
    return counts | {
        "turns": len(taken),
        "taken_over": sum(over for _, over in taken),
        "writes": writes,
        "intruders": intruders,
        "stale": stale,
        "repeated": len(taken) - len({token for token, _ in taken}),
    }


def run(seconds, seed, fault):
    wanted = FOUND[fault] if fault else ENOUGH
    page = mmap.mmap(-1, mmap.PAGESIZE)
    chance = random.Random(seed)
    counts = {"killed": 0, "paused": 0}
    with tempfile.TemporaryDirectory() as folder:
        notes = f"{folder}/notes"
        Path(notes).touch()
        born = 0

        def spawn():
            nonlocal born
            born += 1
            pid = os.fork()
            if pid:
                return pid
            status = 1
            try:
                work(folder, page, notes, random.Random(f"{seed}:{born}"), fault)
                status = 0
            except BaseException as error:
                print(f"worker {os.getpid()}: {error!r}", file=sys.stderr, flush=True)
            finally:
                os._exit(status)

        pids = [spawn() for _ in range(WORKERS)]
        end_s = time.monotonic() + seconds

        def is_over():
            late_s = time.monotonic() - end_s
            if late_s < 0.0:
                return False
            reached = told(page, notes, counts)
            return late_s > SPARE_S or all(reached[one] >= enough for one, enough in wanted.items())

        while not is_over():
            select.select([], [], [], 0.01)
            pid = chance.choice(pids)
            if chance.random() < 0.15:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                pids[pids.index(pid)] = spawn()
                counts["killed"] += 1
            else:
                os.kill(pid, signal.SIGSTOP)
                select.select([], [], [], 0.02)
                os.kill(pid, signal.SIGCONT)
                counts["paused"] += 1
        put(page, 0, 1)
        for pid in pids:
            os.waitpid(pid, 0)
        return told(page, notes, counts)


if __name__ == "__main__":
    print(json.dumps(run(float(sys.argv[1]), int(sys.argv[2]), "".join(sys.argv[3:]))))
