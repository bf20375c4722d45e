from math import inf, nan
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.generation import ProfileLimits, possible_durations, trapezoid
from motorhil.motorapi.generation import batch as trapezoids
from motorhil.motorapi.generation.batched import LimitArrays
from tests.support.mathematics.problems import (
    directions_problem,
    magnitude,
    nearly_direct_problem,
    problems,
    random_problem,
)

UNIT = ProfileLimits(1.0, 1.0)


def together(some):
    """The same problems as arrays."""
    finals, limits, states = zip(*some, strict=True)
    arrays = {name: np.array([one[name] for one in states]) for name in states[0]}
    both = [
        np.array([getattr(one, name)[side] for one in limits])
        for name in ("velocity", "forward", "backward")
        for side in (0, 1)
    ]
    made = LimitArrays((both[0], both[1]), (both[2], both[3]))
    object.__setattr__(made, "back_rise", both[5])
    object.__setattr__(made, "back_fall", -both[4])
    return np.array(finals), made, arrays


def assert_is_as_one_by_one(made, singles, rounding=1e-12):
    """Same formulas, other order of a few operations: to rounding."""
    durations = np.array([one.duration_s for one in singles])
    np.testing.assert_allclose(made.duration_s, durations, rtol=1e-14, atol=0.0)
    for share in (-0.1, 0.0, 0.11, 0.35, 0.5, 0.77, 0.99, 1.0, 1.1):
        times = share * durations
        for order in ("value", "first"):
            told = np.array([getattr(one, order)(t) for one, t in zip(singles, times, strict=True)])
            found = getattr(made, order)(times)
            size = np.array([reach(one, order) for one in singles])
            assert (np.abs(found - told) <= rounding * size).all()
    times = 0.5 * durations
    edges = [
        min((abs(t - e) for e in (0.0, *one.switching_times_s)), default=0.0) > 1e-9 * t
        for one, t in zip(singles, times, strict=True)
    ]
    told = [one.second(t) for one, t in zip(singles, times, strict=True)]
    assert (made.second(times) == told)[edges].all()


def reach(profile, order):
    """The size of what is told; and what it changes by in 1e-3 of the duration, whose last digit
    may differ."""
    lasts = profile.duration_s
    if order == "value":
        return max(abs(x) for p in profile.pieces for x in (p[2], p[3], p[4] * lasts, p[5] * lasts))
    return max(abs(x) for p in profile.pieces for x in (p[4], p[5], 1e-3 * p[6] * lasts))


def test_many_are_as_one_by_one():
    random = Random("motorhil:batched")
    some = [random_problem(random, 2.0) for _ in range(3_000)]
    finals, limits, states = together(some)
    singles = [trapezoid(final, limits, **states) for final, limits, states in some]
    assert_is_as_one_by_one(trapezoids(finals, limits, **states), singles)


@given(st.lists(problems(), min_size=1, max_size=20))
def test_many_are_as_one_by_one_whatever_they_are(some):
    finals, limits, states = together(some)
    singles = [trapezoid(final, limits, **states) for final, limits, states in some]
    assert_is_as_one_by_one(trapezoids(finals, limits, **states), singles)


def test_many_ways_that_the_direct_ramp_nearly_covers_are_as_one_by_one():
    random = Random("motorhil:batched nearly direct")
    some = [nearly_direct_problem(random) for _ in range(300)]
    finals, limits, states = together(some)
    singles = [trapezoid(final, limits, **states) for final, limits, states in some]
    assert_is_as_one_by_one(trapezoids(finals, limits, **states), singles)


def test_many_of_given_durations_are_as_one_by_one():
    random = Random("motorhil:batched durations")
    some, lasting = [], []
    while len(some) < 3_000:
        make = random.choice((random_problem, directions_problem))
        final, limits, states = make(random, 1.0)
        ranges = possible_durations(final, limits, **states)
        low, high = random.choice(ranges)
        some.append((final, limits, states))
        lasting.append(min(low * (1.0 + magnitude(random, 2.0)), high))
    finals, limits, states = together(some)
    made = trapezoids(finals, limits, duration_s=np.array(lasting), **states)
    singles = [
        trapezoid(final, limits, duration_s=duration_s, **states)
        for (final, limits, states), duration_s in zip(some, lasting, strict=True)
    ]
    # At the edge of the possible the peak is known to the root of rounding only.
    assert_is_as_one_by_one(made, singles, rounding=1e-7)


