"""Conditions of a group start: met, or refused before any motor is armed."""

import pickle

import pytest

from motorhil.motorapi import (
    LinkError,
    SynchronizationError,
    SyncLevel,
    UsageError,
)
from tests.support.motors.plain import PlainBus, PlainHwMotor, PlainMotor
from tests.unit.motorapi.test_group import group_of, hooks


@pytest.fixture
def near(runtime):
    """Return motors of one trigger; the second begins 1 to 3 ms after it: 2 ms apart at most."""
    bus = PlainBus()
    return [
        PlainMotor(PlainHwMotor(runtime, node, bus, latency_s=latency_s))
        for node, latency_s in ((1, 0.001), (2, 0.003))
    ]


@pytest.fixture
def apart(runtime):
    """Return motors with own triggers, of unknown duration."""
    return [PlainMotor(PlainHwMotor(runtime, node, PlainBus(f"bus{node}"))) for node in (1, 2)]


def refused(motors, **asked):
    group = group_of(motors, 1.0, 2.0)
    with pytest.raises(SynchronizationError) as caught:
        group.start(**asked)
    for motor in motors:
        assert hooks(motor) == []  # neither armed nor even enabled
    return caught.value


def test_satisfied_conditions_permit_the_start(near):
    group = group_of(near, 1.0, 2.0)
    # 2 ms except for floating-point error: 0.003 - 0.001
    group.start(require=SyncLevel.TRIGGERED, max_skew_s=0.002 + 1e-15)
    group.wait_until_done()
    assert group.sync_quality().start_skew_s == 0.002


def test_level_not_reached_raises_with_the_weakest_motor(apart):
    error = refused(apart, require=SyncLevel.TRIGGERED)
    assert error.capability.level is SyncLevel.SEQUENTIAL
    assert error.capability.weakest == "m2"
    assert "at least TRIGGERED was requested, and it is SEQUENTIAL because of m2" in str(error)
    assert "bus2" in str(error)
    assert isinstance(error, UsageError)


def test_larger_possible_skew_raises_with_its_value(near):
    error = refused(near, max_skew_s=0.0019)
    assert "start skew of at most 0.0019 s was requested, and it may be 0.002 s" in str(error)
    assert error.capability.start_skew_s == pytest.approx(0.002, abs=1e-15)


def test_skew_without_a_bound_raises_for_any_limit(apart):
    error = refused(apart, max_skew_s=1e9)
    assert error.capability.start_skew_s is None
    assert "there is no bound" in str(error)


def test_synchronization_error_pickles(near):
    error = refused(near, max_skew_s=0.001)
    copy = pickle.loads(pickle.dumps(error))
    assert (str(copy), copy.capability, copy.asked) == (str(error), error.capability, error.asked)


@pytest.mark.parametrize(
    "asked",
    [{"require": 1}, {"require": "TRIGGERED"}, {"max_skew_s": -1.0}, {"max_skew_s": float("nan")}],
)
def test_invalid_conditions_raise(near, asked):
    with pytest.raises(UsageError, match=next(iter(asked))):
        group_of(near, 1.0, 2.0).start(**asked)
    assert hooks(near[0]) == []


def test_motor_that_does_not_answer_raises_its_own_error(near):
    near[1].hw.fail["_connect"] = LinkError(link="bus0 node 2", reason="silent")
    with pytest.raises(LinkError, match="silent"):
        group_of(near, 1.0, 2.0).start(require=SyncLevel.CYCLIC)
