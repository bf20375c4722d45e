from fractions import Fraction
from math import inf, nan
from random import Random

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.generation import ProfileLimits, possible_durations, stretched, trapezoid
from tests.support.mathematics.problems import (
    assert_is_admissible,
    directions_problem,
    envelope_of,
    magnitude,
    problems,
    random_problem,
    sizes,
    way_of,
)
from tests.support.repetition import examples

UNIT = ProfileLimits(1.0, 1.0)
THROUGH = {"initial_velocity": 1.0, "final_velocity": 1.0}
ROUNDING = Fraction(1, 10**9)  # a duration within this distance counts as a possible one


def lasting(problem, duration_s):
    final, limits, states = problem
    try:
        return trapezoid(final, limits, duration_s=duration_s, **states)
    except UsageError:
        return None


def test_rest_to_rest_of_given_duration_equals_hand_result():
    # 3 in 4 s with ramps of 1/s²: u (4 - u) = 3, so u = 1.
    profile = trapezoid(3.0, ProfileLimits(9.0, 1.0), duration_s=4.0)
    assert [piece[1] for piece in profile.pieces] == [1.0, 3.0, 4.0]
    assert profile.velocity_range == (0.0, 1.0)


def test_zero_distance_may_take_any_time():
    held = trapezoid(2.0, UNIT, initial=2.0, duration_s=3.0)
    assert held.duration_s == 3.0
    assert held.value_range == (2.0, 2.0)
    assert trapezoid(2.0, UNIT, initial=2.0, duration_s=0.0).duration_s == 0.0


def test_slow_motion_over_a_distance_too_short_to_stop():
    # From 1 to 1 over 0.5 at 1/s²: at least 0.5 s. With the slowest recoverable velocity, u² = 1 -
    # 0.5, in 2 (1 - u). Later: to u = -0.5^0.5 and back up, in 2 (1 + 0.5^0.5) s.
    u = 0.5**0.5
    (first, second) = possible_durations(0.5, UNIT, **THROUGH)
    assert first == pytest.approx((0.5, 2.0 * (1.0 - u)), rel=1e-15)  # rounding of the root
    assert second == (pytest.approx(2.0 * (1.0 + u), rel=1e-15), inf)
    slowest = trapezoid(0.5, UNIT, duration_s=first[1], **THROUGH)
    # The peak at a boundary of the possible range is known to the root of rounding.
    assert slowest.velocity_range[0] == pytest.approx(u, rel=1e-7)
    back = trapezoid(0.5, UNIT, duration_s=second[0], **THROUGH)
    assert back.velocity_range[0] == pytest.approx(-u, rel=1e-7)
    later = trapezoid(0.5, UNIT, duration_s=100.0, **THROUGH)
    assert -0.01 < later.velocity_range[0] < 0.0


def test_duration_in_a_gap_error_lists_possible_ranges():
    told = (
        r"cannot take 1 s, only from 0.5 to 0.585786 s or at least 3.41421 s: in between the motion"
    )
    with pytest.raises(UsageError, match=told):
        trapezoid(0.5, UNIT, duration_s=1.0, **THROUGH)
    with pytest.raises(
        UsageError, match=r"only from 0.5 .*: the limits do not allow a shorter one"
    ):
        trapezoid(0.5, UNIT, duration_s=0.4, **THROUGH)
    with pytest.raises(
        UsageError, match=r"only at least 2 s: the limits do not allow a shorter one"
    ):
        trapezoid(1.0, UNIT, duration_s=1.99)


def test_motion_without_backward_range_has_a_maximum_time():
    one_way = ProfileLimits((0.0, 1.0), 1.0)
    ((low, high),) = possible_durations(0.5, one_way, **THROUGH)
    assert (low, high) == pytest.approx((0.5, 2.0 * (1.0 - 0.5**0.5)), rel=1e-15)
    with pytest.raises(UsageError, match=r"only from 0.5 to 0.585786 s:"):
        trapezoid(0.5, one_way, duration_s=1.0, **THROUGH)
    assert possible_durations(1.0, one_way, **THROUGH) == ((1.0, inf),)  # sufficient to stop


def test_distance_just_sufficient_to_stop_permits_a_stop():
    held = trapezoid(1.0, UNIT, duration_s=10.0, **THROUGH)
    assert held.velocity_range == (0.0, 1.0)
    assert held.value(5.0) == 0.5


def test_duration_without_limits_makes_a_straight_line():
    line = trapezoid(-3.0, ProfileLimits(inf, inf), duration_s=2.0)
    assert line.pieces == ((0.0, 2.0, 0.0, -3.0, -1.5, -1.5, 0.0),)


@pytest.mark.parametrize("bad", [nan, inf, -1.0])
def test_invalid_duration_raises(bad):
    with pytest.raises(UsageError, match="not a finite number >= 0"):
        trapezoid(1.0, UNIT, duration_s=bad)


@given(problems(), st.floats(0.0, 3.0), st.booleans())
def test_possible_durations_equal_those_of_the_envelope(problem, power, near):
    """Compare with the envelope of all motions, in exact arithmetic."""
    final, limits, states = problem
    fastest = trapezoid(final, limits, **states).duration_s
    duration_s = fastest * (1.0 + 10.0 ** -(2.0 + 2.0 * power) if near else 10.0**power)
    profile = lasting(problem, duration_s)
    envelope, way = envelope_of(limits, states), way_of(final, states)
    if profile is None:
        event("impossible")
        assert not envelope.is_possible(way, Fraction(duration_s))
        return
    event("possible")
    assert_is_admissible(profile, final, limits, states)
    # The edges of the range are rounded, and a duration within 1e-9 of one counts as possible.
    assert profile.duration_s == pytest.approx(duration_s, rel=2e-9)
    assert any(
        envelope.is_possible(way, Fraction(duration_s) * (1 + shift))
        for shift in (0, ROUNDING, -ROUNDING)
    ) or duration_s < fastest * (1 + 1e-8)


