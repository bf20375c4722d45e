"""One application on every kind of hardware: the paper's algorithms and modes.

Positions come from the plant, not from the bus: the values read by the application may be 20 ms
old. The expected profiles are computed here once more, from the textbook.
"""

from math import inf, nan, sqrt
from pathlib import Path

import pytest

from motorhil.motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    Motor,
    MotorGroup,
    MotorPosition,
    PluginError,
    StateError,
    TrapezoidalTrajectory,
    UnsupportedError,
)
from motorhil.motorapi.functions import Polynomial
from tests.support.motors.kinds import (
    ACCELERATION_MAX,
    EVERY,
    KINDS,
    VELOCITY_MAX,
    opened,
    true_position,
)

SETPOINT, TRAJECTORY = ControlMode.SETPOINT, ControlMode.TRAJECTORY
SHAPE = Polynomial((0.0, 0.0, 3.0, -2.0)).restricted(0.0, 1.0)  # 3 s^2 - 2 s^3: rest to rest


@pytest.fixture(params=KINDS)
def kind(request):
    return KINDS[request.param]


@pytest.fixture
def rig(kind):
    with opened(kind, Path(f"{kind.name}.toml")) as rig:
        yield rig


# --- the paper's algorithms, line by line; lines 1 and 2, hardware and motor, are in the rig


def algorithm_1(motor):
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(1.0)
    motor.start()
    motor.wait_until_done()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(1.0))
    motor.start()


def algorithm_2(motor1, motor2):
    motor_grp = MotorGroup(motor1, motor2)
    motor_grp.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    motor_grp.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(2.0))
    motor_grp.start()
    return motor_grp


@pytest.fixture(params=EVERY)
def any_kind(request):
    return EVERY[request.param]


@pytest.fixture
def any_rig(any_kind):
    with opened(any_kind, Path(f"{any_kind.name}.toml")) as rig:
        yield rig


def test_algorithm_1_ends_at_1_then_at_2(any_kind, any_rig):
    kind, rig = any_kind, any_rig
    motor = rig.motors["left"]
    algorithm_1(motor)
    assert abs(true_position(rig, "left") - 1.0) <= kind.window
    motor.wait_until_done(timeout_s=5)
    assert abs(true_position(rig, "left") - 2.0) <= kind.window
    assert abs(motor.position() - 2.0) <= kind.window


def test_algorithm_2_is_synchronous_and_as_fast_as_allowed(any_kind, any_rig):
    kind, rig = any_kind, any_rig
    left, right = rig.motors["left"], rig.motors["right"]
    group = algorithm_2(left, right)
    capability = group.sync_capability()
    shortest_s = 2.0 / VELOCITY_MAX + VELOCITY_MAX / ACCELERATION_MAX  # of the slower one
    taken = sampled(rig, group, shortest_s)
    group.wait_until_done(timeout_s=5)
    for name, goal in (("left", 1.0), ("right", 2.0)):
        assert abs(true_position(rig, name) - goal) <= kind.window
    quality = group.sync_quality()
    if kind.name in KINDS:
        assert quality.start_skew_s <= capability.start_skew_s
        assert capability.start_skew_s <= 0.001
    else:  # one request after another, with unknown durations
        assert capability.start_skew_s is None
        assert 0.0 < quality.start_skew_s < 0.05
    # The slower one is as fast as possible, the other takes as long.
    assert worst_deviation(kind, taken, "left", trapezoid(1.0, shortest_s)) <= kind.following
    assert worst_deviation(kind, taken, "right", trapezoid(2.0, shortest_s)) <= kind.following


# --- differences between the modes


def sampled(rig, group, duration_s, period_s=0.0025):
    """Return [(time since the measured start [s], {motor: true position [rad]})]."""
    times = group.sync_quality().times
    began_ns = max(its.started_ns for _, its in times)
    taken = []
    while rig.runtime.now_ns() - began_ns < duration_s * 1e9:
        at_s = (rig.runtime.now_ns() - began_ns) / 1e9
        taken.append((at_s, {motor.name: true_position(rig, motor.name) for motor in group}))
        rig.runtime.run_for(period_s)
    at_s = (rig.runtime.now_ns() - began_ns) / 1e9
    taken.append((at_s, {motor.name: true_position(rig, motor.name) for motor in group}))
    return taken


def started(rig, *trajectories):
    group = rig.groups["both"]
    group.for_each(Motor.enable)
    group.for_each(Motor.set_control_mode, TRAJECTORY)
    group.set_trajectory(*trajectories)
    group.start()
    return group


