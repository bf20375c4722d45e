"""The lock between processes, with unrelated processes."""

import contextlib
import os
import signal
from pathlib import Path

import pytest

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.motorapi.errors import MotorBusyError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.runtime.wall import WallRuntime
from tests.support.line_programs import Program

pytestmark = pytest.mark.wall

LONG_S = 20.0


@pytest.fixture
def base(tmp_path, wall):
    """Return the token before the first; programs count their tokens from it."""
    lock = ProcessLock("pan", "the pan", LockDirectory(tmp_path))
    with lock.acquire(wall, "before everything") as hold:
        return hold.token


@pytest.fixture
def programs(tmp_path, base):
    """Start programs; end all of them afterwards."""
    started = []

    def start(count=1):
        new = [Program("lock_holder", tmp_path, "pan", base) for _ in range(count)]
        started.extend(new)
        return new if count > 1 else new[0]

    yield start
    for program in started:
        program.end()


@pytest.fixture
def wall():
    runtime = WallRuntime()
    yield runtime
    runtime.close()


@pytest.fixture
def lock(tmp_path):
    return ProcessLock("pan", "the pan", LockDirectory(tmp_path))


def until_waiting(wall, lock, pids):
    """Let these programs wait in the queue, in this order, until they have confirmed it."""

    def waiting():
        records = [one.record for _, one in lock.look().waiters]
        return [one and one.pid for one in records] == pids

    assert wall.wait_until(waiting, LONG_S), lock.look()


def holder_pid(lock):
    holder = lock.look().holder
    return holder and holder.record and holder.record.pid


def test_second_process_is_refused_naming_the_holder(programs, lock, wall, base):
    drive = programs()
    assert drive.ask("take driving") == "has 1 True"
    with pytest.raises(MotorBusyError) as caught:
        lock.acquire(wall, "looking around")
    error = caught.value
    assert (error.pid, error.program, error.purpose) == (drive.pid, "lock_holder.py", "driving")
    assert error.motor == "the pan"
    assert error.since_ns <= wall.now_ns()
    assert str(error).startswith(
        f"the pan is held by pid {drive.pid} (lock_holder.py) for driving since 2"
    )
    assert drive.ask("release") == "released"
    hold = lock.acquire(wall, "looking around")
    assert (hold.token - base, hold.changed_hands) == (2, True)
    refused = drive.ask("take driving")
    assert refused.startswith(f"busy the pan is held by pid {os.getpid()} (")
    assert ") for looking around since 2" in refused
    hold.release()
    assert not lock.acquire(wall, "again").changed_hands  # only one was refused meanwhile


def test_waiting_processes_are_served_in_order(programs, lock, wall):
    waiting = programs(8)
    hold = lock.acquire(wall, "first")
    for number, one in enumerate(waiting):
        one.say(f"take w{number} {LONG_S}")
        until_waiting(wall, lock, [other.pid for other in waiting[: number + 1]])
    hold.release()
    for number, one in enumerate(waiting):
        assert one.hear() == f"has {number + 2} True"
        assert holder_pid(lock) == one.pid
        until_waiting(wall, lock, [other.pid for other in waiting[number + 1 :]])
        assert one.ask("release") == "released"
    assert lock.look().holder is None


def test_killed_holder_and_killed_waiters_are_passed_over(programs, lock, wall, base):
    holder, dies, lives, last = waiting = programs(4)
    assert holder.ask("take holding") == "has 1 True"
    for number, one in enumerate(waiting[1:]):
        one.say(f"take w {LONG_S}")
        until_waiting(wall, lock, [other.pid for other in waiting[1 : number + 2]])
    dies.kill()
    until_waiting(wall, lock, [lives.pid, last.pid])
    holder.kill()
    assert lives.hear() == "has 2 True"
    assert holder_pid(lock) == lives.pid
    lives.kill()
    assert last.hear() == "has 3 True"
    last.kill()
    assert lock.look().holder is None  # at once: never stale
    assert lock.acquire(wall, "mine").token == base + 4


def test_paused_holder_is_named_and_keeps_the_lock(programs, lock, wall):
    holder = programs()
    holder.ask("take thinking")
    holder.signal(signal.SIGSTOP)
    assert wall.wait_until(lambda: lock.look().holder.is_paused, LONG_S)
    with pytest.raises(MotorBusyError, match=rf"pid {holder.pid} \(lock_holder.py, paused\)"):
        lock.acquire(wall, "mine", timeout_s=0.05)
    holder.signal(signal.SIGCONT)
    assert holder.ask("release") == "released"
    lock.acquire(wall, "mine").release()


def test_waiter_paused_when_its_turn_comes_is_named(programs, lock, wall):
    waits, behind = programs(2)
    hold = lock.acquire(wall, "first")
    waits.say(f"take dozing {LONG_S}")
    until_waiting(wall, lock, [waits.pid])
    waits.signal(signal.SIGSTOP)
    assert wall.wait_until(lambda: lock.look().waiters[0][1].is_paused, LONG_S)
    hold.release()
    refused = behind.ask("take x 0.1")
    assert f"held by pid {waits.pid} (lock_holder.py, paused) for dozing" in refused
    waits.signal(signal.SIGCONT)
    assert waits.hear() == "has 2 True"


def test_abandoned_wait_leaves_no_place_behind(programs, lock, wall):
    gives_up, stays = programs(2)
    hold = lock.acquire(wall, "first")
    assert gives_up.ask("take a 0.05").startswith("busy the pan is held by pid ")
    assert lock.look().waiters == ()
    stays.say(f"take b {LONG_S}")
    until_waiting(wall, lock, [stays.pid])
    gives_up.say(f"take a {LONG_S}")
    until_waiting(wall, lock, [stays.pid, gives_up.pid])
    hold.release()
    assert stays.hear() == "has 2 True"
    assert stays.ask("release") == "released"
    assert gives_up.hear() == "has 3 True"


@pytest.mark.parametrize("how", ["fork", "child"])
def test_child_of_a_dead_holder_does_not_keep_the_lock(programs, lock, wall, how):
    holder = programs()
    holder.ask("take a")
    child = int(holder.ask(how).split()[1])
    try:
        assert holder_pid(lock) == holder.pid
        holder.kill()
        lock.acquire(wall, "mine", timeout_s=LONG_S)
        assert Path(f"/proc/{child}").exists()
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)


@pytest.mark.parametrize("held", [True, False])
def test_forked_child_is_another_process_without_the_lock(programs, lock, held):
    parent = programs()
    parent.ask("take a")
    if not held:
        parent.ask("release")
    _, pid, answer = parent.ask("fork_take b").split(maxsplit=2)
    child = int(pid)
    try:
        if held:
            assert answer.startswith(f"busy the pan is held by pid {parent.pid} ")
        else:
            assert answer == "has 2 True"
            assert holder_pid(lock) == child
    finally:
        os.kill(child, signal.SIGKILL)


def test_virtual_runtime_refuses_a_lock_of_another_process(programs, lock, wall):
    holder = programs()
    holder.ask("take a")
    virtual = VirtualRuntime(EventQueue())
    with pytest.raises(MotorBusyError, match=f"held by pid {holder.pid} "):
        lock.acquire(virtual, "mine", timeout_s=10.0)
    assert virtual.now_ns() == 0
    assert lock.look().waiters == ()
