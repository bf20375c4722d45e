from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.motorapi.commands import ControlVariable, DerivativeLimits
from motorhil.motorapi.errors import LimitError, UsageError
from motorhil.motorapi.functions import Piecewise, Polynomial
from motorhil.motorapi.generation import (
    Feasibility,
    ProfileLimits,
    feasible,
    generate,
    jerk_limited,
    through_waypoints,
    trapezoid,
)
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.trajectory import ComplexTrajectory, TrapezoidalTrajectory
from tests.support.mathematics.problems import problems

MODEL = MotorModel(
    name="wheel",
    velocity_max=2.0,
    acceleration_max=4.0,
    deceleration_max=1.0,
    position_min=-3.0,
    position_max=3.0,
)
SMOOTH = MotorModel(name="smooth", velocity_max=2.0, acceleration_max=4.0, jerk_max=10.0)
PARABOLA = Polynomial([0.0, 0.0, 0.5])  # t² / 2: velocity t, acceleration 1


def only(feasibility):
    (violation,) = feasibility.violations
    return violation


def test_feasible_motion_is_true_and_reads_feasible():
    answer = feasible(TrapezoidalTrajectory(1.0), MODEL)
    assert answer
    assert answer == Feasibility()
    assert str(answer) == "feasible"


def test_reversing_motion_that_leaves_the_range_is_violation():
    # From 2.5 rad at 2 rad/s and 1 rad/s² it inevitably reaches 4.5 rad, after 2 s.
    answer = feasible(TrapezoidalTrajectory(2.0, 2.5, initial_derivatives=(2.0,)), MODEL)
    assert not answer
    violation = only(answer)
    assert (violation.quantity, violation.value, violation.argument) == ("position", 4.5, 2.0)
    assert (violation.low, violation.high, violation.by) == (-3.0, 3.0, 1.5)
    assert str(answer) == "position 4.5 rad at 2 s is 1.5 rad above the highest, 3 rad"


def test_violation_reports_the_worst_moment():
    answer = feasible(TrapezoidalTrajectory(3.25, 3.5, initial_derivatives=(2.0,)), MODEL)
    assert [(v.value, v.argument) for v in answer.violations] == [(5.5, 2.0)]


def test_boundary_velocity_beyond_its_limit_is_violation():
    violation = only(feasible(TrapezoidalTrajectory(1.0, final_derivatives=(-2.5,)), MODEL))
    assert (violation.quantity, violation.value, violation.by) == ("velocity", -2.5, 0.5)
    assert violation.argument is None
    assert (
        str(violation)
        == "velocity -2.5 rad/s is 0.5 rad/s below the lowest, -2 rad/s: where it ends"
    )
    began = only(
        feasible(
            TrapezoidalTrajectory(1.0, initial_derivatives=(2.5,), initial_argument=7.0), MODEL
        )
    )
    assert (began.argument, began.reason) == (7.0, "where it begins")


def test_duration_too_short_or_in_a_gap_is_violation():
    violation = only(feasible(TrapezoidalTrajectory(1.0, duration_s=1.0), MODEL))
    assert (violation.quantity, violation.unit) == ("duration", "s")
    # A triangle up at 4 and down at 1: T = sqrt(2 (1/4 + 1)).
    assert violation.low == pytest.approx(2.5**0.5, rel=1e-15)
    assert violation.by == pytest.approx(2.5**0.5 - 1.0, rel=1e-14)
    assert feasible(TrapezoidalTrajectory(1.0, duration_s=violation.low * (1 - 1e-10)), MODEL)
    assert not feasible(TrapezoidalTrajectory(1.0, duration_s=violation.low * (1 - 1e-8)), MODEL)
    through = {"initial_derivatives": (1.0,), "final_derivatives": (1.0,)}
    gap = feasible(TrapezoidalTrajectory(0.1, duration_s=1.0, **through), MODEL)
    assert only(gap).high < 1.0
    assert "it can move back and return" in str(gap)
    assert feasible(TrapezoidalTrajectory(0.1, duration_s=10.0, **through), MODEL)


def test_function_violations_equal_hand_results():
    assert feasible(PARABOLA, MODEL, interval=(0.0, 1.0))
    # Until 3 s: velocity 3 and position 4.5 at the end.
    answer = feasible(PARABOLA, MODEL, interval=(0.0, 3.0))
    assert [(v.quantity, v.value, v.argument, v.by) for v in answer.violations] == [
        ("position", 4.5, 3.0, 1.5),
        ("velocity", 3.0, 3.0, 1.0),
    ]
    # Deceleration of 2 rad/s² is too much, acceleration is not.
    steep = Polynomial([0.0, 0.0, 1.0])
    assert feasible(steep, MODEL, interval=(0.0, 1.0))
    slowing = feasible(steep, MODEL, interval=(-1.0, 0.0))
    assert (only(slowing).quantity, only(slowing).by) == ("acceleration", 1.0)