def test_rest_to_rest_by_hand():
    # Ramps of 1/s² and at most 2/s: 1 takes 2 s, 4 takes 4 s, 10 takes 4 + 3 s.
    made = trapezoids(np.array([1.0, -4.0, 10.0, 0.0]), ProfileLimits(2.0, 1.0))
    assert made.duration_s.tolist() == [2.0, 4.0, 7.0, 0.0]
    assert made.peak.tolist() == [1.0, -2.0, 2.0, 0.0]
    assert made.hold_s.tolist() == [0.0, 0.0, 3.0, 0.0]
    assert made.value(2.0).tolist() == [1.0, -2.0, 2.0, 0.0]
    assert made.value([[1.0, 9.0]] * 4).tolist() == [[0.5, 1], [-0.5, -4], [0.5, 10], [0, 0]]
    assert made.first(1.0).tolist() == [1.0, -1.0, 1.0, 0.0]
    assert made.second(1.5).tolist() == [-1.0, -1.0, 1.0, 0.0]
    assert made.second(-1.0).tolist() == [0.0] * 4
    assert len(made) == 4


def test_limits_may_differ_by_motion_and_direction():
    ways = np.array([6.0, -6.0])
    made = trapezoids(ways, LimitArrays((-3.0, np.array([2.0, 9.0])), (-1.0, 2.0)))
    # Forward: up at 2, down at 1. Backward: up at 1 and down at 2, at most 3.
    assert made.duration_s[0] == trapezoid(6.0, ProfileLimits((-3.0, 2.0), (-1.0, 2.0))).duration_s
    # A triangle: 6 = u² (1/2 + 1) / 2, so u² = 8.
    assert made.peak[1] == pytest.approx(-(8.0**0.5), rel=1e-15)
    by_size = trapezoids(ways, LimitArrays(np.array([2.0, 2.0]), 2.0, 1.0))
    assert by_size.duration_s.tolist() == [4.5, 4.5]


def test_limits_are_never_exceeded_at_any_of_many_moments():
    random = Random("motorhil:batched limits")
    some = [random_problem(random, 2.0) for _ in range(500)]
    finals, limits, states = together(some)
    made = trapezoids(finals, limits, **states)
    corners = np.stack([made.rise_s, made.rise_s + made.hold_s, made.duration_s], axis=1)
    times = np.concatenate(
        [
            made.duration_s[:, None] * np.linspace(0.0, 1.0, 101),
            np.nextafter(corners, 0.0),
            corners,
            np.nextafter(corners, np.inf),
        ],
        axis=1,
    )
    velocity, acceleration = made.first(times), made.second(times)
    assert (limits.low[:, None] <= velocity).all()
    assert (velocity <= limits.high[:, None]).all()
    assert (-limits.fall[:, None] <= acceleration).all()
    assert (acceleration <= limits.rise[:, None]).all()


def test_the_first_motion_that_cannot_be_made_is_named():
    ways = np.ones(10_000)
    ways[7_000] = nan
    with pytest.raises(UsageError, match="motion 7000: the way is not a finite number"):
        trapezoids(ways, UNIT)
    fast = np.zeros(10_000)
    fast[9_999] = 1.5
    with pytest.raises(UsageError, match="motion 9999: a boundary velocity lies outside"):
        trapezoids(1.0, UNIT, final_velocity=fast)
    with pytest.raises(UsageError, match="motion 7000: the way is not a finite number"):
        trapezoids(ways, UNIT, initial_velocity=0.5)
    with pytest.raises(UsageError, match="motion 1: the limits allow no such motion"):
        trapezoids(np.array([1.0, -1.0]), ProfileLimits((0.0, 1.0), 1.0))
    with pytest.raises(UsageError, match="motion 1: the limits allow no such motion"):
        trapezoids(np.array([1.0, -1.0]), ProfileLimits((0.0, 1.0), 1.0), initial_velocity=0.5)
    with pytest.raises(UsageError, match="motion 1: not possible in its duration"):
        trapezoids(1.0, UNIT, duration_s=np.array([2.0, 1.9]))
    through = {"initial_velocity": 1.0, "final_velocity": 1.0}
    with pytest.raises(UsageError, match="motion 2: not possible in its duration"):
        trapezoids(0.5, UNIT, duration_s=np.array([0.5, 0.55, 0.6, 4.0]), **through)
    with pytest.raises(UsageError, match="motion 0: the duration is not a finite number"):
        trapezoids(1.0, UNIT, duration_s=np.array([nan]))


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize("bad", [0.0, -1.0, nan])
def test_the_first_limit_that_is_none_is_named(place, bad):
    arguments = [np.ones(3), np.ones(3), np.ones(3)]
    arguments[place][2] = bad
    with pytest.raises(UsageError, match="motion 2: "):
        LimitArrays(*arguments)


def test_limits_without_sense_are_refused():
    with pytest.raises(UsageError, match="not with a range"):
        LimitArrays(1.0, (-1.0, 1.0), 1.0)
    with pytest.raises(UsageError, match="do not bound it"):
        trapezoids(1.0, ProfileLimits(inf, inf))
