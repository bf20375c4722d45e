import sys
from math import inf, nan
from random import Random

import pytest

from motorhil.motorapi.errors import PluginError, UnsupportedError, UsageError
from motorhil.motorapi.generation import ProfileLimits, jerk_limited, trapezoid
from motorhil.motorapi.generation.jerk_limited import phases_in
from tests.support.mathematics.problems import magnitude
from tests.support.mathematics.smooth_bounds import is_impossible, rest_to_rest_s
from tests.support.repetition import examples

UNIT = ProfileLimits(1.0, 1.0)


def smooth_problem(random, decades):
    """Return (final, limits, jerk, states) whose states are reachable within the limits."""
    velocity = (-magnitude(random, decades), magnitude(random, decades))
    acceleration = (-magnitude(random, decades), magnitude(random, decades))
    jerk = magnitude(random, decades)
    states = []
    for sense in (1.0, -1.0):
        a = random.choice([0.0, random.uniform(*acceleration)])
        moves = sense * a * abs(a) / (2.0 * jerk)  # inevitable further change of velocity
        low, high = velocity[0] - min(moves, 0.0), velocity[1] - max(moves, 0.0)
        if low >= high:
            a, low, high = 0.0, *velocity
        states.append(
            (
                random.choice([0.0, random.uniform(low, high)])
                if low < 0 < high
                else random.uniform(low, high),
                a,
            )
        )
    final = random.choice([-1.0, 1.0]) * magnitude(random, decades)
    return final, ProfileLimits(velocity, acceleration), jerk, tuple(states)


def made(problem, **more):
    final, limits, jerk, (begin, end) = problem
    return jerk_limited(
        final, limits, jerk, initial_derivatives=begin, final_derivatives=end, **more
    )


def assert_is_right(function, problem, rounding):
    """Check both states, continuity and all limits."""
    final, limits, jerk, (begin, end) = problem
    low, high = function.domain
    derivatives = [function.derivative(order) for order in range(4)]
    assert [derivative.value(low) for derivative in derivatives[:3]] == [0.0, *begin]
    assert [derivative.value(high) for derivative in derivatives[:3]] == [final, *end]
    extent = [one.extrema() for one in derivatives]
    size = [max(abs(one.minimum), abs(one.maximum)) for one in extent]
    for order in range(3):
        for left, right, at in zip(
            derivatives[order].pieces,
            derivatives[order].pieces[1:],
            function.breaks[1:-1],
            strict=False,
        ):
            step = abs(left.value(at) - right.value(at))
            # In a long function, the argument does not resolve shorter moments.
            assert step <= rounding * size[order] + 4e-16 * high * size[order + 1]
    for order, (lowest, highest) in (
        (1, limits.velocity),
        (2, limits.forward),
        (3, (-jerk, jerk)),
    ):
        slack = 1e-9 * max(-lowest, highest) + 1e-12 * size[order]
        slack += 4e-16 * high * size[order + 1] if order < 3 else 0.0
        assert lowest - slack <= extent[order].minimum
        assert extent[order].maximum <= highest + slack


def test_random_motions_meet_states_and_limits():
    random = Random("motorhil:smooth")
    for _ in range(examples(600)):
        problem = smooth_problem(random, 1.0)
        function = made(problem)
        assert_is_right(function, problem, 1e-10)
        final, limits, _, (begin, end) = problem
        rough = trapezoid(final, limits, initial_velocity=begin[0], final_velocity=end[0])
        # Without a limit of jerk it cannot take longer, unless it has to reverse for nothing.
        assert rough.duration_s <= function.domain[1] * (1 + 1e-9)


def test_limits_three_decades_apart_are_met_or_reported():
    random = Random("motorhil:smooth decades")
    refused = []
    for _ in range(500):
        problem = smooth_problem(random, 3.0)
        try:
            function = made(problem)
        except PluginError:
            refused.append(problem)
            continue
        assert_is_right(function, problem, 1e-8)
    assert 0 < len(refused) < 100
    final, limits, jerk, (begin, end) = refused[0]
    with pytest.raises(PluginError, match=r"ruckig: .*: no motion from "):
        jerk_limited(final, limits, jerk, initial_derivatives=begin, final_derivatives=end)


def test_rest_to_rest_takes_the_time_of_the_double_s_profile():
    random = Random("motorhil:double S")
    for _ in range(examples(300)):
        way, velocity, acceleration, jerk = (magnitude(random, 2.0) for _ in range(4))
        function = jerk_limited(way, ProfileLimits(velocity, acceleration), jerk)
        expected = rest_to_rest_s(way, velocity, acceleration, jerk)
        assert function.domain[1] == pytest.approx(expected, rel=1e-9)


def test_linear_program_finds_no_shorter_motion():
    from scipy import optimize

    random = Random("motorhil:linear program")
    for _ in range(12):
        final, limits, jerk, (begin, end) = problem = smooth_problem(random, 0.5)
        duration_s = made(problem).domain[1]
        asked = ((0.0, *begin), (final, *end), limits.velocity, limits.forward, jerk)
        assert is_impossible(optimize.linprog, *asked, 0.97 * duration_s)
        assert not is_impossible(optimize.linprog, *asked, 1.001 * duration_s)


