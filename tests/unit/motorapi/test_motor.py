from dataclasses import replace

import pytest

from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    StateError,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from tests.support.motors.plain import MODEL, PlainHwMotor, PlainMotor, fault_now

SETPOINT, TRAJECTORY = ControlMode.SETPOINT, ControlMode.TRAJECTORY
VELOCITY = ControlVariable.VELOCITY


def aim(motor, value, **options):
    motor.set_control_mode(SETPOINT)
    motor.set_setpoint(value, **options)


def follow(motor, *arguments, **options):
    motor.set_control_mode(TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(*arguments, **options))


def asked(hw):
    return [entry[0] for entry in hw.log]


def test_algorithm_1_ends_at_1_then_at_2(runtime):
    hw = PlainHwMotor(runtime, position=0.25)
    motor = PlainMotor(hw)
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(1.0)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    assert motor.position() == 1.0
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(1.0))
    motor.start()
    motor.wait_until_done()
    assert motor.position() == 2.0


def test_trajectory_duration_is_that_of_the_closed_form(runtime, motor):
    follow(motor, 3.0)
    motor.start()
    began_ns = runtime.now_ns()
    motor.wait_until_done()
    # By hand: limits 2 and 4: ramps 0.5 s over 0.5 each, plateau 2 in 1 s; polled every 1 ms.
    assert 2.0e9 <= runtime.now_ns() - began_ns <= 2.001e9


def test_nothing_is_sent_before_start(motor, hw):
    aim(motor, 1.0)
    follow(motor, 1.0)
    assert hw.log == []


def test_start_enables_arms_fires_and_confirms_in_order(motor, hw):
    aim(motor, 1.0)
    motor.start()
    assert asked(hw) == ["_enable", "_arm", "_confirm"]
    motor.wait_until_done()
    motor.start()
    assert asked(hw) == ["_enable", "_arm", "_confirm", "_arm", "_confirm"]


def test_second_start_repeats_a_distance(motor):
    follow(motor, 1.0)
    for _ in range(3):
        motor.start()
        motor.wait_until_done()
    assert motor.position() == 3.0


def test_relative_set_point_counts_from_the_reference(motor):
    aim(motor, 1.0)
    motor.start()
    motor.wait_until_done()
    aim(motor, -0.25, relative=True)
    motor.start()
    motor.wait_until_done()
    assert motor.position() == 0.75


def test_set_point_is_as_fast_as_the_model_unless_limited(motor, hw):
    aim(motor, 1.0)
    motor.start()
    assert (hw.motion.velocity, hw.motion.acceleration, hw.motion.duration_s) == (2.0, 4.0, None)
    motor.wait_until_done()
    aim(motor, 0.0, limits=DerivativeLimits(first=(-0.5, 1.0), second=(-3.0, 1.0)))
    motor.start()
    # Downwards: the lower end of each range; deceleration is upward acceleration.
    motion = hw.motion
    assert (motion.velocity, motion.acceleration, motion.deceleration) == (0.5, 3.0, 1.0)


def test_start_without_a_command_raises_and_sends_nothing(motor, hw):
    hw.fail["_connect"] = AssertionError("touched")
    with pytest.raises(StateError, match="set_control_mode"):
        motor.start()
    motor.set_control_mode(SETPOINT)
    with pytest.raises(StateError, match="set_setpoint"):
        motor.start()


def test_command_of_another_mode_is_refused_and_discarded(motor):
    with pytest.raises(StateError, match=r"ControlMode\.SETPOINT"):
        motor.set_setpoint(1.0)
    motor.set_control_mode(SETPOINT)
    with pytest.raises(StateError, match=r"its control mode is SETPOINT"):
        motor.set_trajectory(TrapezoidalTrajectory(1.0))
    motor.set_setpoint(1.0)
    motor.set_control_mode(SETPOINT)  # the same mode again changes nothing
    motor.start()
    motor.wait_until_done()
    motor.set_control_mode(SETPOINT, VELOCITY)
    with pytest.raises(StateError, match="nothing to start"):
        motor.start()


@pytest.mark.parametrize(
    "refused",
    [
        lambda motor: motor.set_setpoint(float("nan")),
        lambda motor: motor.set_setpoint(2.0, relative=True, limits=DerivativeLimits(third=1.0)),
        lambda motor: motor.set_trajectory(TrapezoidalTrajectory(2.0)),
        lambda motor: motor.set_control_mode(TRAJECTORY, ControlVariable.CURRENT),
        lambda motor: motor.set_control_mode("trajectory"),
    ],
)
def test_start_after_a_refused_setting_does_not_move(motor, hw, refused):
    aim(motor, 1.0, relative=True)
    motor.start()
    motor.wait_until_done()
    with pytest.raises(UsageError):
        refused(motor)
    with pytest.raises(StateError, match="there is nothing to start"):
        motor.start()
    assert motor.position() == 1.0
    assert asked(hw).count("_arm") == 1
    motor.set_setpoint(0.5)
    motor.start()
    motor.wait_until_done()
    assert motor.position() == 0.5


