"""Takeover of a lock from living processes: paused, stalled, or holding it."""

import json
import os
import signal
import subprocess
import sys
from itertools import pairwise

import pytest

from motorhil.motorapi.errors import MotorBusyError
from tests.support.programs.takeover_stress import ENOUGH
from tests.system.wall.sharing.test_process_lock import (
    LONG_S,
    base,
    holder_pid,
    lock,
    programs,
    until_waiting,
    wall,
)

__all__ = ["base", "lock", "programs", "wall"]

pytestmark = pytest.mark.wall

LEASE_S = 1.0
LONG_LEASE_S = 3.0  # renewed every tenth of it: a busy machine may stand still for the rest


def pause(wall, lock, program):
    program.signal(signal.SIGSTOP)
    assert wall.wait_until(lambda: lock.look().holder.is_paused, LONG_S)


def test_paused_process_loses_the_lock_and_cannot_write(programs, lock, wall, base):
    holder = programs()
    assert holder.ask("take thinking") == "has 1 True"
    assert holder.ask("write") == "wrote 1"
    pause(wall, lock, holder)
    with pytest.raises(
        MotorBusyError, match=rf"paused.*; continue it \(kill -CONT {holder.pid}\), or end it"
    ):
        lock.acquire(wall, "mine", timeout_s=0.05)
    hold = lock.acquire(wall, "rescue", take_over=True)
    assert (hold.token - base, hold.was_taken_over, hold.was_abandoned) == (2, True, False)
    assert hold.taken_from == f"pid {holder.pid} (lock_holder.py)"
    assert holder_pid(lock) == os.getpid()
    assert lock.begin_write() == hold.token
    lock.end_write()
    holder.signal(signal.SIGCONT)
    told = holder.ask("write")
    assert told.startswith(f"busy the pan was taken over (on demand) by pid {os.getpid()} (")
    assert " for rescue since 2" in told
    assert holder.ask("renew") == told.replace("write", "renew") or "taken over" in told
    assert holder.ask("held").startswith(f"held False, lost to pid {os.getpid()} (")
    assert holder.ask("release") == "released"
    assert lock.look().holder.record.number == hold.token  # the loser's actions touched nothing
    assert lock.begin_write() == hold.token
    lock.end_write()
    assert holder.ask("take again").startswith(f"busy the pan is held by pid {os.getpid()} (")
    hold.release()
    assert holder.ask("take again") == "has 3 True"


def test_lease_lasts_while_used_and_passes_on_when_paused(programs, lock, wall):
    holder, first, second = programs(3)
    for one in (first, second):
        assert one.ask("write").startswith("busy")  # it exists
    assert holder.ask(f"lease driving {LONG_LEASE_S}") == "has 1 True"
    first.say(f"take first {LONG_S}")
    until_waiting(wall, lock, [first.pid])
    second.say(f"take second {LONG_S}")
    until_waiting(wall, lock, [first.pid, second.pid])
    for word in ("renew", "write") * 6:
        wall.wait_until(lambda: False, LONG_LEASE_S / 10)
        assert holder.ask(word).startswith(("renewed", "wrote 1"))
    assert holder_pid(lock) == holder.pid
    pause(wall, lock, holder)
    assert first.hear() == "has 2 True"
    assert holder_pid(lock) == first.pid
    until_waiting(wall, lock, [second.pid])
    holder.signal(signal.SIGCONT)
    reason = f"its lease of {LONG_LEASE_S:g} s was over"
    for word in ("write", "renew"):
        told = holder.ask(word)
        assert told.startswith(f"busy the pan was taken over ({reason}) by pid {first.pid} (")
    assert first.ask("release") == "released"
    assert second.hear() == "has 3 True"


def test_holder_paused_within_a_write_is_named_and_keeps_it(programs, lock, wall, base):
    holder = programs()
    holder.ask(f"lease driving {LEASE_S}")
    assert holder.ask("begin") == "began"
    pause(wall, lock, holder)
    wall.wait_until(lambda: False, LEASE_S)
    words = rf"held by pid {holder.pid} \(lock_holder.py, paused\), in the middle of a write"
    for take_over in (False, True):
        with pytest.raises(MotorBusyError, match=words):
            lock.acquire(wall, "rescue", timeout_s=0.1, take_over=take_over)
    assert lock.look().is_writing
    holder.signal(signal.SIGCONT)
    assert holder.ask("end") == "ended"
    hold = lock.acquire(wall, "rescue", take_over=True)
    assert hold.token == base + 2
    assert holder.ask("begin").startswith("busy")