@pytest.mark.parametrize("length", [1e-9, 1e-3, 1e9])
@pytest.mark.parametrize("time", [1e-6, 1e6])
def test_result_does_not_depend_on_units(length, time):
    random = Random("motorhil:smooth units")
    for _ in range(50):
        final, limits, jerk, (begin, end) = problem = smooth_problem(random, 1.0)
        velocity, acceleration = length / time, length / time**2
        scaled = (
            final * length,
            ProfileLimits(
                tuple(x * velocity for x in limits.velocity),
                tuple(x * acceleration for x in limits.forward),
            ),
            jerk * length / time**3,
            tuple((v * velocity, a * acceleration) for v, a in (begin, end)),
        )
        expected = made(problem).domain[1] * time
        assert made(scaled).domain[1] == pytest.approx(expected, rel=1e-9)


def test_given_duration_is_met_or_reported_as_impossible():
    function = jerk_limited(1.0, UNIT, 1.0, duration_s=10.0, initial_argument=5.0)
    assert function.domain == pytest.approx((5.0, 15.0), rel=1e-12)
    assert function.value(15.0) == 1.0
    with pytest.raises(
        UsageError, match=r"cannot take 1 s; the next possible duration is 3\.1748 s"
    ):
        jerk_limited(1.0, UNIT, 1.0, duration_s=1.0)
    with pytest.raises(UsageError, match="not a finite number >= 0"):
        jerk_limited(1.0, UNIT, 1.0, duration_s=-1.0)


def test_limits_by_direction_use_the_tighter_one():
    limits = ProfileLimits(10.0, 4.0, 2.0)
    moving = jerk_limited(1.0, limits, 1e6, initial_derivatives=(0.1,))
    assert moving.derivative(2).extrema().maximum <= 2.0 + 1e-9


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_limits_by_direction_are_used_from_rest_to_rest(sign):
    limits = ProfileLimits(10.0, 4.0, 2.0)
    found = jerk_limited(sign, limits, 1e6).derivative(2).extrema()
    fastest, slowest = sorted((abs(found.minimum), found.maximum), reverse=True)
    assert (fastest, slowest) == pytest.approx((4.0, 2.0), rel=1e-9)
    trapezoid_s = trapezoid(sign, limits).duration_s
    assert jerk_limited(sign, limits, 1e6).domain[1] == pytest.approx(trapezoid_s, rel=1e-4)


def test_rest_to_rest_is_as_short_as_that_of_ruckig():
    random = Random(1)
    for _ in range(examples(300)):
        final, velocity, acceleration, jerk = (magnitude(random, 2) for _ in range(4))
        limits = ProfileLimits(velocity, acceleration)
        own = jerk_limited(final, limits, jerk)
        other = jerk_limited(final, limits, jerk, initial_derivatives=(1e-15,))
        assert own.domain[1] == pytest.approx(other.domain[1], rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"jerk": 0.0}, "limit of jerk is 0.0"),
        ({"jerk": inf}, "limit of jerk is inf"),
        ({"final": nan}, "not finite"),
        ({"initial_argument": inf}, "not a finite number"),
        ({"initial_derivatives": (1.5,)}, "initial velocity 1.5 lies outside its limits, -1 to 1"),
        ({"final_derivatives": (0.0, -2.0)}, "final acceleration -2 lies outside its limits"),
        ({"initial_derivatives": (0.9, 0.9)}, "initial velocity, by its acceleration, 1.305"),
        ({"final_derivatives": (0.9, -0.9)}, "final velocity, by its acceleration, 1.305"),
        ({"final_derivatives": (0.0, 0.0, 0.0)}, "derivatives are"),
        ({"final": 0.0}, "takes no time"),
    ],
)
def test_impossible_requests_raise(arguments, told):
    arguments = {"final": 1.0, "limits": UNIT, "jerk": 1.0} | arguments
    with pytest.raises(UsageError, match=told):
        jerk_limited(**arguments)


def test_brake_phases_of_ruckig_are_included():
    """Start outside the limits by rounding, where ruckig brakes first."""
    import ruckig

    given = ruckig.InputParameter(1)
    given.current_velocity, given.target_position = [2.5], [1.0]
    given.max_velocity, given.max_acceleration, given.max_jerk = [2.0], [1.0], [3.0]
    made = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(given, made)
    assert made.profiles[0][0].brake.duration > 0.0
    phases = phases_in(made.profiles[0][0], 1.0, 1.0)
    assert sum(lasts_s for lasts_s, _ in phases) == pytest.approx(made.duration, rel=1e-12)


def test_missing_package_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "ruckig", None)
    with pytest.raises(UnsupportedError, match=r"pip install 'motorhil\[ruckig\]'"):
        jerk_limited(1.0, UNIT, 1.0, initial_derivatives=(0.5,))
    assert jerk_limited(1.0, UNIT, 1.0).value(3.0) <= 1.0  # from rest to rest it is not needed
