"""Streamed velocity trajectories, and trajectories over other arguments."""

from itertools import pairwise
from math import pi, sin

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import TrapezoidalTrajectory
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import LimitError, StateError, UsageError
from motorhil.motorapi.functions import Constant, Cosine, Polynomial
from motorhil.motorapi.state import MotorState
from motorhil.motorapi.trajectory import ComplexTrajectory, MotorPosition
from tests.support.motors.drive_rigs import drive
from tests.support.motors.streaming import (
    EVERY_MS,
    INC_PER_RAD,
    LEFT,
    Jumps,
    OpenRig,
    Tap,
    demands,
    motor_of,
    quintic,
    set_function,
)

# --- velocity, by its integral -------------------------------------------------------------------


def test_velocity_trajectory_follows_its_integral(rig: Rig):
    """v = 1 - cos(2 pi t) over 2 s: 2 rad; the position at any time is t - sin(2 pi t) / 2 pi."""
    function = (Constant(1.0) - Cosine(1.0, 2 * pi)).restricted(0.0, 2.0)
    motor = set_function(motor_of(rig), function, ControlVariable.VELOCITY, relative=False)
    tap = Tap(rig)
    motor.start()
    motor.wait_until_done(timeout_s=3)
    expected = [k * 1e-3 - sin(2 * pi * k * 1e-3) / (2 * pi) for k in range(2001)]
    targets = [target for _, target in tap.latched(LEFT)]
    # The last bit of the sum decides between an integer and a half: rounding of one increment.
    off = [target - x * INC_PER_RAD for target, x in zip(targets, expected, strict=True)]
    assert max(abs(one) for one in off) <= 0.5 + 1e-6
    rig.runtime.run_for(0.2)
    assert rig.controllers["left"].snapshot()["velocity_rad_s"] == 0.0
    assert motor.hardware.stream.ended


def test_velocity_trajectory_with_nonzero_end_continues(rig: Rig):
    ramp = Polynomial((0.0, 0.0, 3.0, -2.0)).restricted(0.0, 1.0)  # 0 to 1 rad/s
    motor = set_function(motor_of(rig), ramp, ControlVariable.VELOCITY, relative=False)
    motor.start()
    motor.wait_until_done(timeout_s=2)
    before = rig.controllers["left"].snapshot()
    rig.runtime.run_for(2.0)
    after = rig.controllers["left"].snapshot()
    assert after["demand_inc"] - before["demand_inc"] == pytest.approx(2.0 * INC_PER_RAD, abs=2)
    motor.stop()
    motor.wait_until_done(timeout_s=2)
    assert rig.controllers["left"].snapshot()["velocity_rad_s"] == 0.0
    assert motor.hardware.stream.ended


def test_velocity_over_another_argument_is_integrated(rig: Rig):
    """v = x, and x comes to grow by 1 per second: the distance is the integral of x over time."""
    motor, argument = motor_of(rig), Jumps()
    line = Polynomial((0.0, 1.0)).restricted(0.0, 1.0)
    motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
    motor.set_trajectory(ComplexTrajectory(line), argument)
    motor.start()
    way = [0.0]

    def go_on() -> None:
        argument.now += 1e-3
        way[0] += min(argument.now, 1.0) * 1e-3

    ramp = rig.runtime.every(1e-3, go_on)
    motor.wait_until_done(timeout_s=3)
    rig.runtime.run_for(1.0)  # it continues at its final 1 rad/s
    at = rig.controllers["left"].snapshot()["demand_inc"]
    ramp.cancel()
    # read up to 1 ms ago, latched 1 ms later, reached 1 to 2 ms after that, in a tick up to 1 ms
    # ago: 5 ms at 1 rad/s
    assert 0.0 <= way[0] * INC_PER_RAD - at <= 5e-3 * INC_PER_RAD
    motor.stop()
    motor.wait_until_done(timeout_s=2)


