"""The ideal motor executes commands exactly; expected values by hand."""

import pytest

from motorhil.harness.conformance.clauses.helpers import failing_function
from motorhil.motorapi import (
    ComplexTrajectory,
    DerivativeLimits,
    LinkError,
    MotorPosition,
    PluginError,
    TrapezoidalTrajectory,
)
from motorhil.motorapi.adaptations.ideal.hardware import IdealHwMotor
from motorhil.motorapi.adaptations.ideal.motor import IdealMotor
from motorhil.motorapi.functions import Polynomial
from tests.support.motors.ideals import (
    CURRENT,
    MODEL,
    TORQUE,
    VELOCITY,
    aim,
    follow,
    near,
    samples,
)

UP = Polynomial((0.0, 0.0, 1.5, -1.0)).restricted(0.0, 1.0)  # half a radian, from rest to rest

# --- set-points: straight motion


def test_position_set_point_moves_at_the_velocity_limit(runtime, motor):
    aim(motor, 1.25)  # 1 rad at 2 rad/s
    assert samples(runtime, motor, 0.125, 6) == [
        (0.25, 2.0, 0.0),
        (0.5, 2.0, 0.0),
        (0.75, 2.0, 0.0),
        (1.0, 2.0, 0.0),
        (1.25, 0.0, 0.0),
        (1.25, 0.0, 0.0),
    ]


def test_set_point_own_velocity_limit_applies(runtime, motor):
    aim(motor, -0.75, limits=DerivativeLimits(first=0.5))
    assert motor.velocity() == -0.5
    motor.wait_until_done()
    assert (runtime.now_ns(), motor.position()) == (2_000_000_000, -0.75)


def test_function_that_fails_ends_the_motion_at_its_last_sample(runtime, motor):
    function, fail = failing_function(UP, "no teeth")
    follow(motor, ComplexTrajectory(function, relative=True))
    runtime.run_for(0.5)
    fail()
    with pytest.raises(PluginError, match="ValueError: a trajectory: no teeth"):
        motor.wait_until_done()
    assert motor.position() == pytest.approx(0.25 + 0.25, abs=1e-9)  # half of the way
    motor.close()


def test_velocity_set_point_ramps_to_its_velocity(runtime, motor):
    aim(motor, 2.0, VELOCITY)  # at 4 rad/s^2
    motor.wait_until_done()
    assert runtime.now_ns() == 500_000_000
    assert (motor.velocity(), motor.position()) == (2.0, 0.25 + 0.5)
    runtime.run_for(1.0)
    assert motor.position() == 2.75
    aim(motor, -1.0, VELOCITY)  # slows down at 8 for 0.25 s, then speeds up at 4 for 0.25 s
    begun_ns = runtime.now_ns()
    runtime.run_for(0.125)
    assert motor.velocity() == 1.0
    motor.wait_until_done()
    assert runtime.now_ns() - begun_ns == 500_000_000
    assert motor.velocity() == -1.0
    assert motor.position() == 2.75 + 0.25 - 0.125


def test_velocity_set_point_own_acceleration_limit_applies(runtime, motor):
    aim(motor, 1.0, VELOCITY, limits=DerivativeLimits(first=0.5))
    runtime.run_for(1.0)
    assert (motor.velocity(), motor.position()) == (0.5, 0.5)


def test_torque_set_point_steps_with_the_shaft_held(runtime, motor):
    aim(motor, -1.5, TORQUE)
    assert motor.is_done()
    assert samples(runtime, motor, 0.5, 2) == [(0.25, 0.0, -1.5)] * 2
    motor.stop()
    motor.wait_until_done()
    assert motor.torque() == 0.0


def test_torque_set_point_follows_its_slope(runtime, motor):
    aim(motor, 2.0, TORQUE, limits=DerivativeLimits(first=4.0))
    assert not motor.is_done()
    assert [torque for _, _, torque in samples(runtime, motor, 0.25, 4)] == [0.0, 1.0, 2.0, 2.0]
    aim(motor, 0.0, TORQUE, limits=DerivativeLimits(first=4.0))  # replaced while it pushes
    runtime.run_for(0.25)
    assert motor.torque() == 1.0


def test_current_set_point_gives_torque_by_the_constant(runtime, motor):
    aim(motor, 2.0, CURRENT, limits=DerivativeLimits(first=2.0))
    runtime.run_for(0.5)
    assert motor.torque() == 0.5 * 1.0
    motor.wait_until_done()
    assert (runtime.now_ns(), motor.torque()) == (1_000_000_000, 1.0)