def test_durations_of_random_motions_are_exact():
    random = Random("motorhil:durations")
    for index in range(examples(1_000)):
        make = (random_problem, directions_problem)[index % 2]
        final, limits, states = make(random, 1.0)
        low, high = random.choice(possible_durations(final, limits, **states))
        duration_s = min(low * (1.0 + magnitude(random, 2.0)), high)
        profile = trapezoid(final, limits, duration_s=duration_s, **states)
        assert profile.duration_s == duration_s
        assert_is_admissible(profile, final, limits, states)


def test_duration_within_rounding_of_a_possible_one_is_used():
    ((low, high), (back, _)) = possible_durations(0.5, UNIT, **THROUGH)
    for asked, taken in (
        (low * (1 - 1e-10), low),
        (high * (1 + 1e-10), high),
        (back * (1 - 1e-10), back),
    ):
        assert trapezoid(0.5, UNIT, duration_s=asked, **THROUGH).duration_s == taken
    for asked in (low * (1 - 1e-8), high * (1 + 1e-8), back * (1 - 1e-8)):
        with pytest.raises(UsageError, match="cannot take"):
            trapezoid(0.5, UNIT, duration_s=asked, **THROUGH)


def gap_problem(random):
    """Return two velocities in one direction, with a distance too short to stop."""
    _, limits, states = random_problem(random, 1.0)
    sign = random.choice([-1.0, 1.0])
    top = limits.velocity[1] if sign > 0 else -limits.velocity[0]
    begin, end = random.uniform(0.1, 1.0) * top, random.uniform(0.1, 1.0) * top
    # A stop and a new start need at least this distance; the direct ramp needs less.
    way = min(begin, end) ** 2 / 2 / max(*limits.forward, *map(abs, limits.forward))
    states = {"initial": 0.0, "initial_velocity": sign * begin, "final_velocity": sign * end}
    sizes = limits.forward if sign * (end - begin) < 0 else limits.forward[::-1]
    direct = (end * end - begin * begin) / 2 / sizes[0] * sign
    return sign * (abs(direct) + random.random() * way), limits, states


def test_gaps_are_exactly_where_no_motion_exists():
    random = Random("motorhil:gaps")
    gaps = 0
    for _ in range(150):
        final, limits, states = gap_problem(random)
        ranges = possible_durations(final, limits, **states)
        envelope, way = envelope_of(limits, states), way_of(final, states)
        if len(ranges) == 1:
            continue
        gaps += 1
        (low, high), (back, _) = ranges
        for duration, possible in (
            (Fraction(low) * (1 - ROUNDING), False),
            (Fraction(low + high) / 2, True),
            (Fraction(high) * (1 + ROUNDING), False),
            (Fraction(high + back) / 2, False),
            (Fraction(back) * (1 - ROUNDING), False),
            (Fraction(back) * (1 + ROUNDING), True),
        ):
            assert envelope.is_possible(way, duration) is possible, (final, limits, states)
    assert gaps > 75


@given(sizes(3.0), sizes(3.0), sizes(3.0), st.floats(1.001, 1e6))
def test_rest_to_rest_duration_equals_stretched(way, up, down, factor):
    limits = ProfileLimits(inf, up, down)
    duration_s = trapezoid(way, limits).duration_s * factor
    old, new = stretched(way, duration_s, up, down), trapezoid(way, limits, duration_s=duration_s)
    assert new.duration_s == duration_s
    # Two ways to round a root, which near the shortest duration doubles the lost digits.
    assert new.velocity_range[1] == pytest.approx(old.peak, rel=1e-12)


def test_gaps_equal_those_of_ruckig():
    """Compare with ruckig, which takes the next possible duration above a minimum."""
    import ruckig

    random = Random("motorhil:gaps of ruckig")
    compared = 0
    for _ in range(examples(600)):
        final, limits, states = (
            gap_problem(random) if random.random() < 0.5 else random_problem(random, 1.0)
        )
        ranges = possible_durations(final, limits, **states)
        asked = ranges[0][0] * (1.0 + magnitude(random, 1.0))
        inside = [low for low, high in ranges if asked <= high]
        expected = max(asked, inside[0])
        given_ = ruckig.InputParameter(1)
        given_.current_position, given_.target_position = [states["initial"]], [final]
        given_.current_velocity = [states["initial_velocity"]]
        given_.target_velocity = [states["final_velocity"]]
        given_.min_velocity, given_.max_velocity = [limits.velocity[0]], [limits.velocity[1]]
        given_.min_acceleration = [limits.forward[0]]
        given_.max_acceleration = [limits.forward[1]]
        given_.minimum_duration = asked
        made = ruckig.Trajectory(1)
        try:
            ruckig.Ruckig(1).calculate(given_, made)
        except ruckig.RuckigError:
            continue
        compared += 1
        assert made.duration == pytest.approx(expected, rel=1e-9)
    assert compared > examples(300)