def test_velocity_function_must_begin_at_rest(rig: Rig):
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(1.0)
    motor.start()
    motor.wait_until_done(timeout_s=2)
    rig.runtime.run_for(0.2)
    ramp = Polynomial((1.0, 0.0, 3.0, -2.0)).restricted(0.0, 1.0)  # from 1 to 2 rad/s
    set_function(motor, ramp, ControlVariable.VELOCITY, relative=False)
    with pytest.raises(StateError, match="changes to csp at rest"):
        motor.start()
    rig.runtime.run_for(0.2)
    assert rig.controllers["left"].snapshot()["velocity_rad_s"] == pytest.approx(1.0, abs=0.05)
    motor.stop()


def test_simple_velocity_trajectory_uses_the_drives_ramp(rig: Rig):
    """From 0 to 2 rad/s in 0.8 s, then to -1 rad/s in 1.5 s: pv, with equal ramps up and down."""
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
    rates = []
    for final, duration_s in ((2.0, 0.8), (-1.0, 1.5)):
        motor.set_trajectory(
            TrapezoidalTrajectory(final, initial=2.0 * (final < 0), duration_s=duration_s)
        )
        motor.start()
        began = rig.controllers["left"].snapshot()["velocity_rad_s"]
        rig.runtime.run_for(duration_s / 2)
        half = rig.controllers["left"].snapshot()["velocity_rad_s"]
        rates.append((half - began) / (duration_s / 2))
        motor.wait_until_done(timeout_s=3)  # as soon as it is within the drive's velocity window
        rig.runtime.run_for(0.1)
        assert rig.controllers["left"].snapshot()["velocity_rad_s"] == pytest.approx(
            final, abs=0.03
        )
    assert rates == pytest.approx([2.5, -2.0], rel=0.02)
    motor.stop()


# --- over another motor's position ---------------------------------------------------------------

GEAR = Polynomial((0.0, 0.5)).restricted(-10.0, 10.0)  # half as far as the leader
LEADER = "status_period_ms = 1\nstatus_inhibit_ms = 0\nset_point_period_ms = 1"


@pytest.fixture
def geared(open_rig: OpenRig) -> Rig:
    """Return a rig whose right motor may follow the left one, which sends every millisecond."""
    return open_rig(drive("left", 1, motor=LEADER), drive("right", 2, motor=EVERY_MS))


def test_motor_follows_another_like_a_gear(geared: Rig):
    left, right = motor_of(geared), motor_of(geared, "right")
    left.enable()
    assert left.position() == 0.0  # this also makes its units known
    cam = GEAR.restricted(-10.0, 1.0)
    set_function(right, cam, argument=MotorPosition(left))
    right.start()
    left.set_control_mode(ControlMode.TRAJECTORY)
    left.set_trajectory(TrapezoidalTrajectory(-0.5))
    left.start()
    worst = 0.0
    for _ in range(30):
        geared.runtime.run_for(0.02)
        leads = geared.controllers["left"].snapshot()["position_rad"]
        follows = geared.controllers["right"].snapshot()["position_rad"]
        worst = max(worst, abs(follows - 0.5 * leads))
    left.wait_until_done(timeout_s=2)
    # A value measured up to 1 ms ago is sent, latched 1 ms later and reached 1 to 2 ms after that.
    assert worst <= 0.5 * 3.0 * 4.5e-3 + 5 / INC_PER_RAD
    assert not right.is_done()  # the cam ends at 1 rad only
    left.set_trajectory(TrapezoidalTrajectory(1.6))
    left.start()
    right.wait_until_done(timeout_s=3)
    left.wait_until_done(timeout_s=3)
    assert geared.controllers["right"].snapshot()["demand_inc"] == pytest.approx(
        0.5 * INC_PER_RAD, abs=1
    )  # where the cam ends, half of 1 rad
    assert right.hardware.stream.ended


def test_leader_velocity_limit_is_checked_before_start(geared: Rig):
    """Its model says 3 rad/s: five times that is more than the follower's 3 rad/s."""
    left, right = motor_of(geared), motor_of(geared, "right")
    steep = Polynomial((0.0, 5.0)).restricted(-10.0, 10.0)
    with pytest.raises(LimitError, match="at the maximum rate of the position of left"):
        set_function(right, steep, argument=MotorPosition(left))
    assert right.state() is MotorState.OFFLINE


