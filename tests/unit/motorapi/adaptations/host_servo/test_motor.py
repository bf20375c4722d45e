"""Central servo end to end, within the theory of its PID."""

from collections.abc import Callable
from itertools import pairwise

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.host_servo.motor import SoftwareMotor
from motorhil.motorapi.adaptations.host_servo.settings import PidGains
from motorhil.motorapi.commands import ControlMode, ControlVariable, DerivativeLimits
from motorhil.motorapi.errors import PluginError, UnsupportedError
from motorhil.motorapi.functions import Polynomial
from motorhil.motorapi.generation import shortest
from motorhil.motorapi.state import MotorState
from motorhil.motorapi.trajectory import ComplexTrajectory, MotorPosition, TrapezoidalTrajectory
from tests.support.motors.software_rigs import (
    ACCELERATION_MAX,
    INC_PER_RAD,
    TORQUE_CONSTANT,
    VELOCITY_MAX,
    SyncTap,
    commanded,
    enabled,
    inc,
    lag_bound_inc,
    one,
    two,
)

OpenRig = Callable[..., Rig]
WINDOW = 10 / INC_PER_RAD


def test_trajectory_is_followed_within_the_theoretical_bound(open_rig: OpenRig):
    rig = open_rig(one())
    tap = SyncTap(rig)
    left = enabled(rig)
    profile = shortest(1.0, VELOCITY_MAX, ACCELERATION_MAX, ACCELERATION_MAX)
    begin = left.position()
    commanded(left, ControlMode.TRAJECTORY, ControlVariable.POSITION, TrapezoidalTrajectory(1.0))
    left.wait_until_done(2)
    started_ns = left._motion_times().started_ns
    counts = tap.since(started_ns)
    assert len(counts) > profile.duration_s * 1000
    wanted = [(begin + profile.position(k / 1000)) * INC_PER_RAD for k in range(len(counts))]
    worst = max(abs(a - b) for a, b in zip(counts, wanted, strict=True))
    assert worst <= lag_bound_inc()
    assert left.position() == pytest.approx(begin + 1.0, abs=WINDOW)


def test_servo_without_feedforward_exceeds_the_bound(open_rig: OpenRig):
    rig = open_rig(one())
    left = enabled(rig)
    assert isinstance(left, SoftwareMotor)
    tuned = left.gains
    left.gains = PidGains(kp=tuned.kp, ki=tuned.ki, kd=tuned.kd)
    errors: list[float] = []
    rig.runtime.every(0.001, lambda: errors.append(abs(left.following_error()) * INC_PER_RAD))
    commanded(left, ControlMode.TRAJECTORY, ControlVariable.POSITION, TrapezoidalTrajectory(1.0))
    left.wait_until_done(2)
    assert max(errors) > 5 * lag_bound_inc()


def test_set_point_is_a_step_without_profile(open_rig: OpenRig):
    rig = open_rig(one())
    tap = SyncTap(rig)
    left = enabled(rig)
    commanded(left, ControlMode.SETPOINT, ControlVariable.POSITION, 0.5)
    left.wait_until_done(2)
    counts = tap.since(left._motion_times().started_ns)
    demand = left.hardware.servo.demand / INC_PER_RAD
    assert demand == 0.5
    way = [count / INC_PER_RAD for count in counts]
    profile = shortest(0.5, VELOCITY_MAX, ACCELERATION_MAX, ACCELERATION_MAX)
    assert way[30] > 3 * profile.position(0.030)  # with the whole available current
    speeds = [(b - a) * 1000 for a, b in pairwise(way)]
    assert max(speeds) < 1.1 * VELOCITY_MAX  # but within the motor's maximum velocity
    assert max(speeds) > 0.9 * VELOCITY_MAX
    assert left.position() == pytest.approx(0.5, abs=WINDOW)


def test_limits_that_need_a_profile_are_refused(
    open_rig: OpenRig,
):
    rig = open_rig(one())
    left = rig.motors["left"]
    left.set_control_mode(ControlMode.SETPOINT)
    for limits in (DerivativeLimits(first=1.0), DerivativeLimits(second=1.0)):
        with pytest.raises(UnsupportedError, match="which has no profile; it supports torque"):
            left.set_setpoint(0.5, limits=limits)
    left.set_setpoint(0.5, limits=DerivativeLimits(value=(-1.0, 1.0)))
    assert rig.runtime.now_ns() == 0