def test_repeated_takeover_names_the_taker_to_each_loser(programs, lock, wall):
    several = programs(5)
    assert several[0].ask("take p0") == "has 1 True"
    for number, one in enumerate(several[1:], 1):
        assert one.ask(f"over p{number}") == f"has {number + 1} True"
        assert holder_pid(lock) == one.pid
    for one, taker in pairwise(several):
        assert f"by pid {taker.pid} (" in one.ask("write")
    assert several[-1].ask("write") == "wrote 5"
    several[-1].kill()
    hold = lock.acquire(wall, "mine")
    assert hold.was_abandoned
    assert not hold.was_taken_over


def test_killed_taker_leaves_the_lock_to_the_next(programs, lock, wall, base):
    holder, taker = programs(2)
    holder.ask("take a")
    pause(wall, lock, holder)
    assert taker.ask("over b") == "has 2 True"
    taker.kill()
    assert lock.look().abandoned == base + 2
    with lock.acquire(wall, "c") as hold:
        assert (hold.token, hold.was_abandoned) == (base + 3, True)
    holder.signal(signal.SIGCONT)
    assert f"by pid {taker.pid} (lock_holder.py) for b" in holder.ask("write")
    assert holder.ask("take a").startswith("has 4 ")


def test_waiters_behind_a_paused_holder_are_prompt_after_it(programs, lock, wall):
    holder, waits = programs(2)
    holder.ask("take a")
    pause(wall, lock, holder)
    waits.say(f"take w {LONG_S}")
    until_waiting(wall, lock, [waits.pid])
    hold = lock.acquire(wall, "rescue", take_over=True)
    until_waiting(wall, lock, [waits.pid])
    hold.release()
    assert waits.hear() == "has 3 True"
    assert waits.ask("release") == "released"
    holder.signal(signal.SIGCONT)
    assert holder.ask("held").startswith("held False")


def test_taker_killed_at_any_step_leaves_it_held_or_abandoned(programs, lock, wall):
    holder = programs()
    outcomes = []
    for step in range(1, 40):
        taken = holder.ask("take a").split()
        assert taken[0] == "has"
        died = holder.ask(f"dies {step}") == "died"
        wrote = holder.ask("write")
        view = lock.look()
        if wrote == f"wrote {taken[1]}":
            outcomes.append("as it was")
            assert died
            assert view.holder.record.pid == holder.pid
            assert not view.abandoned
            assert not view.is_writing
        else:
            outcomes.append("abandoned")
            assert " for dying since " in wrote
            assert view.holder is None
            assert view.abandoned
        assert holder.ask("release") == "released"
        with lock.acquire(wall, "next") as hold:
            assert hold.was_abandoned == (outcomes[-1] == "abandoned")
            with lock.acquire(wall, "over it", owner=object(), take_over=True) as over:
                assert over.token > hold.token
        if not died:
            break
    assert not died
    assert outcomes[0] == "as it was"
    assert outcomes == sorted(outcomes, reverse=True)  # one step decides
    assert outcomes.count("as it was") >= 5
    assert outcomes.count("abandoned") >= 2


def stress(seconds, seed, fault=""):
    words = [
        sys.executable,
        "-m",
        "tests.support.programs.takeover_stress",
        str(seconds),
        str(seed),
        fault,
    ]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert done.stderr == "", done.stderr
    return json.loads(done.stdout)


def test_one_writes_at_a_time_under_pauses_kills_takeovers():
    told = stress(2.0, 1)
    assert (told["intruders"], told["stale"], told["repeated"]) == (0, 0, 0)
    assert all(told[one] >= enough for one, enough in ENOUGH.items()), told


def test_stress_detects_a_write_open_to_takeovers():
    assert stress(0.0, 1, "no fence")["intruders"] > 0


def test_stress_detects_a_write_without_epoch_check():
    assert stress(0.0, 3, "no look")["stale"] > 0
