from fractions import Fraction
from math import inf, nan, sqrt

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.generation import shortest, stretched

SIZE = st.floats(1e-3, 1e3)
WAY = st.floats(-1e4, 1e4).filter(lambda way: way == 0.0 or abs(way) > 1e-6)


def integrated_way(profile):
    """Return the distance by exact integration of the velocity, an independent reading."""
    up = Fraction(profile.ramp_up_s)
    plateau = Fraction(profile.ramp_down_s) - up
    down = Fraction(profile.duration_s) - Fraction(profile.ramp_down_s)
    return float(Fraction(profile.peak) * (up / 2 + plateau + down / 2))


def test_paper_figure_5_is_a_trapezoid():
    # By hand: 10 rad at 2 rad/s and 1 rad/s²: ramps of 2 s over 2 rad each, plateau 6 rad in 3 s.
    profile = shortest(10.0, 2.0, 1.0, 1.0)
    assert (profile.ramp_up_s, profile.ramp_down_s, profile.duration_s) == (2.0, 5.0, 7.0)
    assert [profile.position(t) for t in (0, 1, 2, 3.5, 5, 6, 7)] == [0, 0.5, 2, 5, 8, 9.5, 10]
    assert [profile.velocity(t) for t in (0, 1, 2, 3.5, 5, 6, 7)] == [0, 1, 2, 2, 2, 1, 0]


def test_short_distance_is_a_triangle():
    # By hand: 1 rad at 1 rad/s²: half of it in 1 s, peak 1 rad/s, far below the limit.
    profile = shortest(1.0, 50.0, 1.0, 1.0)
    assert (profile.peak, profile.duration_s) == (1.0, 2.0)
    assert profile.ramp_up_s == profile.ramp_down_s == 1.0


def test_asymmetric_ramps_equal_hand_result():
    # Up at 2, down at 1, limit 2: ramps 1 s and 2 s over 1 and 2, plateau 3 in 1.5 s.
    profile = shortest(-6.0, 2.0, 2.0, 1.0)
    assert (profile.ramp_up_s, profile.ramp_down_s, profile.duration_s) == (1.0, 2.5, 4.5)
    assert [profile.position(t) for t in (1.0, 2.5, 3.5)] == [-1.0, -4.0, -5.5]
    assert profile.velocity(3.5) == -1.0


def test_zero_distance_takes_no_time_or_any_time():
    assert shortest(0.0, 1.0, 1.0, 1.0).duration_s == 0.0
    held = stretched(0.0, 3.0, 1.0, 1.0)
    assert held.duration_s == 3.0
    assert held.position(1.5) == held.velocity(1.5) == 0.0


def test_profile_is_at_rest_before_and_after():
    profile = shortest(-3.0, 1.0, 1.0, 1.0)
    assert profile.position(-1.0) == profile.velocity(-1.0) == 0.0
    assert profile.position(profile.duration_s + 1.0) == -3.0
    assert profile.velocity(profile.duration_s + 1.0) == 0.0


@given(WAY, SIZE, SIZE, SIZE)
def test_profile_covers_its_distance_within_its_limits(way, velocity, up, down):
    profile = shortest(way, velocity, up, down)
    assert profile.peak <= velocity
    assert 0.0 <= profile.ramp_up_s <= profile.ramp_down_s <= profile.duration_s
    # Rounding: a handful of operations on doubles.
    assert integrated_way(profile) == pytest.approx(abs(way), rel=1e-12)
    assert profile.position(profile.duration_s) == way
    step_s = profile.duration_s / 64
    for k in range(64):
        speed, soon = profile.velocity(k * step_s), profile.velocity((k + 1) * step_s)
        change = (abs(soon) - abs(speed)) / step_s if step_s else 0.0
        assert -down * (1 + 1e-9) <= change <= up * (1 + 1e-9)
        assert speed * way >= 0.0


@given(WAY, SIZE, SIZE, SIZE)
def test_no_shorter_profile_is_possible(way, velocity, up, down):
    """Compare with the bound for any motion, from velocity limit and ramps."""
    profile = shortest(way, velocity, up, down)
    if profile.ramp_up_s < profile.ramp_down_s:
        bound_s = abs(way) / velocity + velocity / (2 * up) + velocity / (2 * down)
    else:
        bound_s = sqrt(2 * abs(way) * (1 / up + 1 / down))
    assert profile.duration_s == pytest.approx(bound_s, rel=1e-12)


@given(WAY.filter(bool), SIZE, SIZE, SIZE, st.floats(1.0, 1e4))
def test_stretched_takes_exactly_its_time(way, velocity, up, down, factor):
    fastest = shortest(way, velocity, up, down)
    slow = stretched(way, fastest.duration_s * factor, up, down)
    # The root has a relative rounding error of eps; at factor 1 of sqrt(eps).
    assert slow.duration_s == pytest.approx(fastest.duration_s * factor, rel=1e-7)
    assert integrated_way(slow) == pytest.approx(abs(way), rel=1e-7)
    assert slow.peak <= fastest.peak * (1 + 1e-7)
    assert (slow.acceleration, slow.deceleration) == (up, down)


@given(SIZE, SIZE, st.floats(1.001, 1e6))
def test_symmetric_stretched_equals_the_known_formula(way, ramp, factor):
    # v' = (aT - sqrt(a²T² - 4aD)) / 2, in exact rational arithmetic up to the root.
    time_s = shortest(way, 1e9, ramp, ramp).duration_s * factor
    a, d, t = Fraction(ramp), Fraction(way), Fraction(time_s)
    peak = Fraction(stretched(way, time_s, ramp, ramp).peak)
    residual = peak * peak - a * t * peak + a * d
    assert abs(residual) <= Fraction(1, 10**12) * a * d  # 0 with the exact root
    assert peak <= a * t / 2  # the smaller root


def test_stretched_over_a_long_time_is_exact():
    # 1 rad in 1e9 s: aT - sqrt(a²T² - 4aD) has no digit left; the peak is 1e-9 rad/s.
    assert stretched(1.0, 1e9, 1.0, 1.0).peak == pytest.approx(1e-9, rel=1e-12)


def test_stretched_below_the_minimum_time_raises():
    with pytest.raises(UsageError, match="at least 2 s"):
        stretched(1.0, 1.99, 1.0, 1.0)
    assert stretched(1.0, 2.0, 1.0, 1.0).peak == 1.0


@pytest.mark.parametrize("bad", [0.0, -1.0, inf, nan])
@pytest.mark.parametrize("place", [1, 2, 3])
def test_invalid_limits_raise(bad, place):
    arguments = [1.0, 1.0, 1.0, 1.0]
    arguments[place] = bad
    with pytest.raises(UsageError):
        shortest(*arguments)
    with pytest.raises(UsageError):
        stretched(*arguments)


@pytest.mark.parametrize("bad", [inf, -inf, nan])
def test_invalid_distance_raises(bad):
    with pytest.raises(UsageError):
        shortest(bad, 1.0, 1.0, 1.0)