def trapezoid(way, duration_s, acceleration=ACCELERATION_MAX):
    """Return the position over time, rest to rest (Biagiotti & Melchiorri, 2008, 3.2.3)."""
    least = acceleration * duration_s
    peak = 0.5 * (least - sqrt(least**2 - 4.0 * acceleration * way))
    ramp_s = peak / acceleration

    def position(at_s):
        at_s = min(max(at_s, 0.0), duration_s)
        if at_s < ramp_s:
            return 0.5 * acceleration * at_s**2
        if at_s <= duration_s - ramp_s:
            return peak * (at_s - 0.5 * ramp_s)
        return way - 0.5 * acceleration * (duration_s - at_s) ** 2

    return position


def worst_deviation(kind, taken, name, wanted):
    """Return the maximum deviation from `wanted`, with the begin anywhere in the latency range."""
    early_s, late_s = kind.latency_s
    worst = 0.0
    for at_s, where in taken:
        position = where[name]
        bounds = [wanted(at_s - late_s), wanted(at_s - early_s)]
        worst = max(worst, min(bounds) - position, position - max(bounds))
    return worst


def test_trajectory_tracks_its_function_at_every_sample(kind, rig):
    group = started(
        rig, TrapezoidalTrajectory(1.0, duration_s=2.0), TrapezoidalTrajectory(-0.5, duration_s=2.0)
    )
    taken = sampled(rig, group, 2.2)
    assert len(taken) > 800
    left, right = trapezoid(1.0, 2.0), trapezoid(0.5, 2.0)
    assert worst_deviation(kind, taken, "left", left) <= kind.following
    assert worst_deviation(kind, taken, "right", lambda at_s: -right(at_s)) <= kind.following
    # The bound is not vacuous: a function slower by a twentieth deviates far more.
    slower = trapezoid(1.0, 2.1)
    assert worst_deviation(kind, taken, "left", slower) > 10 * kind.following


def test_complex_trajectory_tracks_its_function(kind, rig):
    function = SHAPE.scaled(2.0)
    group = started(
        rig,
        ComplexTrajectory(function, relative=True),
        ComplexTrajectory(function * -0.7, relative=True),
    )
    taken = sampled(rig, group, 2.2)
    group.wait_until_done(5)

    def smooth(at_s):
        share = min(max(at_s / 2.0, 0.0), 1.0)
        return 3.0 * share**2 - 2.0 * share**3

    assert worst_deviation(kind, taken, "left", smooth) <= kind.following
    assert worst_deviation(kind, taken, "right", lambda t: -0.7 * smooth(t)) <= kind.following
    assert worst_deviation(kind, taken, "left", trapezoid(1.0, 2.0)) > 10 * kind.following
    assert abs(true_position(rig, "left") - 1.0) <= kind.window


def test_motor_led_by_another_follows_its_position(kind, rig):
    left, right = rig.motors["left"], rig.motors["right"]
    for motor in (left, right):
        motor.enable()
        motor.set_control_mode(TRAJECTORY)
    gear = Polynomial((0.0, -0.5)).restricted(-0.1, 1.0)  # half as fast, in the opposite direction
    assert right.position() == 0.0  # a position was received
    left.set_trajectory(ComplexTrajectory(gear), MotorPosition(right))
    right.set_trajectory(TrapezoidalTrajectory(1.001, duration_s=2.0))
    left.start()
    right.start()
    peak = 0.6  # of the trapezoid: 1 rad in 2 s at 4 rad/s^2 has its plateau at 0.5858 rad/s
    worst = 0.0
    for _ in range(1000):
        rig.runtime.run_for(0.0025)
        wanted = gear.value(min(max(true_position(rig, "right"), -0.1), 1.0))
        worst = max(worst, abs(true_position(rig, "left") - wanted))
    assert worst <= 0.5 * peak * kind.heard_s + 2 * kind.following
    left.wait_until_done(5)
    assert abs(true_position(rig, "left") + 0.5) <= kind.window + kind.following


class Told:
    """An argument with a settable value; an error is raised."""

    name = "level"
    rate_max = None

    def __init__(self, level):
        self.level = level

    def value(self):
        if isinstance(self.level, Exception):
            raise self.level
        return self.level


@pytest.mark.parametrize("bad", [nan, inf, "1", None, ZeroDivisionError("broken")])
def test_invalid_argument_value_ends_the_motion(kind, rig, bad):
    left = rig.motors["left"]
    left.enable()
    left.set_control_mode(TRAJECTORY)
    level = Told(bad)
    left.set_trajectory(ComplexTrajectory(Polynomial((0.0, 1.0)).restricted(0.0, 1.0)), level)
    with pytest.raises(PluginError, match="Told: value: "):
        left.start()
    level.level = 0.0
    left.start()
    rig.runtime.run_for(0.1)
    level.level = bad
    left.stop()  # at once, before any check
    left.wait_until_done(1)
    level.level = 0.0
    left.start()
    level.level = bad
    rig.runtime.run_for(0.1)
    with pytest.raises(PluginError, match="Told: value: "):
        left.wait_until_done(1)
    left.stop()
    left.wait_until_done(1)
    assert abs(left.position()) <= kind.window
    left.set_trajectory(TrapezoidalTrajectory(0.1))
    left.start()
    left.wait_until_done(2)
    assert abs(true_position(rig, "left") - 0.1) <= 2 * kind.window