def test_argument_step_beyond_limits_stops_the_motion(rig: Rig):
    motor, argument = motor_of(rig), Jumps()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    line = Polynomial((0.0, 1.0)).restricted(0.0, 10.0)
    motor.set_trajectory(ComplexTrajectory(line, relative=True), argument)
    motor.start()

    def go_on() -> None:  # up to 1 rad/s, at 5 rad/s2
        argument.rate = min(argument.rate + 5e-3, 1.0)
        argument.now += argument.rate * 1e-3

    ramp = rig.runtime.every(1e-3, go_on)
    rig.runtime.run_for(0.5)
    assert not motor.is_done()
    argument.now += 1.0
    at = demands(rig, "left", 0.4)
    ramp.cancel()
    steps = [b - a for a, b in pairwise(at)]
    changes = [b - a for a, b in pairwise(steps)]
    assert steps[-1] == 0
    assert min(changes) >= -10.0 * INC_PER_RAD * 1e-6 - 2.0
    assert max(steps) <= 23  # 1 rad/s: the step was never followed
    with pytest.raises(
        LimitError, match=r"of something steps: set-points are 1 ms .*status_period_ms"
    ):
        motor.wait_until_done(timeout_s=1)
    assert motor.hardware.stream.ended
    motor.set_trajectory(ComplexTrajectory(quintic(0.5, 0.7), relative=True))
    motor.start()
    motor.wait_until_done(timeout_s=3)


def test_argument_that_becomes_too_fast_stops_the_motion(rig: Rig):
    """The argument promises 1 rad/s at most, and exceeds the motor's 3 rad/s smoothly."""
    motor, argument = motor_of(rig), Jumps()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    line = Polynomial((0.0, 1.0)).restricted(0.0, 10.0)
    motor.set_trajectory(ComplexTrajectory(line, relative=True), argument)
    motor.start()

    def go_on() -> None:
        argument.rate += 8e-3
        argument.now += argument.rate * 1e-3

    ramp = rig.runtime.every(1e-3, go_on)
    with pytest.raises(LimitError, match=r"velocity 3\.0"):
        motor.wait_until_done(timeout_s=2)
    ramp.cancel()


def test_start_onto_a_moving_argument_is_refused(rig: Rig):
    """From rest to 1 rad/s within a period would be 1000 rad/s2: refused, and nothing moves."""
    motor, argument = motor_of(rig), Jumps()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    line = Polynomial((0.0, 1.0)).restricted(0.0, 10.0)
    motor.set_trajectory(ComplexTrajectory(line, relative=True), argument)
    ramp = rig.runtime.every(1e-3, lambda: setattr(argument, "now", argument.now + 1e-3))
    motor.start()
    with pytest.raises(LimitError, match="velocity at the start"):
        motor.wait_until_done(timeout_s=1)
    assert rig.controllers["left"].snapshot()["demand_inc"] == 0
    ramp.cancel()


def test_argument_velocity_change_too_fast_stops_the_motion(rig: Rig):
    """The argument's velocity changes from 1 to 0.2 rad/s in a millisecond, without a step."""
    motor, argument = motor_of(rig), Jumps()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    line = Polynomial((0.0, 1.0)).restricted(0.0, 10.0)
    motor.set_trajectory(ComplexTrajectory(line, relative=True), argument)
    motor.start()
    asked = [1.0]

    def go_on() -> None:
        argument.rate = min(argument.rate + 9e-3, asked[0])
        argument.now += argument.rate * 1e-3

    ramp = rig.runtime.every(1e-3, go_on)
    rig.runtime.run_for(0.5)
    assert not motor.is_done()
    asked[0] = 0.2
    with pytest.raises(LimitError, match="change of velocity"):
        motor.wait_until_done(timeout_s=1)
    ramp.cancel()


def test_failing_argument_stops_the_motion(rig: Rig):
    motor, argument = motor_of(rig), Jumps()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    line = Polynomial((0.0, 1.0)).restricted(0.0, 10.0)
    motor.set_trajectory(ComplexTrajectory(line, relative=True), argument)
    motor.start()
    rig.runtime.run_for(0.1)

    def broken() -> float:
        raise UsageError("it is gone")

    argument.value = broken  # type: ignore[method-assign]
    with pytest.raises(UsageError, match="it is gone"):
        motor.wait_until_done(timeout_s=1)
    assert motor.hardware.stream.ended
