"""A start that is asked to be close enough is, or is refused before anything is armed."""

import pickle

import pytest

from motorapi import (
    LinkError,
    SynchronizationError,
    SyncLevel,
    UsageError,
)
from tests.motorapi.plain import PlainBus, PlainHwMotor, PlainMotor
from tests.motorapi.test_group import group_of, hooks


@pytest.fixture
def near(runtime):
    """One trigger; the second begins 1 to 3 ms after it, so 2 ms may lie between them."""
    bus = PlainBus()
    return [
        PlainMotor(PlainHwMotor(runtime, node, bus, latency_s=latency_s))
        for node, latency_s in ((1, 0.001), (2, 0.003))
    ]


@pytest.fixture
def apart(runtime):
    """Each has a trigger of its own, and how long firing takes nobody knows."""
    return [PlainMotor(PlainHwMotor(runtime, node, PlainBus(f"bus{node}"))) for node in (1, 2)]


def refused(motors, **asked):
    group = group_of(motors, 1.0, 2.0)
    with pytest.raises(SynchronizationError) as caught:
        group.start(**asked)
    for motor in motors:
        assert hooks(motor) == []  # neither armed nor even enabled
    return caught.value


def test_what_can_be_met_starts(near):
    group = group_of(near, 1.0, 2.0)
    # 2 ms but for floating point: 0.003 - 0.001
    group.start(require=SyncLevel.TRIGGERED, max_skew_s=0.002 + 1e-15)
    group.wait_until_done()
    assert group.sync_quality().start_skew_s == 0.002


def test_a_level_that_is_not_reached_is_refused_with_the_weakest_and_why(apart):
    error = refused(apart, require=SyncLevel.TRIGGERED)
    assert error.capability.level is SyncLevel.SEQUENTIAL
    assert error.capability.weakest == "m2"
    assert "at least TRIGGERED was asked for, and it is SEQUENTIAL because of m2" in str(error)
    assert "bus2" in str(error)
    assert isinstance(error, UsageError)


def test_a_skew_that_may_be_larger_is_refused_and_says_how_large(near):
    error = refused(near, max_skew_s=0.0019)
    assert "start skew of at most 0.0019 s was asked for, and it may be 0.002 s" in str(error)
    assert error.capability.start_skew_s == pytest.approx(0.002, abs=1e-15)


def test_a_skew_without_a_bound_is_refused_whatever_is_allowed(apart):
    error = refused(apart, max_skew_s=1e9)
    assert error.capability.start_skew_s is None
    assert "there is no bound" in str(error)


def test_the_error_travels_between_processes(near):
    error = refused(near, max_skew_s=0.001)
    copy = pickle.loads(pickle.dumps(error))
    assert (str(copy), copy.capability, copy.asked) == (str(error), error.capability, error.asked)


@pytest.mark.parametrize(
    "asked",
    [{"require": 1}, {"require": "TRIGGERED"}, {"max_skew_s": -1.0}, {"max_skew_s": float("nan")}],
)
def test_what_cannot_be_asked_is_refused(near, asked):
    with pytest.raises(UsageError, match=next(iter(asked))):
        group_of(near, 1.0, 2.0).start(**asked)
    assert hooks(near[0]) == []


def test_a_motor_that_does_not_answer_says_so_itself(near):
    near[1].hw.fail["_connect"] = LinkError(link="bus0 node 2", reason="silent")
    with pytest.raises(LinkError, match="silent"):
        group_of(near, 1.0, 2.0).start(require=SyncLevel.CYCLIC)