def test_position_that_would_lead_itself_raises_at_start(kind, rig):
    left, right = rig.motors["left"], rig.motors["right"]
    gear = ComplexTrajectory(Polynomial((0.0, 0.5)).restricted(-1.0, 1.0), relative=True)
    for motor in (left, right):
        motor.enable()
        assert motor.position() == 0.0  # a position was received
        motor.set_control_mode(TRAJECTORY)
    left.set_trajectory(gear, MotorPosition(left))
    with pytest.raises(StateError, match=r"would lead itself: left follows left; lead it by"):
        left.start()
    left.set_trajectory(gear, MotorPosition(right))
    right.set_trajectory(gear, MotorPosition(left))
    with pytest.raises(StateError, match=r"itself: left follows right follows left;"):
        rig.groups["both"].start()
    left.start()
    with pytest.raises(StateError, match=r"itself: right follows left follows right;"):
        right.start()
    rig.runtime.run_for(0.1)
    assert true_position(rig, "left") == true_position(rig, "right") == 0.0


def test_set_point_is_as_fast_as_its_limits_allow(kind, rig):
    group = rig.groups["both"]
    group.for_each(Motor.enable)
    group.for_each(Motor.set_control_mode, SETPOINT)
    for motor in group:
        motor.set_setpoint(1.0)
    group.start()
    taken = sampled(rig, group, 2.2)
    group.wait_until_done(5)
    assert abs(true_position(rig, "left") - 1.0) <= kind.window
    # Without a given duration it arrives long before the trajectory would.
    assert worst_deviation(kind, taken, "left", trapezoid(1.0, 2.0)) > 50 * kind.following
    there_s = next(at_s for at_s, where in taken if abs(where["left"] - 1.0) <= kind.window)
    assert 1.0 / VELOCITY_MAX - 0.01 <= there_s <= 1.1


def test_set_point_velocity_limit_is_met_or_refused(kind, rig):
    motor = rig.motors["left"]
    motor.enable()
    motor.set_control_mode(SETPOINT)
    slow = DerivativeLimits(first=0.5)
    with pytest.raises(LimitError):
        motor.set_setpoint(1.0, limits=DerivativeLimits(first=1.1 * VELOCITY_MAX))
    try:
        motor.set_setpoint(1.0, limits=slow)
    except UnsupportedError:
        assert kind.name == "software"  # a step has no profile with a derivative to limit
        return
    motor.start()
    began_ns = rig.runtime.now_ns()
    motor.wait_until_done(5)
    assert rig.runtime.now_ns() - began_ns >= 1.99e9


# --- supported commands of each kind


@pytest.mark.parametrize("variable", ControlVariable, ids=lambda variable: variable.value)
@pytest.mark.parametrize("mode", ControlMode, ids=lambda mode: mode.value)
def test_motor_names_supported_modes_and_refuses_others(kind, rig, mode, variable):
    motor = rig.motors["left"]
    motor.enable()
    if variable not in kind.variables:
        with pytest.raises(UnsupportedError, match="it supports"):
            motor.set_control_mode(mode, variable)
        return
    motor.set_control_mode(mode, variable)
    if mode is SETPOINT:
        motor.set_setpoint(0.5)
    else:
        complex_one = ComplexTrajectory(SHAPE.scaled(1.0) * 0.25, relative=True)
        motor.set_trajectory(TrapezoidalTrajectory(0.5, duration_s=1.0))
        if variable in kind.complex:
            motor.set_trajectory(complex_one)
        else:
            with pytest.raises(UnsupportedError):
                motor.set_trajectory(complex_one)
            motor.set_trajectory(TrapezoidalTrajectory(0.5, duration_s=1.0))
    assert motor.state().value == "enabled"
    assert true_position(rig, "left") == 0.0
    motor.start()
    motor.wait_until_done(5)
    motor.stop()
    motor.wait_until_done(5)


@pytest.mark.parametrize("mode", ControlMode, ids=lambda mode: mode.value)
def test_velocity_is_reached_and_continues(kind, rig, mode):
    motor = rig.motors["left"]
    motor.set_control_mode(mode, ControlVariable.VELOCITY)
    if mode is SETPOINT:
        motor.set_setpoint(1.0)
    else:
        motor.set_trajectory(TrapezoidalTrajectory(1.0, duration_s=0.5))
    motor.start()
    motor.wait_until_done(5)
    rig.runtime.run_for(0.2)
    before = true_position(rig, "left")
    rig.runtime.run_for(1.0)
    assert abs(true_position(rig, "left") - before - 1.0) <= 0.01
    motor.stop()
    motor.wait_until_done(5)
