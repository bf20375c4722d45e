"""Complex trajectories: values, errors, and demands."""

import pickle
from math import inf, nan, pi

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    LinkError,
    MotorModel,
    MotorPosition,
    StateError,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.commands import Setpoint
from motorhil.motorapi.functions import Piecewise, Polynomial
from motorhil.motorapi.planning import single_axis as planning
from motorhil.motorapi.planning.sampling import demand_of
from motorhil.motorapi.state import Measurement, MotorState
from motorhil.motorapi.trajectory import require_argument

MODEL = MotorModel(
    name="wheel", velocity_max=2.0, acceleration_max=4.0, position_min=-3.0, position_max=3.0
)
P, V, T = ControlVariable.POSITION, ControlVariable.VELOCITY, ControlVariable.TORQUE


def rest_to_rest(distance, duration_s):
    """Return 3 s² - 2 s³: from rest to rest."""
    d, t = distance, duration_s
    return Polynomial((0.0, 0.0, 3.0 * d / t**2, -2.0 * d / t**3)).restricted(0.0, t)


def test_complex_trajectory_has_value_semantics():
    one = ComplexTrajectory(rest_to_rest(1.0, 2.0), relative=True)
    same = ComplexTrajectory(rest_to_rest(1.0, 2.0), 0, 2, relative=True)
    assert one == same
    assert hash(one) == hash(same)
    assert pickle.loads(pickle.dumps(one)) == one
    assert one != ComplexTrajectory(rest_to_rest(1.0, 2.0))
    assert one.interval == (0.0, 2.0)
    assert "from 0.0 to 2.0, relative" in repr(one)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("sine",), "is not a function"),
        ((Polynomial((0.0, 1.0)),), "finite beginning and end"),
        ((rest_to_rest(1.0, 2.0), 0.0, 2.5), "final_argument 2.5 lies outside .* 0 to 2"),
        ((rest_to_rest(1.0, 2.0), -1.0), "initial_argument -1 lies outside"),
        ((rest_to_rest(1.0, 2.0), 1.0, 1.0), "is empty"),
        ((rest_to_rest(1.0, 2.0), nan), "initial_argument is nan"),
        ((rest_to_rest(1.0, 2.0), "0"), "initial_argument is '0'"),
    ],
)
def test_invalid_complex_trajectory_raises(arguments, says):
    with pytest.raises(UsageError, match=says):
        ComplexTrajectory(*arguments)


def test_boundary_derivatives_are_part_of_the_value():
    one = TrapezoidalTrajectory(1.0, 0.0, initial_derivatives=(0.5,), final_derivatives=[0.0, 1])
    assert (one.initial_velocity, one.final_velocity) == (0.5, 0.0)
    assert one.final_derivatives == (0.0, 1.0)
    assert repr(one) == (
        "<TrapezoidalTrajectory from 0.0 to 1.0, as fast as allowed, initial first derivative 0.5,"
        " final second derivative 1.0>"
    )
    assert pickle.loads(pickle.dumps(one)) == one
    later = TrapezoidalTrajectory(1.0, duration_s=2.0, initial_argument=3.0)
    assert later.final_argument == 5.0
    for wrong in ((1.0, 2.0, 3.0), 1.0, (inf,)):
        with pytest.raises(UsageError, match="initial_derivatives"):
            TrapezoidalTrajectory(1.0, initial_derivatives=wrong)
    with pytest.raises(UsageError, match="first derivative"):
        TrapezoidalTrajectory(1.0, initial_derivatives=(2,), limits=DerivativeLimits(first=1.0))


def check(trajectory, variable=P, argument=None):
    planning.check_trajectory("wheel", MODEL, variable, trajectory, argument)


@pytest.mark.parametrize(
    ("function", "variable", "quantity"),
    [
        (rest_to_rest(2.0, 1.0), P, "velocity of the trajectory 3"),
        (rest_to_rest(-2.9, 2.1), P, "velocity of the trajectory -2.07"),
        (rest_to_rest(0.5, 0.8), P, "acceleration of the trajectory"),
        (rest_to_rest(3.1, 9.0), P, "position of the trajectory 3.1"),
        (rest_to_rest(2.1, 9.0), V, "velocity of the trajectory 2.1"),
        (rest_to_rest(1.9, 0.5), V, "acceleration of the trajectory"),
    ],
)
def test_function_beyond_a_limit_raises_with_its_place(function, variable, quantity):
    with pytest.raises(LimitError, match=quantity):
        check(ComplexTrajectory(function), variable)