def test_replaced_set_point_continues_from_its_position(runtime, motor):
    aim(motor, 1.25)
    runtime.run_for(0.25)
    aim(motor, 0.25)
    assert (motor.position(), motor.velocity()) == (0.75, -2.0)
    motor.wait_until_done()
    assert (runtime.now_ns(), motor.position()) == (500_000_000, 0.25)


# --- trajectories: the demand at every instant


def test_simple_position_trajectory_is_a_trapezoid(runtime, motor):
    # Limits 2, 4, 8: up 0.5 s over 0.5, down 0.25 s over 0.25, plateau 1.25 in 0.625 s.
    follow(motor, TrapezoidalTrajectory(2.0))
    assert samples(runtime, motor, 0.25, 3) == [
        (0.25, 0.0, 0.0),
        (0.25 + 0.125, 1.0, 0.0),
        (0.25 + 0.5, 2.0, 0.0),
    ]
    runtime.run_for(0.5)  # at 1.25 s, half-way down
    assert (motor.position(), motor.velocity()) == near(2.25 - 0.0625, 1.0)
    motor.wait_until_done()
    assert (runtime.now_ns(), motor.position()) == (1_375_000_000, 2.25)


def test_simple_velocity_trajectory_is_a_ramp(runtime, motor):
    follow(motor, TrapezoidalTrajectory(1.0, duration_s=2.0), VELOCITY)
    runtime.run_for(1.0)
    assert (motor.position(), motor.velocity()) == (0.25 + 0.25, 0.5)
    motor.wait_until_done()
    assert (runtime.now_ns(), motor.velocity()) == (2_000_000_000, 1.0)
    runtime.run_for(1.0)
    assert motor.position() == 0.25 + 1.0 + 1.0  # it continues
    follow(motor, TrapezoidalTrajectory(-1.0, duration_s=1.0), VELOCITY)  # from 1 to 0
    motor.wait_until_done()
    assert (motor.position(), motor.velocity()) == (2.25 + 0.5, 0.0)


def test_simple_torque_trajectory_is_a_ramp(runtime, motor):
    follow(motor, TrapezoidalTrajectory(3.0, duration_s=3.0), TORQUE)
    assert [torque for _, _, torque in samples(runtime, motor, 1.0, 5)] == [0, 1, 2, 3, 3]


def test_end_between_two_nanoseconds_is_rounded_to_nearest(runtime, motor):
    follow(motor, TrapezoidalTrajectory(1.0, duration_s=10.0 / 3.0))
    motor.wait_until_done()
    assert runtime.now_ns() == 3_333_333_333
    assert (motor.position(), motor.velocity()) == (1.25, 0.0)


def test_motion_of_unlimited_duration_can_be_stopped(motor):
    aim(motor, 1e308)
    motor.stop()
    motor.wait_until_done()
    follow(motor, ComplexTrajectory(Polynomial((0.25,)), 0.0, 1e300, relative=True))
    motor.stop()
    motor.wait_until_done()
    assert motor.velocity() == 0.0


def rest_to_rest(distance, duration_s):
    """Return 3 s^2 - 2 s^3 of the distance."""
    return Polynomial((0.0, 0.0, 3.0, -2.0)).restricted(0.0, 1.0).scaled(duration_s) * distance


def test_complex_trajectory_is_followed_at_every_instant(runtime, motor):
    function = rest_to_rest(2.0, 4.0)
    follow(motor, ComplexTrajectory(function, relative=True))
    velocity = function.derivative()
    for step in range(400):
        runtime.run_for(0.01)
        at_s = runtime.now_ns() / 1e9
        assert motor.position() == function.value(at_s) + 0.25
        assert motor.velocity() == (velocity.value(at_s) if step < 399 else 0.0)
    assert motor.is_done()
    assert motor.position() == 2.25


def test_complex_velocity_trajectory_covers_its_integral(runtime, motor):
    # v = t (2 - t): its integral t^2 - t^3 / 3.
    function = Polynomial((0.0, 2.0, -1.0)).restricted(0.0, 2.0)
    follow(motor, ComplexTrajectory(function), VELOCITY)
    runtime.run_for(0.5)
    assert (motor.position(), motor.velocity()) == near(0.25 + 0.25 - 0.125 / 3, 0.75)
    motor.wait_until_done()
    assert (motor.position(), motor.velocity()) == near(0.25 + 4 - 8 / 3, 0.0)


def test_function_piece_begins_at_its_initial_argument(runtime, motor):
    function = Polynomial((0.0, 1.0))  # of velocity, from argument 0 to 1.5
    follow(motor, ComplexTrajectory(function, 0.0, 1.5), VELOCITY)
    motor.wait_until_done()
    assert (runtime.now_ns(), motor.velocity()) == (1_500_000_000, 1.5)
    follow(motor, ComplexTrajectory(function * -1.0 + 3.0, 1.5, 3.0), VELOCITY)
    runtime.run_for(0.5)
    assert (motor.velocity(), motor.position()) == near(1.0, 0.25 + 1.125 + 0.625)


