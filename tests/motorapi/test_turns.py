"""Turns of one process, and of several behind a lock."""

import pytest

from emulators.event_queue import EventQueue
from harness.virtual_time import VirtualRuntime
from motorapi.errors import MotorBusyError, UsageError
from motorapi.lock_directory import LockDirectory
from motorapi.process_lock import ProcessLock
from motorapi.turns import Turns, share_trigger, trigger_turns
from motorapi.wall_runtime import WallRuntime


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


def test_a_turn_is_its_threads_and_grows_a_number(runtime):
    turns = Turns("SYNC")
    assert not turns.is_mine
    for number in (1, 2):
        with turns.turn(runtime, "one"):
            assert turns.is_mine
            assert turns.number == number
    assert not turns.is_mine


def test_who_wants_it_at_once_does_not_get_what_somebody_has_not_even_in_his_thread(runtime):
    turns = Turns("SYNC")
    with turns.turn(runtime, "one"), turns.at_once(runtime, "two") as is_ours:
        assert not is_ours
    with turns.at_once(runtime, "two") as is_ours:
        assert is_ours
        assert not turns.is_mine  # a callback's: whoever waits in this thread has nothing of it
        with pytest.raises(MotorBusyError, match="is held by two"):
            turns.turn(runtime, "three", 0.0).__enter__()
    assert turns.number == 2


def test_those_who_wait_have_it_in_the_order_of_asking(runtime):
    turns, had = Turns("SYNC"), []

    def work(name):
        with turns.turn(runtime, name):
            had.append(name)
            runtime.wait_until(lambda: False, 0.1)

    parties = [runtime.spawn(name, lambda name=name: work(name)) for name in "abc"]
    for party in parties:
        assert party.join(1.0)
    assert had == ["a", "b", "c"]


def test_a_turn_within_a_turn_of_the_same_thread_is_a_mistake(runtime):
    turns = Turns("SYNC")
    with turns.turn(runtime, "one"), pytest.raises(UsageError, match="one is still at work"):
        turns.turn(runtime, "two").__enter__()


def test_behind_a_lock_the_turn_is_that_of_one_process(wall, directory):
    ours = Turns("SYNC of can0", ProcessLock("can0-sync", "SYNC of can0", directory))
    theirs = ProcessLock("can0-sync", "SYNC of can0", directory)  # as another process has it
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


def test_turns_of_several_triggers_are_taken_in_one_order_for_all_processes(wall, directory):
    def turns(label, name):
        return Turns(label, ProcessLock(name, label, directory))

    first, second = turns("SYNC of b", "bus1-sync"), turns("SYNC of a", "bus2-sync")
    share_trigger(wall, "b", first)
    share_trigger(wall, "a", second)
    share_trigger(wall, "the same bus by another path", first)
    groups = ["a", "b", "the same bus by another path"]
    assert trigger_turns(wall, groups) == [first, second]  # by what all processes call them
    assert trigger_turns(wall, groups[::-1]) == [first, second]


def test_a_trigger_that_nobody_shares_has_turns_as_long_as_somebody_takes_them(runtime):
    (one,) = trigger_turns(runtime, ["ideal"])
    assert trigger_turns(runtime, ["ideal"]) == [one]
