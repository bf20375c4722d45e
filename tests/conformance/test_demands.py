"""The demands that clauses expect, against results by hand and another generator."""

from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.harness.conformance.clauses.demands import (
    least_s,
    ramp_s,
    ramped,
    shortest,
    slowed,
    trapezoid,
    when_s,
)
from motorhil.motorapi.generation import ProfileLimits, jerk_limited

SIZE = st.floats(0.01, 100.0)


def test_trapezoid_equals_hand_result():
    # 10 rad at 2 rad/s and 1 rad/s²: ramps of 2 s over 2 rad each, plateau 6 rad in 3 s.
    assert least_s(10.0, 2.0, 1.0, 1.0) == 7.0
    for demand in (shortest(10.0, 2.0, 1.0, 1.0), trapezoid(10.0, 7.0, 1.0, 1.0)):
        assert [demand(t) for t in (-1, 0, 1, 2, 3.5, 5, 6, 7, 8)] == [
            *(0, 0, 0.5, 2, 5, 8, 9.5, 10, 10)
        ]


def test_double_s_equals_hand_result():
    # Jerk 6 rad/s³, 1 s up, 2 s down, 1 s up: 1 rad after 1 s, at 3 rad/s; then 5 rad more.
    demand = shortest(-12.0, 50.0, 50.0, 50.0, 6.0)
    places = [demand(t) for t in (0, 1, 2, 3, 4)]
    assert places == pytest.approx([0, -1, -6, -11, -12], abs=1e-12)
    assert when_s(shortest(12.0, 50.0, 50.0, 50.0, 6.0), 1.0, 4.0) == pytest.approx(1.0, rel=1e-9)


@given(SIZE, SIZE, SIZE, SIZE, SIZE)
def test_double_s_agrees_with_another_generator(way, velocity, up, down, jerk):
    function = jerk_limited(way, ProfileLimits(velocity, up, down), jerk)
    duration_s = function.domain[1]
    assert least_s(way, velocity, up, down, jerk) == pytest.approx(duration_s, rel=1e-9)
    demand = shortest(way, velocity, up, down, jerk)
    for part in range(17):
        at_s = duration_s * part / 16
        assert demand(at_s) == pytest.approx(function.value(at_s), abs=1e-8 * way)


@given(SIZE, SIZE, SIZE, SIZE, st.floats(1.01, 10.0))
def test_move_with_limited_jerk_takes_its_duration(way, up, down, jerk, share):
    duration_s = share * least_s(way, 1e9, up, down, jerk)
    demand = trapezoid(way, duration_s, up, down, jerk)
    assert demand(duration_s) == pytest.approx(way, rel=1e-9)
    assert demand(0.999 * duration_s) < way


@given(SIZE, SIZE, st.one_of(SIZE, st.just(inf)), st.floats(1.0, 10.0))
def test_ramp_of_velocity_reaches_it_in_its_time(change, rate, jerk, share):
    duration_s = share * ramp_s(change, rate, jerk)
    demand = ramped(-change, duration_s, rate, jerk)
    assert demand(duration_s) == pytest.approx(-0.5 * change * duration_s, rel=1e-9)  # symmetrical
    assert demand(duration_s + 1.0) - demand(duration_s) == pytest.approx(-change, rel=1e-9)
    half = [demand(0.5 * duration_s + late) for late in (-0.01 * duration_s, 0.01 * duration_s)]
    assert half[1] - half[0] == pytest.approx(-0.5 * change * 0.02 * duration_s, rel=1e-6)


def test_slowed_demand_is_at_the_same_places_later():
    demand = shortest(12.0, 50.0, 50.0, 50.0, 6.0)
    assert [slowed(demand, 0.5)(2.0 * t) for t in (0, 1, 2, 3, 4)] == [demand(t) for t in range(5)]