def test_violation_of_plain_limits_names_derivatives():
    limits = DerivativeLimits(first=(-0.5, 1.0), second=0.25, third=0.1)
    answer = feasible(Polynomial([0.0, 0.0, 0.0, 1.0 / 6.0]), limits, interval=(0.0, 2.0))
    assert [str(v) for v in answer.violations] == [
        "first derivative 2 at 2 s is 1 above the highest, 1",
        "second derivative 2 at 2 s is 1.75 above the highest, 0.25",
        "third derivative 1 at 0 s is 0.9 above the highest, 0.1",
    ]
    assert not feasible(TrapezoidalTrajectory(1.0, duration_s=0.5), limits)
    assert feasible(TrapezoidalTrajectory(1.0), limits)


def test_complex_trajectory_brings_interval_limits_and_start():
    climb = ComplexTrajectory(PARABOLA, 0.0, 2.0, relative=True)
    assert feasible(climb, MODEL, start=0.5)
    assert only(feasible(climb, MODEL, start=1.5)).value == 3.5
    later = ComplexTrajectory(PARABOLA, 1.0, 2.0, relative=True)
    assert only(feasible(later, MODEL, start=2.0)).value == 3.5
    tight = ComplexTrajectory(PARABOLA, 0.0, 2.0, limits=DerivativeLimits(first=1.5))
    assert only(feasible(tight, MODEL)).by == 0.5
    velocity = ComplexTrajectory(PARABOLA, 0.0, 3.0)
    answer = feasible(velocity, MODEL, variable=ControlVariable.VELOCITY)
    assert [(v.quantity, v.unit) for v in answer.violations] == [
        ("velocity", "rad/s"),
        ("acceleration", "rad/s²"),
    ]


def test_step_violates_the_next_derivative():
    jump = Piecewise((0.0, 1.0, 2.0), (Polynomial([0.0]), Polynomial([0.5])))
    violation = only(feasible(jump, MODEL))
    assert (violation.quantity, violation.value, violation.by) == ("velocity", inf, inf)
    assert violation.argument == 1.0
    assert violation.reason == "position jumps by 0.5 rad there"
    kink = Piecewise((0.0, 1.0, 2.0), (Polynomial([0.0]), Polynomial([0.0, -0.5], about=1.0)))
    assert str(feasible(kink, MODEL)) == (
        "acceleration -inf rad/s² at 1 s is inf rad/s² below the lowest, -1 rad/s²:"
        " velocity jumps by -0.5 rad/s there"
    )
    # 10 ms of the next derivative's limit are permitted: samples are no smoother.
    small = Piecewise((0.0, 1.0, 2.0), (Polynomial([0.0]), Polynomial([0.0, 0.009], about=1.0)))
    assert feasible(small, MODEL)


def test_feasible_of_an_unbounded_function_raises():
    with pytest.raises(UsageError, match="give interval="):
        feasible(PARABOLA, MODEL)


def test_generated_motions_are_feasible():
    profile = generate(TrapezoidalTrajectory(2.0, -1.0, initial_derivatives=(-1.0,)), MODEL)
    assert feasible(profile, MODEL)
    assert feasible(profile.as_function(), MODEL)
    course = through_waypoints([0.0, 2.0, -1.0], limits=DerivativeLimits(first=2.0, second=1.0))
    assert feasible(course, MODEL)


def test_only_ruckig_motions_are_feasible_with_limited_jerk():
    limits = ProfileLimits(2.0, 4.0)
    assert feasible(jerk_limited(2.0, limits, 10.0), SMOOTH)
    violation = feasible(trapezoid(2.0, limits).as_function(), SMOOTH).violations[0]
    assert (violation.quantity, abs(violation.value)) == ("jerk", inf)


@given(problems(1.0))
def test_profiles_are_feasible_for_no_tighter_limits(problem):
    final, limits, states = problem
    if limits.forward != limits.backward:
        return
    profile = trapezoid(final, limits, **states)
    told = DerivativeLimits(first=limits.velocity, second=limits.forward)
    assert feasible(profile, told)
    most = profile.velocity_range[1]
    if most > 0.01 and most > 0.5 * limits.velocity[1]:
        tight = DerivativeLimits(first=(limits.velocity[0], 0.5 * most))
        violation = only(feasible(profile, tight))
        assert violation.by == pytest.approx(0.5 * most, rel=1e-12)
        assert profile.first(violation.argument) == pytest.approx(most, rel=1e-9)


@given(
    st.floats(-2.9, 2.9),
    st.floats(-2.9, 2.9),
    st.floats(-2.0, 2.0),
    st.floats(-2.0, 2.0),
    st.none() | st.floats(0.1, 10.0),
)
def test_generate_raises_exactly_for_infeasible_motions(initial, final, begin, end, duration_s):
    trajectory = TrapezoidalTrajectory(
        final,
        initial,
        duration_s=duration_s,
        initial_derivatives=(begin,),
        final_derivatives=(end,),
    )
    answer = feasible(trajectory, MODEL)
    if answer:
        profile = generate(trajectory, MODEL)
        assert feasible(profile, MODEL)
        return
    with pytest.raises(LimitError) as told:
        generate(trajectory, MODEL)
    violation = answer.violations[0]
    assert told.value.value == violation.value
    assert violation.by > 0.0