def test_start_after_a_refused_trajectory_does_not_move(motor, hw):
    follow(motor, 1.0)
    with pytest.raises(LimitError):
        motor.set_trajectory(TrapezoidalTrajectory(1.0, duration_s=0.01))
    with pytest.raises(StateError, match="there is nothing to start"):
        motor.start()
    assert hw.log == []


def test_unsupported_command_raises_when_set(motor):
    with pytest.raises(UnsupportedError, match="setpoint of position, setpoint of velocity"):
        motor.set_control_mode(TRAJECTORY, ControlVariable.CURRENT)
    motor.set_control_mode(SETPOINT, VELOCITY)
    with pytest.raises(UnsupportedError, match="relative"):
        motor.set_setpoint(1.0, relative=True)
    with pytest.raises(UnsupportedError, match="derivative"):
        motor.set_setpoint(1.0, limits=DerivativeLimits(second=1.0))
    motor.set_control_mode(SETPOINT)
    with pytest.raises(UnsupportedError, match="derivative"):
        motor.set_setpoint(1.0, limits=DerivativeLimits(third=1.0))
    with pytest.raises(UnsupportedError, match="measuring torque"):
        motor.torque()


@pytest.fixture
def bounded(runtime):
    """Return a model with limits on everything: -1..3 rad, 2 rad/s, 4 rad/s², 5 N·m."""
    model = replace(MODEL, position_min=-1.0, position_max=3.0, torque_max=5.0)
    return PlainMotor(PlainHwMotor(runtime, node=9), model=model, name="joint")


@pytest.mark.parametrize(
    ("variable", "inside", "outside", "unit"),
    [
        (ControlVariable.POSITION, (-1.0, 3.0), (-1.001, 3.001), "rad"),
        (ControlVariable.VELOCITY, (-2.0, 2.0), (-2.001, 2.001), "rad/s"),
        (ControlVariable.TORQUE, (-5.0, 5.0), (-5.001, 5.001), "N·m"),
    ],
)
def test_set_point_outside_the_model_raises(bounded, variable, inside, outside, unit):
    bounded.set_control_mode(SETPOINT, variable)
    for value in inside:
        bounded.set_setpoint(value)
    for value in outside:
        with pytest.raises(LimitError) as caught:
            bounded.set_setpoint(value)
        error = caught.value
        assert (error.motor, error.value, error.unit) == ("joint", value, unit)
        assert (error.low, error.high) == inside
        assert f"{value:g} {unit}" in str(error)
    for value in (float("nan"), float("inf")):
        with pytest.raises(UsageError, match="finite"):
            bounded.set_setpoint(value)


def test_distance_that_leaves_the_range_raises_at_start(bounded):
    aim(bounded, 2.0)
    bounded.start()
    bounded.wait_until_done()
    follow(bounded, 1.0)
    bounded.start()
    bounded.wait_until_done()
    follow(bounded, 0.001)
    with pytest.raises(LimitError, match=r"3\.001 rad"):
        bounded.start()
    assert asked(bounded.hw).count("_arm") == 2  # the third one was not reached


def test_value_range_of_a_command_is_checked(motor):
    motor.set_control_mode(SETPOINT)
    with pytest.raises(LimitError, match="own limits"):
        motor.set_setpoint(2.0, limits=DerivativeLimits(value=(0.0, 1.0)))
    follow(motor, 2.0, limits=DerivativeLimits(value=(0.0, 1.0)))
    with pytest.raises(LimitError, match="own limits"):
        motor.start()


def test_command_limits_wider_than_the_model_raise(motor):
    motor.set_control_mode(SETPOINT)
    motor.set_setpoint(1.0, limits=DerivativeLimits(first=2.0, second=4.0))
    with pytest.raises(LimitError, match=r"velocity limit -2\.1 rad/s"):
        motor.set_setpoint(1.0, limits=DerivativeLimits(first=2.1))
    with pytest.raises(LimitError, match=r"acceleration limit -4\.1 rad/s²"):
        motor.set_setpoint(1.0, limits=DerivativeLimits(second=(-4.1, 1.0)))
    motor.set_control_mode(SETPOINT, VELOCITY)
    with pytest.raises(LimitError, match="acceleration limit"):
        motor.set_setpoint(1.0, limits=DerivativeLimits(first=4.1))


def test_duration_too_short_raises_when_set(motor):
    motor.set_control_mode(TRAJECTORY)
    with pytest.raises(LimitError, match=r"duration 1\.9 s, allowed is at least 2 s \(for 3 rad"):
        motor.set_trajectory(TrapezoidalTrajectory(3.0, duration_s=1.9))


def test_given_duration_lowers_the_plateau(runtime, motor, hw):
    follow(motor, 3.0, duration_s=4.0)
    motor.start()
    assert hw.motion.velocity < 2.0
    began_ns = runtime.now_ns()
    motor.wait_until_done()
    assert 4.0e9 <= runtime.now_ns() - began_ns <= 4.001e9