def test_function_with_a_kink_or_a_jump_raises():
    ramp = Polynomial((0.0, 1.0)).restricted(0.0, 1.0)
    with pytest.raises(
        UsageError, match=r"begins at 1 rad/s, at argument 0, where the motor is at rest"
    ):
        check(ComplexTrajectory(ramp))
    kink = Piecewise((0.0, 1.0, 2.0), (Polynomial((0.0, 0.0, 0.5)), Polynomial((0.5,))))
    with pytest.raises(LimitError, match="at argument 1, velocity jumps by -1 rad/s there"):
        check(ComplexTrajectory(kink))
    jump = Piecewise((0.0, 1.0, 2.0), (Polynomial((0.0,)), Polynomial((0.5,))))
    with pytest.raises(LimitError, match=r"at argument 1, position jumps by 0\.5 rad there"):
        check(ComplexTrajectory(jump))
    with pytest.raises(LimitError, match=r"at argument 1, velocity jumps by 0\.5 rad/s there"):
        check(ComplexTrajectory(jump), V)
    check(ComplexTrajectory(jump), T)  # torque may jump


@pytest.mark.parametrize(
    ("variable", "derivatives", "told"),
    [
        (V, (0.5,), r"with a first derivative of 0\.5 rad/s²;"),
        (V, (0.0, 0.5), r"with a second derivative of 0\.5 rad/s³;"),
        (T, (0.5,), r"with a first derivative of 0\.5 N·m/s;"),
    ],
)
def test_derivative_at_an_end_raises(variable, derivatives, told):
    with pytest.raises(UnsupportedError, match=f"{variable.value} that ends {told}"):
        check(TrapezoidalTrajectory(1.0, duration_s=9, final_derivatives=derivatives), variable)
    with pytest.raises(UnsupportedError, match=f"{variable.value} that begins {told}"):
        check(TrapezoidalTrajectory(1.0, duration_s=9, initial_derivatives=derivatives), variable)


def test_limits_in_place_of_relative_raise():
    limits = DerivativeLimits(first=0.5)
    with pytest.raises(
        UsageError, match=r"relative is DerivativeLimits\(.*; expected True or False"
    ):
        planning.check_setpoint("left", MODEL, P, Setpoint(1.0, limits))
    with pytest.raises(UsageError, match=r"relative is 1; expected True or False"):
        ComplexTrajectory(rest_to_rest(1.0, 2.0), relative=1)


def test_trajectory_beyond_float_arithmetic_raises():
    trajectory = TrapezoidalTrajectory(0.1, duration_s=1e300)
    with pytest.raises(
        UsageError, match=r"^wheel: <Trap.*> cannot be computed: one of its numbers is"
    ):
        check(trajectory)


class Leading:
    name = "leader"
    model = MODEL
    heard = Measurement(0, MotorState.ENABLED, 0.5)

    def latest(self):
        return self.heard


def test_argument_position_uses_the_speed_of_its_motor():
    argument = MotorPosition(Leading())
    assert argument.value() == 0.5
    gear = Polynomial((0.0, 1.0)).restricted(-1.0, 1.0)
    check(ComplexTrajectory(gear), argument=argument)  # it moves as fast as the leader, not faster
    with pytest.raises(LimitError, match=r"velocity of the trajectory 2.2 .* position of leader"):
        check(ComplexTrajectory(gear * 1.1), argument=argument)
    with pytest.raises(UnsupportedError, match="over the position of leader"):
        check(TrapezoidalTrajectory(1.0), argument=argument)


def test_position_of_an_offline_motor_raises():
    leader = Leading()
    argument = MotorPosition(leader)
    leader.heard = None
    with pytest.raises(UsageError, match="none has been received yet"):
        argument.value()
    leader.heard = Measurement(0, MotorState.OFFLINE, 0.5)
    with pytest.raises(LinkError, match=r"^leader: the position of leader is out of date"):
        argument.value()


@pytest.mark.parametrize("wrong", [nan, -1.0, "fast"])
def test_invalid_rate_max_of_an_argument_raises(wrong):
    argument = Leading()
    argument.value, argument.rate_max = float, wrong
    with pytest.raises(UsageError, match=r"^left: rate_max of .*; expected a number >= 0, or None"):
        require_argument("left", argument)
    for argument in (MotorPosition, object(), Leading()):
        with pytest.raises(UsageError, match=r"^left: .* is not an Argument; give an Argument"):
            require_argument("left", argument)


def planned(trajectory, variable=P, reference=0.0):
    check(trajectory, variable)
    return planning.plan_trajectory("wheel", MODEL, variable, trajectory, reference)


def test_relative_function_begins_at_the_position():
    function = rest_to_rest(1.0, 2.0) + 0.25
    motion = planned(ComplexTrajectory(function, relative=True), reference=1.5)
    assert (motion.start, motion.target, motion.duration_s) == (1.5, 2.5, 2.0)
    assert demand_of(motion).value(1.0) == 2.0
    assert planned(ComplexTrajectory(function), reference=0.25).target == 1.25
    with pytest.raises(StateError, match=r"begins at 0.25 rad, the motor is at 1.5 rad"):
        planned(ComplexTrajectory(function), reference=1.5)
    with pytest.raises(LimitError, match=r"target position 3.5"):
        planned(ComplexTrajectory(function, relative=True), reference=2.5)


