"""Premature ends of streams: stops, faults and losses."""

from collections.abc import Callable
from itertools import pairwise

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import MotorGroup
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.errors import DeviceFault, LinkError, MotionInterrupted
from motorhil.motorapi.state import MotorState
from tests.support.motors.drive_rigs import drive
from tests.support.motors.streaming import (
    INC_PER_RAD,
    LEFT,
    MS,
    RIGHT,
    Tap,
    demands,
    motor_of,
    quintic,
    set_function,
)

# --- stopping in mid-stream ----------------------------------------------------------------------


@pytest.mark.parametrize("how", ["stop", "halt", "quick_stop"])
@pytest.mark.parametrize(
    ("others", "offset_us"), [(False, 500), (True, 40), (True, 500), (True, 930), (True, 990)]
)
def test_stop_in_mid_stream_keeps_the_model_deceleration(
    rig: Rig, how: str, others: bool, offset_us: int
):
    """The stop comes at any moment between two SYNCs, with or without other users of SYNC.

    A set-point that waits for the next SYNC must not revoke it.
    """
    motor = set_function(motor_of(rig), quintic(2.0, 1.5))
    other = set_function(motor_of(rig, "right"), quintic(2.0, 1.5))
    MotorGroup(motor, other).start() if others else motor.start()
    rig.runtime.run_for(0.6 + offset_us * 1e-6)
    getattr(motor, how)()
    at = demands(rig, "left", 0.5)
    steps = [b - a for a, b in pairwise(at)]
    fastest = steps[0]
    assert 30 < fastest < 53  # about 2.2 rad/s, in increments per millisecond
    changes = [b - a for a, b in pairwise(steps)]
    limit = 10.0 * INC_PER_RAD * 1e-6  # acceleration_max of the model, here also deceleration
    assert min(changes) >= -limit - 2.0  # each demand is rounded: a second difference by at most 2
    assert max(changes) <= 2.0
    rested = next(k for k, step in enumerate(steps) if step == 0 and not any(steps[k:]))
    assert rested * 1e-3 == pytest.approx(fastest * 1e3 / INC_PER_RAD / 10.0, abs=0.01)
    motor.wait_until_done(timeout_s=2)
    assert motor.state() is (MotorState.STOPPED if how == "quick_stop" else MotorState.ENABLED)
    assert motor.hardware.stream is not None
    assert motor.hardware.stream.ended
    word = motor.hardware.read("controlword")
    assert word == (0x0002 if how == "quick_stop" else 0x010F)  # no set-point revoked it
    if others:
        other.wait_until_done(timeout_s=3)
        assert rig.controllers["right"].snapshot()["demand_inc"] == round(2.0 * INC_PER_RAD)
    still = rig.controllers["left"].snapshot()["demand_inc"]
    rig.runtime.run_for(0.5)
    assert rig.controllers["left"].snapshot()["demand_inc"] == still
    motor.enable()
    motor.start()  # and it works again
    motor.wait_until_done(timeout_s=3)
    assert rig.controllers["left"].snapshot()["demand_inc"] == pytest.approx(
        still + 2.0 * INC_PER_RAD, abs=1
    )


def test_stop_with_lost_frames_comes_with_the_set_points(rig: Rig):
    motor = set_function(motor_of(rig), quintic(2.0, 1.5))
    motor.start()
    rig.runtime.run_for(0.6005)  # between a set-point and the next SYNC
    for name, identifier in (("word", 0x201), ("set-point", LEFT)):
        rule = FaultRule(name=name, kind=FaultKind.DROP, identifier=identifier, limit=1)
        rig.faults.inject("can0", rule)
    motor.stop()
    rig.runtime.run_for(0.004)
    assert motor.hardware.stream.ended
    assert motor.hardware.node.bus.sync.period_ns is None
    assert motor.hardware.read("controlword") == 0x010F
    motor.wait_until_done(timeout_s=1)


def test_stop_by_another_logical_motor_ends_the_stream(rig: Rig):
    motor = set_function(motor_of(rig), quintic(2.0, 1.5))
    second = Cia402Motor(motor.hardware, motor.model, name="second")
    motor.start()
    rig.runtime.run_for(0.5)
    second.stop()
    with pytest.raises(MotionInterrupted, match=r"stop\(\) of second"):
        motor.wait_until_done(timeout_s=1)
    second.wait_until_done(timeout_s=2)
    assert motor.hardware.stream.ended
    assert rig.controllers["left"].snapshot()["velocity_rad_s"] == 0.0


def test_fault_in_mid_stream_ends_both(rig: Rig):
    motor = set_function(motor_of(rig), quintic(2.0, 1.5))
    motor.start()
    rig.runtime.run_for(0.5)
    rig.controllers["left"].stimulate("fault", 0x2310)
    with pytest.raises(DeviceFault, match="2310"):
        motor.wait_until_done(timeout_s=2)
    rig.runtime.run_for(0.1)
    assert motor.hardware.stream.ended
    assert motor.hardware.node.bus.sync.period_ns is None