def test_velocity_is_reached_within_half_an_increment_a_cycle(open_rig: OpenRig):
    slow = 0.3
    assert 0.02 * slow * INC_PER_RAD < 0.5 / 0.001  # less than the counts can tell
    rig = open_rig(one(velocity=slow))
    left = enabled(rig)
    commanded(left, ControlMode.SETPOINT, ControlVariable.VELOCITY, 0.5 * slow)
    left.wait_until_done(1)
    rig.runtime.run_for(0.1)
    assert left.velocity() == pytest.approx(0.5 * slow, abs=0.5 / 0.001 / INC_PER_RAD)


def test_velocity_set_point_steps_and_is_kept(open_rig: OpenRig):
    rig = open_rig(one())
    left = enabled(rig)
    commanded(left, ControlMode.SETPOINT, ControlVariable.VELOCITY, 2.0)
    rig.runtime.run_for(0.06)
    assert left.velocity() > 1.5  # the model's acceleration would have made 0.6
    left.wait_until_done(1)
    begin, start_ns = inc(rig), rig.runtime.now_ns()
    rig.runtime.run_for(1.0)
    passed_s = (rig.runtime.now_ns() - start_ns) / 1e9
    assert (inc(rig) - begin) / INC_PER_RAD == pytest.approx(2.0 * passed_s, abs=0.005)
    left.set_setpoint(-1.0)
    left.start()  # replaces the one before in mid-motion
    left.wait_until_done(1)
    rig.runtime.run_for(0.1)
    assert left.velocity() == pytest.approx(-1.0, abs=0.1)


def test_velocity_set_point_with_limit_is_ramped(open_rig: OpenRig):
    rig = open_rig(one())
    left = enabled(rig)
    left.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    left.set_setpoint(2.0, limits=DerivativeLimits(first=5.0))
    left.start()
    rig.runtime.run_for(0.2)
    assert left.velocity() == pytest.approx(1.0, abs=0.1)
    left.wait_until_done(1)
    assert left.velocity() == pytest.approx(2.0, abs=0.1)


def test_velocity_trajectory_covers_its_integral(open_rig: OpenRig):
    rig = open_rig(one())
    left = enabled(rig)
    begin = inc(rig)
    trajectory = TrapezoidalTrajectory(2.0, initial=0.0, duration_s=0.5)
    commanded(left, ControlMode.TRAJECTORY, ControlVariable.VELOCITY, trajectory)
    started_ns = left._motion_times().started_ns
    rig.runtime.run_for(1.0)
    cycles = (rig.runtime.now_ns() - started_ns) // 1_000_000
    wanted = 0.5 * 2.0 * 0.5 + 2.0 * (cycles / 1000 - 0.5)
    assert (inc(rig) - begin) / INC_PER_RAD == pytest.approx(wanted, abs=0.005)


@pytest.mark.parametrize(
    ("variable", "value", "ampere"),
    [(ControlVariable.CURRENT, 2.0, 2.0), (ControlVariable.TORQUE, -1.0, -1.0 / TORQUE_CONSTANT)],
)
def test_torque_and_current_set_points_are_the_amplifiers(
    open_rig: OpenRig, variable: ControlVariable, value: float, ampere: float
):
    rig = open_rig(one(), "[controller.io.plant]\npreset = 'wheel_60w'\ncoulomb_friction_n_m = 9\n")
    left = enabled(rig)
    left.set_control_mode(ControlMode.SETPOINT, variable)
    left.set_setpoint(value)
    left.start()
    left.wait_until_done(1)
    rig.runtime.run_for(0.05)
    lsb = 8.0 / 32768
    assert rig.controllers["io"].snapshot()["current_a"] == pytest.approx(ampere, abs=lsb)
    # with a slope limit it takes its time
    left.set_setpoint(0.0, limits=DerivativeLimits(first=abs(value)))
    left.start()
    rig.runtime.run_for(0.5)
    now_a = rig.controllers["io"].snapshot()["current_a"]
    assert now_a == pytest.approx(0.5 * ampere, abs=abs(ampere) * 0.005)
    left.wait_until_done(1)
    left.stop()
    left.wait_until_done(1)


