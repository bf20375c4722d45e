"""Turns within one process, and of several processes behind a lock."""

import pytest

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.motorapi.errors import MotorBusyError, UsageError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.ownership.queue import FifoQueue, share_trigger, trigger_turns
from motorhil.motorapi.runtime.wall import WallRuntime


@pytest.fixture
def runtime():
    return VirtualRuntime(EventQueue())


@pytest.fixture
def wall():
    there = WallRuntime()
    yield there
    there.close()


@pytest.fixture
def directory(tmp_path):
    tmp_path.chmod(0o700)
    return LockDirectory(tmp_path)


def test_turn_belongs_to_its_thread_and_increments_the_number(runtime):
    turns = FifoQueue("SYNC")
    assert not turns.is_mine
    for number in (1, 2):
        with turns.turn(runtime, "one"):
            assert turns.is_mine
            assert turns.number == number
    assert not turns.is_mine


def test_at_once_does_not_get_a_held_turn_in_any_thread(runtime):
    turns = FifoQueue("SYNC")
    with turns.turn(runtime, "one"), turns.at_once(runtime, "two") as is_ours:
        assert not is_ours
    with turns.at_once(runtime, "two") as is_ours:
        assert is_ours
        assert not turns.is_mine  # that of a callback: the waiter in this thread does not have it
        with pytest.raises(MotorBusyError, match="is held by two"):
            turns.turn(runtime, "three", 0.0).__enter__()
    assert turns.number == 2


def test_waiters_get_turns_in_the_order_of_requests(runtime):
    turns, had = FifoQueue("SYNC"), []

    def work(name):
        with turns.turn(runtime, name):
            had.append(name)
            runtime.wait_until(lambda: False, 0.1)

    parties = [runtime.spawn(name, lambda name=name: work(name)) for name in "abc"]
    for party in parties:
        assert party.join(1.0)
    assert had == ["a", "b", "c"]


def test_nested_turn_of_one_thread_raises(runtime):
    turns = FifoQueue("SYNC")
    with turns.turn(runtime, "one"), pytest.raises(UsageError, match="one is still active"):
        turns.turn(runtime, "two").__enter__()


def test_turn_behind_a_lock_belongs_to_one_process(wall, directory):
    ours = FifoQueue("SYNC of can0", ProcessLock("can0-sync", "SYNC of can0", directory))
    theirs = ProcessLock("can0-sync", "SYNC of can0", directory)  # as if another process had it
    with theirs.acquire(wall, "start() of theirs") as hold:
        with (
            pytest.raises(MotorBusyError, match=r"SYNC of can0 is held by pid .* for start\(\) of"),
            ours.turn(wall, "start() of ours", 0.0),
        ):
            pass
        with ours.at_once(wall, "ours") as is_ours:
            assert not is_ours
    with ours.turn(wall, "start() of ours"):
        assert ours.number == hold.token + 1
        assert theirs.look().holder.record.purpose == "start() of ours"
    assert theirs.look().holder is None
    assert not ours.died


def test_trigger_turns_have_one_order_in_all_processes(wall, directory):
    def turns(label, name):
        return FifoQueue(label, ProcessLock(name, label, directory))

    first, second = turns("SYNC of b", "bus1-sync"), turns("SYNC of a", "bus2-sync")
    share_trigger(wall, "b", first)
    share_trigger(wall, "a", second)
    share_trigger(wall, "the same bus by another path", first)
    groups = ["a", "b", "the same bus by another path"]
    assert trigger_turns(wall, groups) == [first, second]  # by the name in all processes
    assert trigger_turns(wall, groups[::-1]) == [first, second]


def test_unshared_trigger_has_turns_while_they_are_used(runtime):
    (one,) = trigger_turns(runtime, ["ideal"])
    assert trigger_turns(runtime, ["ideal"]) == [one]