def test_complex_torque_trajectory_is_followed(runtime, motor):
    follow(motor, ComplexTrajectory(Polynomial((1.0, -0.5)).restricted(0.0, 2.0)), TORQUE)
    assert [torque for _, _, torque in samples(runtime, motor, 0.5, 6)] == [
        *(1.0, 0.75, 0.5, 0.25, 0.0, 0.0)
    ]


# --- over another argument: another motor's position


@pytest.fixture
def leader(runtime):
    return IdealMotor(IdealHwMotor(runtime, "leading"), MODEL, name="leader")


GEAR = Polynomial((0.25, 0.5)).restricted(0.0, 2.0)  # half as fast, from the motor's position


def test_led_motor_follows_the_gear_at_every_instant(runtime, motor, leader):
    follow(motor, ComplexTrajectory(GEAR), argument=MotorPosition(leader))
    runtime.run_for(0.1)
    assert (motor.position(), motor.velocity()) == (0.25, 0.0)  # the leader stands still
    follow(leader, TrapezoidalTrajectory(1.0))
    for _ in range(999):
        runtime.run_for(0.0007)
        assert motor.position() == GEAR.value(leader.position())
        assert abs(motor.velocity() - 0.5 * leader.velocity()) <= 0.5 * 8.0 * 0.0015
    leader.wait_until_done()
    assert not motor.is_done()
    follow(leader, TrapezoidalTrajectory(-0.5))  # back, and the motor with it
    leader.wait_until_done()
    assert (leader.position(), motor.position()) == (0.5, 0.5)
    assert not motor.is_done()
    follow(leader, TrapezoidalTrajectory(1.5))
    motor.wait_until_done()
    assert motor.position() == 1.25
    runtime.run_for(0.1)
    follow(leader, TrapezoidalTrajectory(-1.0))
    leader.wait_until_done()
    assert motor.position() == 1.25  # it has arrived, and is no longer led


def test_led_position_does_not_depend_on_reading(runtime, leader):
    ends = []
    for look in (False, True):
        motor = IdealMotor(IdealHwMotor(runtime, f"looked at {look}"), MODEL, name="m")
        leader.home()
        gear = Polynomial((0.0, 1.0)).restricted(0.0, 1.0)
        follow(motor, ComplexTrajectory(gear), VELOCITY, MotorPosition(leader))
        follow(leader, TrapezoidalTrajectory(0.9))
        while not leader.is_done():
            if look:
                motor.latest()
            runtime.run_for(0.0003)
        ends.append((motor.position(), motor.velocity()))
    # Velocity is the leader's position: the distance is an integral over the leader's motion, p =
    # 0.45 of the distance and half the duration 0.9 each by symmetry, to the step of 1 ms.
    assert ends[0] == ends[1]
    assert ends[0][1] == pytest.approx(0.9, abs=1e-12)


def test_led_velocity_covers_the_integral(runtime, motor, leader):
    gear = Polynomial((0.0, 0.5)).restricted(0.0, 4.0)
    leader.home()
    follow(motor, ComplexTrajectory(gear), VELOCITY, MotorPosition(leader))
    aim(leader, 2.0)  # at 2 rad/s for 1 s: v = t, distance t^2 / 2
    runtime.run_for(0.5)
    assert motor.position() - 0.25 == pytest.approx(0.125, abs=1e-9)  # ten nanometres of a step
    leader.wait_until_done()
    assert motor.position() - 0.25 == pytest.approx(0.5, abs=1e-9)


def test_missing_argument_moves_nothing_and_ends_the_motion(runtime, motor):
    class Fickle:
        name, rate_max, known = "fickle", 1.0, False

        def value(self):
            if not self.known:
                raise LinkError(link="fickle", reason="not heard")
            return runtime.now_ns() / 1e9

    argument = Fickle()
    with pytest.raises(LinkError, match="not heard"):
        follow(motor, ComplexTrajectory(GEAR), argument=argument)
    assert motor.is_done()
    argument.known = True
    motor.start()
    runtime.run_for(0.5)
    assert motor.position() == 0.5
    argument.known = False
    with pytest.raises(LinkError, match="not heard"):
        motor.wait_until_done(5.0)
    assert runtime.now_ns() == 501_000_000
    assert (motor.position(), motor.velocity()) == (0.5, 0.0)
    argument.known = True
    aim(motor, 1.0)
    motor.wait_until_done()