def test_start_outside_the_limits_is_not_called_the_target():
    with pytest.raises(LimitError, match=r"^wheel: initial position 4 rad, allowed is -3 to 3"):
        planned(TrapezoidalTrajectory(1.0, initial=4.0), reference=4.0)
    with pytest.raises(LimitError, match=r"^wheel: target position 4 rad, allowed is -3 to 3"):
        planned(TrapezoidalTrajectory(4.0, initial=1.0), reference=1.0)


def test_motion_over_an_argument_begins_at_its_present_value():
    class Leader:
        name, rate_max = "leader", 1.0
        now = 0.5

        def value(self):
            return self.now

    leader = Leader()
    gear = Polynomial((0.0, 2.0)).restricted(0.0, 1.0)

    def plan(trajectory, reference):
        return planning.plan_trajectory("m", MODEL, P, trajectory, reference, argument=leader)

    assert plan(ComplexTrajectory(gear), 1.0).start == 1.0
    with pytest.raises(StateError, match=r"begins at 1 rad, the motor is at 0 rad"):
        plan(ComplexTrajectory(gear), 0.0)
    motion = plan(ComplexTrajectory(gear, relative=True), 0.25)
    assert (motion.start, motion.target, demand_of(motion).value(0.75)) == (0.25, 1.25, 0.75)
    leader.now = -3.0  # the gear has not engaged yet
    assert plan(ComplexTrajectory(gear), 0.0).start == 0.0


@pytest.mark.parametrize(
    ("trajectory", "takes_s"),
    [
        (TrapezoidalTrajectory(2.0), 0.5),  # 2 rad/s at 4 rad/s²
        (TrapezoidalTrajectory(2.0, limits=DerivativeLimits(first=1.0)), 2.0),
        (TrapezoidalTrajectory(2.0, duration_s=4.0), 4.0),
        (TrapezoidalTrajectory(-2.0, initial=0.0), 0.5),
    ],
)
def test_velocity_trajectory_is_a_ramp(trajectory, takes_s):
    motion = planned(trajectory, V)
    assert motion.duration_s == pytest.approx(takes_s, rel=1e-12)  # a division
    demand = demand_of(motion)
    assert demand.final_argument == motion.duration_s
    assert demand.value(takes_s / 2.0) == pytest.approx(trajectory.final / 2.0, rel=1e-12)
    assert demand.first(takes_s / 2.0) == pytest.approx(trajectory.final / takes_s, rel=1e-12)
    assert demand.value(takes_s + 1.0) == trajectory.final


def test_torque_trajectory_requires_a_slope_or_a_duration():
    torque_model = MotorModel(name="m", velocity_max=1.0, acceleration_max=1.0, torque_max=5.0)
    with pytest.raises(UsageError, match="duration_s"):
        planning.check_trajectory("m", torque_model, T, TrapezoidalTrajectory(2.0))
    with pytest.raises(LimitError, match="target torque 6"):
        planning.check_trajectory("m", torque_model, T, TrapezoidalTrajectory(6.0, initial=0.0))
    motion = planning.plan_trajectory(
        "m", torque_model, T, TrapezoidalTrajectory(2.0, duration_s=4.0), 1.0
    )
    assert (motion.start, motion.target, motion.slope) == (1.0, 3.0, 0.5)


durations = st.floats(0.2, 5.0)
distances = st.floats(-3.0, 3.0)


@given(distances, durations, st.floats(-1.0, 1.0))
def test_accepted_function_never_exceeds_a_limit(distance, duration_s, reference):
    trajectory = ComplexTrajectory(rest_to_rest(distance, duration_s), relative=True)
    try:
        motion = planned(trajectory, reference=reference)
    except LimitError:
        event("refused")
        # Closed form of 3 s² - 2 s³: peak velocity 1.5 D/T, peak acceleration 6 D/T².
        size = abs(distance)
        assert (
            size * 1.5 / duration_s > 2.0 * (1 - 1e-9)
            or size * 6.0 / duration_s**2 > 4.0 * (1 - 1e-9)
            or abs(reference + distance) > 3.0 * (1 - 1e-9)
        )
        return
    event("let pass")
    demand = demand_of(motion)
    for step in range(101):
        time_s = duration_s * step / 100.0
        assert -3.0 - 1e-8 <= demand.value(time_s) <= 3.0 + 1e-8
        assert abs(demand.first(time_s)) <= 2.0 + 1e-8
        assert abs(demand.second(time_s)) <= 4.0 + 1e-8