def test_silent_drive_is_still_braked(rig: Rig):
    motor = set_function(motor_of(rig), quintic(4.0, 3.0))
    motor.start()
    rig.runtime.run_for(1.0)
    rule = FaultRule(name="deaf", kind=FaultKind.DROP, sender="left")
    rig.faults.inject("can0", rule)
    with pytest.raises(LinkError, match="no heartbeat"):
        motor.wait_until_done(timeout_s=2)
    at = demands(rig, "left", 0.5)
    steps = [b - a for a, b in pairwise(at)]
    assert steps[0] > 30
    assert steps[-1] == 0
    assert min(b - a for a, b in pairwise(steps)) >= -10.0 * INC_PER_RAD * 1e-6 - 2.0
    assert motor.hardware.stream.ended


def test_second_stream_does_not_disturb_the_first(rig: Rig):
    left = set_function(motor_of(rig), quintic(1.0, 1.0))
    right = set_function(motor_of(rig, "right"), quintic(-1.0, 1.0))
    tap = Tap(rig)
    left.start()
    rig.runtime.run_for(0.3)
    right.start()
    for motor in (left, right):
        motor.wait_until_done(timeout_s=3)
    for can_id, distance in ((LEFT, 1.0), (RIGHT, -1.0)):
        function = quintic(distance, 1.0)
        expected = [round(function.value(k * 1e-3) * INC_PER_RAD) for k in range(1001)]
        latched = tap.latched(can_id)
        assert [target for _, target in latched] == expected
        # SYNC wins every arbitration, but waits for a frame under way and for the host's own before
        # it: at most 0.135 ms each, two of them.
        assert all(abs(b - a - MS) <= 300_000 for (a, _), (b, _) in pairwise(latched))
    assert left.hardware.stream.late == right.hardware.stream.late == 0


def test_disable_ends_the_stream(rig: Rig):
    motor = set_function(motor_of(rig), quintic(2.0, 1.5))
    motor.start()
    rig.runtime.run_for(0.3)
    motor.stop()
    motor.wait_until_done(timeout_s=2)
    motor.start()
    rig.runtime.run_for(0.3)
    motor.disable()
    rig.runtime.run_for(0.1)
    assert motor.state() is MotorState.DISABLED
    assert motor.hardware.stream.ended


@pytest.mark.parametrize("distance", [0.1, 0.5])
def test_lost_sync_of_a_slow_stream_is_noticed_by_time(rig: Rig, distance: float):
    """The first one moves at 0.03 rad/s only."""
    motor = set_function(motor_of(rig), quintic(distance, 6.0))
    motor.start()
    rig.runtime.run_for(2.0)
    now_ns = rig.runtime.now_ns()
    lost = FaultRule("deaf", FaultKind.DROP, identifier=0x080, ports=("left",), from_ns=now_ns)
    rig.faults.inject("can0", lost)
    with pytest.raises(LinkError, match="stands still while its set-points move"):
        motor.wait_until_done(timeout_s=5)
    assert rig.runtime.now_ns() - now_ns <= 1_300 * MS  # a second at rest, after the servo settled


def test_lost_sync_of_an_oscillating_drive_is_noticed(open_rig: Callable[..., Rig]):
    """Behind an elastic gear with backlash, the encoder changes although the motor stands."""
    plant = (
        'plant = { preset = "wheel_60w", backlash_rad = 0.0003, coupling_stiffness_n_m_rad = '
        "2000.0, coupling_damping_n_m_s_rad = 5.0 }"
    )
    rig = open_rig(drive("left", 2, controller=plant))
    motor = set_function(motor_of(rig), quintic(3.0, 6.0))
    motor.start()
    rig.runtime.run_for(2.0)
    now_ns = rig.runtime.now_ns()
    lost = FaultRule("deaf", FaultKind.DROP, identifier=0x080, ports=("left",), from_ns=now_ns)
    rig.faults.inject("can0", lost)
    with pytest.raises(LinkError, match="stands still while its set-points move"):
        motor.wait_until_done(timeout_s=5)
    assert rig.runtime.now_ns() - now_ns <= 400 * MS


@pytest.mark.parametrize(("pause_s", "is_lost"), [(0.002, True), (0.6, False)])
def test_lost_sync_is_noticed_by_status_that_is_polled(
    open_rig: Callable[..., Rig], pause_s: float, is_lost: bool
):
    """A position that was read long ago does not accuse a drive that follows."""
    rig = open_rig(drive("left", 2, motor="status_period_ms = 0"))
    motor = set_function(motor_of(rig), quintic(3.0, 3.0))
    motor.start()
    rig.runtime.run_for(0.5)
    motor.position()
    rig.runtime.run_for(pause_s)
    if is_lost:
        now_ns = rig.runtime.now_ns()
        lost = FaultRule("deaf", FaultKind.DROP, identifier=0x080, ports=("left",), from_ns=now_ns)
        rig.faults.inject("can0", lost)
        with pytest.raises(LinkError, match="stands still while its set-points move"):
            motor.wait_until_done(timeout_s=5)
        assert rig.runtime.now_ns() - now_ns <= 400 * MS
    else:
        motor.wait_until_done(timeout_s=5)