def test_absolute_trajectory_requires_its_initial_value(motor):
    follow(motor, 1.0, 0.02)
    with pytest.raises(StateError, match=r"begins at 0\.02 rad, the motor is at 0 rad"):
        motor.start()
    follow(motor, 1.0, 0.009)  # within the tolerance of the model
    motor.start()
    motor.wait_until_done()
    assert motor.position() == 1.0


def test_absolute_trajectory_duration_depends_on_its_distance(motor, hw):
    aim(motor, 1.0)
    motor.start()
    motor.wait_until_done()
    follow(motor, 4.0, 1.0, duration_s=2.0)  # 3 rad: just possible; 4 rad would not be
    motor.start()
    assert hw.motion.duration_s == 2.0


def test_limits_by_direction_apply_to_absolute_trajectories(motor, hw):
    aim(motor, 4.0)
    motor.start()
    motor.wait_until_done()
    follow(motor, 1.0, 4.0, limits=DerivativeLimits(first=(-0.5, 1.0)))
    motor.start()
    assert hw.motion.velocity == 0.5


def test_distance_counts_from_the_position_after_enabling(motor, hw):
    hw.sag = 0.5
    follow(motor, 1.0)
    motor.start()
    motor.wait_until_done()
    assert motor.position() == 0.5


def test_finished_motion_stays_done(motor, hw):
    follow(motor, 1.0)
    motor.start()
    motor.wait_until_done()
    fault_now(hw)
    assert motor.is_done()
    motor.wait_until_done()


def test_unreferenced_motor_refuses_absolute_targets(runtime):
    model = replace(MODEL, requires_referencing=True)
    motor = PlainMotor(PlainHwMotor(runtime), model=model)
    for command in (lambda: aim(motor, 1.0), lambda: follow(motor, 1.0, 0.0)):
        command()
        with pytest.raises(StateError, match=r"call home\(\) first"):
            motor.start()
    assert asked(motor.hw) == []
    for command in (lambda: aim(motor, 0.5, relative=True), lambda: follow(motor, 0.5)):
        command()
        motor.start()
        motor.wait_until_done()
    assert not motor.is_referenced()
    motor.home(37)
    assert motor.is_referenced()
    assert ("_home", 37) in motor.hw.log
    aim(motor, 0.0)
    motor.start()


# --- invalid calls at a prompt


@pytest.mark.parametrize("asked_for", [("setpoint",), (1,), (SETPOINT, "velocity"), (None,)])
def test_invalid_control_mode_raises_and_is_not_kept(motor, asked_for):
    motor.set_control_mode(TRAJECTORY)
    with pytest.raises(UsageError, match=r"give a ControlMode and a ControlVariable"):
        motor.set_control_mode(*asked_for)
    assert motor.control_mode is TRAJECTORY


@pytest.mark.parametrize(
    ("value", "options", "told"),
    [
        ("1.0", {}, "set-point '1.0' is not a finite number"),
        (None, {}, "set-point None is not a finite number"),
        (float("nan"), {}, "set-point nan is not a finite number"),
        (1.0, {"limits": (1.0, 2.0)}, "limits is (1.0, 2.0); expected DerivativeLimits or None"),
    ],
)
def test_invalid_set_point_error_names_the_motor(motor, value, options, told):
    motor.set_control_mode(SETPOINT)
    with pytest.raises(UsageError) as caught:
        motor.set_setpoint(value, **options)
    assert str(caught.value) == f"{motor.name}: {told}"


def test_invalid_trajectory_error_names_the_motor(motor):
    motor.set_control_mode(TRAJECTORY)
    with pytest.raises(UsageError, match=r"m1: 1\.0 is not a trajectory; give a Trapezoidal"):
        motor.set_trajectory(1.0)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"method": 1000}, "homing method 1000: CiA 402 numbers them -128 to 127"),
        ({"method": "37"}, "homing method '37': CiA 402 numbers them -128 to 127"),
        ({"method": 3.5}, "homing method 3.5: "),
        ({"timeout_s": -1.0}, "timeout_s = -1.0: must be a number of seconds >= 0"),
        ({"timeout_s": float("nan")}, "timeout_s = nan: must be a number of seconds >= 0"),
        ({"timeout_s": "x"}, "timeout_s = 'x': must be a number of seconds >= 0"),
    ],
)
def test_invalid_homing_method_sends_nothing(motor, hw, arguments, told):
    with pytest.raises(UsageError, match=told):
        motor.home(**arguments)
    assert asked(hw) == []
    assert motor.is_done()


def test_velocity_continues_until_stop_as_the_remedy_says(motor):
    motor.set_control_mode(SETPOINT, VELOCITY)
    motor.set_setpoint(1.0)
    motor.start()
    motor.wait_until_done(5)
    with pytest.raises(
        StateError, match=r"home refused, start\(\) of m1 is active .*; stop\(\) first"
    ):
        motor.home()
    motor.stop()
    motor.wait_until_done(5)
    aim(motor, 5.0)
    motor.start()
    with pytest.raises(StateError, match=r"is active .*; wait_until_done\(\) or stop\(\) first"):
        motor.home()