@given(
    st.floats(-6.0, 6.0).filter(lambda d: abs(d) > 1e-3),
    st.floats(0.1, 2.0),
    st.none() | st.floats(1.0, 3.0),
)
def test_demand_is_the_integral_of_its_derivatives(distance, speed, longer):
    limits = DerivativeLimits(first=speed, second=(-3.0, 1.5))
    model = MotorModel(name="m", velocity_max=2.0, acceleration_max=4.0)
    trajectory = TrapezoidalTrajectory(distance, limits=limits)
    motion = planning.plan_trajectory("m", model, P, trajectory, 0.5)
    if longer is not None:
        assert motion.duration_s is not None
        motion = planning.stretch(motion, motion.duration_s * longer)
    demand = demand_of(motion)
    assert demand.value(0.0) == 0.5
    assert demand.value(demand.final_argument) == 0.5 + distance
    steps = 400
    step_s = demand.final_argument / steps
    way, velocity = 0.0, 0.0
    for step in range(steps):
        middle_s = (step + 0.5) * step_s
        way += demand.first(middle_s) * step_s
        velocity += demand.second(middle_s) * step_s
        assert abs(demand.value(middle_s + 0.5 * step_s) - 0.5 - way) <= 4.0 * step_s**2
        assert abs(demand.first(middle_s + 0.5 * step_s) - velocity) <= 8.0 * step_s
    assert abs(demand.first(pi * demand.final_argument)) == 0.0


def test_demand_of_a_set_point_raises():
    motion = planning.plan_setpoint("m", MODEL, P, planning.Setpoint(1.0), 0.0)
    assert motion.mode is ControlMode.SETPOINT
    with pytest.raises(ValueError, match="no profile"):
        demand_of(motion)


def test_velocity_with_limited_jerk_rises_smoothly():
    """Follow a trapezoid of acceleration: 2 rad/s, 4 rad/s², 16 rad/s³: 0.25 s each phase."""
    limits = DerivativeLimits(second=16.0)
    motion = planned(TrapezoidalTrajectory(2.0, limits=limits), V)
    assert motion.function is not None
    assert motion.duration_s == pytest.approx(0.75, rel=1e-12)  # sums of three divisions
    demand = demand_of(motion)
    assert demand.value(0.25) == pytest.approx(0.5, rel=1e-12)
    assert demand.first(0.3) == 4.0
    assert demand.second(0.1) == 16.0
    slower = planned(TrapezoidalTrajectory(2.0, limits=limits, duration_s=1.5), V)
    assert slower.duration_s == 1.5
    slow = demand_of(slower)
    assert slow.value(0.5) == pytest.approx(0.5, rel=1e-12)
    assert slow.first(0.6) == pytest.approx(2.0, rel=1e-12)
    assert slow.value(1.5) == demand.value(0.75) == 2.0


def test_limit_on_an_unsupported_derivative_raises():
    with pytest.raises(UnsupportedError, match="a limit on derivative 3 of velocity"):
        check(TrapezoidalTrajectory(1.0, limits=DerivativeLimits(third=1.0)), V)
    setpoint = planning.Setpoint(1.0, limits=DerivativeLimits(third=1.0))
    with pytest.raises(UnsupportedError, match=r"derivative 3 .* limits on velocity and accel"):
        planning.check_setpoint("m", MODEL, P, setpoint)
    jerky = MotorModel(name="m", velocity_max=1.0, acceleration_max=1.0, jerk_max=9.0)
    smooth = TrapezoidalTrajectory(1.0, limits=DerivativeLimits(second=10.0))
    with pytest.raises(LimitError, match="jerk limit"):
        planning.check_trajectory("m", jerky, V, smooth)


def test_position_with_limited_jerk_takes_seven_phases():
    """Follow seven phases: 2 rad/s, 4 rad/s², 16 rad/s³: ramps of 0.5 + 0.25 s, 5 rad in 3.25 s.

    Source: Biagiotti & Melchiorri (2008), 3.4: D/v + v/a + a/j.
    """
    limits = DerivativeLimits(third=16.0)
    motion = planned(TrapezoidalTrajectory(5.0, limits=limits), reference=-2.5)
    assert motion.duration_s == pytest.approx(3.25, rel=1e-9)  # ruckig's own accuracy
    demand = demand_of(motion)
    for time_s, velocity in ((0.125, 0.125), (0.25, 0.5), (0.375, 1.0), (0.75, 2.0), (2.0, 2.0)):
        assert demand.first(time_s) == pytest.approx(velocity, rel=1e-8)
    assert (demand.value(0.0), demand.value(demand.final_argument)) == (-2.5, 2.5)
    longer = planning.stretch(motion, 6.5)
    assert longer.duration_s == 6.5
    assert demand_of(longer).first(3.25) == pytest.approx(1.0, rel=1e-8)
    assert planned(TrapezoidalTrajectory(0.0, limits=limits)).duration_s == 0.0