def test_torque_without_its_constant_is_refused(open_rig: OpenRig):
    text = one().replace(f"torque_constant_n_m_a = {TORQUE_CONSTANT}", "")
    left = open_rig(text).motors["left"]
    with pytest.raises(UnsupportedError, match="setpoint of torque"):
        left.set_control_mode(ControlMode.SETPOINT, ControlVariable.TORQUE)
    left.set_control_mode(ControlMode.SETPOINT, ControlVariable.CURRENT)
    with pytest.raises(UnsupportedError, match="measuring torque"):
        left.torque()


def smooth(distance: float, duration_s: float) -> Polynomial:
    """Return 3 u^2 - 2 u^3: from rest to rest."""
    return Polynomial((0.0, 0.0, 3 * distance / duration_s**2, -2 * distance / duration_s**3))


def test_complex_trajectory_is_sampled_every_cycle(open_rig: OpenRig):
    rig = open_rig(one())
    tap = SyncTap(rig)
    left = enabled(rig)
    function = smooth(1.0, 1.0)
    trajectory = ComplexTrajectory(function, 0.0, 1.0, relative=True)
    begin = inc(rig)
    commanded(left, ControlMode.TRAJECTORY, ControlVariable.POSITION, trajectory)
    left.wait_until_done(2)
    counts = tap.since(left._motion_times().started_ns)[:1001]
    wanted = [begin + function.value(k / 1000) * INC_PER_RAD for k in range(1001)]
    worst = max(abs(a - b) for a, b in zip(counts, wanted, strict=True))
    assert worst <= lag_bound_inc()


def test_trajectory_over_another_motors_position_follows_it(open_rig: OpenRig):
    rig = open_rig(two())
    left, right = enabled(rig, "left"), enabled(rig, "right")
    gear = Polynomial((0.0, -0.5))
    right.set_control_mode(ControlMode.TRAJECTORY)
    right.set_trajectory(ComplexTrajectory(gear, 0.0, 1.0, relative=True), MotorPosition(left))
    right.start()
    commanded(left, ControlMode.TRAJECTORY, ControlVariable.POSITION, TrapezoidalTrajectory(1.05))
    apart: list[float] = []

    def compare() -> None:
        if 0 < inc(rig) < INC_PER_RAD:
            apart.append(inc(rig, channel=2) + 0.5 * inc(rig))

    rig.runtime.every(0.001, compare)
    right.wait_until_done(3)
    left.wait_until_done(3)
    # The follower learns the leader's position with its count, and acts after that: two cycles.
    assert max(abs(x) for x in apart) < 0.5 * VELOCITY_MAX * 0.002 * INC_PER_RAD + 20
    assert right.position() == pytest.approx(-0.5, abs=WINDOW)


def test_failing_argument_stops_the_motor_and_raises(
    open_rig: OpenRig,
):
    rig = open_rig(one())
    left = enabled(rig)

    class Broken:
        name = "broken"
        rate_max = None
        calls = 0

        def value(self) -> float:
            self.calls += 1
            if self.calls > 300:
                raise ZeroDivisionError("as an example")
            return self.calls / 1000

    left.set_control_mode(ControlMode.TRAJECTORY)
    left.set_trajectory(
        ComplexTrajectory(Polynomial((0.0, 1.0)), 0.0, 1.0, relative=True), Broken()
    )
    left.start()
    with pytest.raises(PluginError, match="as an example"):
        left.wait_until_done(2)
    rig.runtime.run_for(0.5)
    where = inc(rig)
    rig.runtime.run_for(0.5)
    assert abs(inc(rig) - where) <= 1
    assert 0.2 < left.position() < 0.5
    assert left.state() is MotorState.ENABLED
    commanded(left, ControlMode.TRAJECTORY, ControlVariable.POSITION, TrapezoidalTrajectory(0.1))
    left.wait_until_done(2)
