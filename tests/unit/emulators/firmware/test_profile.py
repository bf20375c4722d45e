"""The profile generator against closed forms of the trapezoid and its own limits."""

import math
from itertools import pairwise

import pytest
from hypothesis import assume, event, example, given
from hypothesis import strategies as st

from motorhil.emulators.firmware import profile
from motorhil.emulators.firmware.profile import FOREVER

# Increments, increments per tick, increments per tick^2: from a crawl to far beyond any motor.
DISTANCES = st.integers(-(2**32), 2**32) | st.integers(-2000, 2000)
SPEEDS = st.floats(1e-3, 1e5)
ACCELERATIONS = st.floats(1e-6, 1e4)

# Rounding of a few operations on numbers of up to 2^33.
RELATIVE = 1e-9


def closed_form_ticks(distance: float, v: float, a: float, d: float) -> float:
    """Return the rest-to-rest time. Source: Biagiotti & Melchiorri (2008), ch. 3, two ramps."""
    size = abs(distance)
    if size >= v * v / 2 * (1 / a + 1 / d):
        return size / v + v / 2 * (1 / a + 1 / d)
    return math.sqrt(2 * size * (1 / a + 1 / d))


def instants(pieces):
    """Return times around every change, and between."""
    times = [0.0]
    for end, start, *_ in pieces:
        stop = start + 3.0 if end == FOREVER else end
        times += [start, start + (stop - start) * 0.3, stop - (stop - start) * 1e-6, stop]
    return sorted(times)


def within(value: float, limit: float) -> bool:
    return abs(value) <= limit * (1 + RELATIVE)


@given(DISTANCES, SPEEDS, ACCELERATIONS, ACCELERATIONS)
@example(0, 1.0, 1.0, 1.0)
@example(1, 1e5, 1e4, 1e-6)
@example(113, 10.0, 1.0, 0.8)  # half an increment of cruise
@example(-(2**32), 1e-3, 1e-6, 1e4)
def test_move_duration_matches_closed_form(distance, v, a, d):
    pieces = profile.move(1000.0, 0.0, 1000.0 + distance, v, a, d)
    expected = closed_form_ticks(distance, v, a, d)
    event("none" if distance == 0 else "triangle" if len(pieces) == 3 else "trapezoid")
    assert profile.duration_ticks(pieces) == pytest.approx(expected, rel=RELATIVE, abs=1e-6)


@given(DISTANCES, SPEEDS, ACCELERATIONS, ACCELERATIONS)
def test_move_stays_within_limits_ends_on_target(distance, v, a, d):
    target = float(distance)
    pieces = profile.move(0.0, 0.0, target, v, a, d)
    check_limits(pieces, v, a, d)
    assert profile.demand_at(pieces, profile.duration_ticks(pieces)) == (target, 0.0)
    assert profile.demand_at(pieces, profile.duration_ticks(pieces) + 1e6) == (target, 0.0)
    for t in instants(pieces):
        position, _ = profile.demand_at(pieces, t)
        slack = RELATIVE * (1 + abs(distance))
        assert min(0.0, target) - slack <= position <= max(0.0, target) + slack


def check_limits(pieces, v, a, d):
    """Check: speed <= v, a while |speed| grows, d while it shrinks; nothing jumps."""
    pieces = [piece for piece in pieces if piece[0] > piece[1]]
    for end, start, _, slope, half, velocity, change in pieces:
        assert (slope, 2 * half) == (velocity, change)
        last = velocity + (end - start) * change if end != FOREVER else velocity
        about_0 = 1e-6 * v + 4e-16 * end * abs(change)  # a time is a float, too
        assert within(velocity, v)
        assert within(last, v) or abs(last) <= about_0
        assert velocity * last >= 0.0 or abs(last) <= about_0
        assert within(change, a if velocity * change >= 0.0 else d)
    for was, (_, start, position, _, _, velocity, _) in pairwise(pieces):
        s = start - was[1]
        late = 4e-16 * start
        there = was[2] + s * (was[3] + s * was[4])
        assert there == pytest.approx(position, rel=RELATIVE, abs=1e-5 + late * v)
        slack = 1e-6 * v + 1e-9 + late * max(a, d)
        assert was[5] + s * was[6] == pytest.approx(velocity, rel=RELATIVE, abs=slack)


@given(
    st.floats(-1e6, 1e6),
    st.floats(-1e4, 1e4),
    st.integers(-(10**7), 10**7),
    st.floats(1e-2, 1e4),
    st.floats(1e-3, 1e3),
    st.floats(1e-3, 1e3),
)
@example(0.0, 100.0, 100, 50.0, 1.0, 1.0)  # too fast, and too close to stop
@example(0.0, -100.0, 100, 50.0, 1.0, 1.0)  # the wrong direction
@example(0.0, 100.0, 5000, 100.0, 1.0, 1.0)  # just enough room to stop
def test_move_from_any_motion_reaches_target(position, velocity, target, v, a, d):
    pieces = profile.move(position, velocity, float(target), v, a, d)
    assert profile.demand_at(pieces, 0.0) == pytest.approx((position, velocity), abs=1e-4)
    check_limits(pieces, max(v, abs(velocity)), a, d)
    assert profile.demand_at(pieces, profile.duration_ticks(pieces)) == (float(target), 0.0)
    # Once within the limit it stays there, and it never accelerates beyond it.
    for _, start, _, slope, *_ in pieces:
        assert start == 0.0 or within(slope, v)
    if velocity != 0.0:
        stop = position + velocity * abs(velocity) / (2 * d)
        away = velocity * (target - position) < 0
        over = not away and (target - stop) * velocity < 0
        fast = not away and not over and abs(velocity) > v
        event("away" if away else "overshoots" if over else "too fast" if fast else "on its way")
        if away or over:
            rest = closed_form_ticks(target - stop, v, a, d)
            expected = abs(velocity) / d + rest
            assert profile.duration_ticks(pieces) == pytest.approx(expected, rel=1e-6, abs=1e-3)


@given(
    st.integers(-(10**6), 10**6),
    SPEEDS,
    st.floats(1e-4, 1e3),
    st.floats(1e-4, 1e3),
    st.floats(0.0, 1.0),
)
def test_same_command_repeated_changes_nothing(distance, v, a, d, share):
    """The rest of a shortest motion is itself the shortest one."""
    assume(distance != 0)
    pieces = profile.move(0.0, 0.0, float(distance), v, a, d)
    whole = profile.duration_ticks(pieces)
    position, velocity = profile.demand_at(pieces, share * whole)
    rest = profile.duration_ticks(profile.move(position, velocity, float(distance), v, a, d))
    # sqrt amplifies rounding near the end: 1e-12 of the distance is 1e-6 of the time
    assert rest == pytest.approx((1 - share) * whole, rel=1e-5, abs=1e-4 * whole + 1e-3)


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(1e-3, 1e2), st.floats(1e-3, 1e2))
def test_ramp_duration_matches_its_slopes(velocity, wanted, a, d):
    pieces = profile.ramp(0.0, velocity, wanted, a, d)
    if velocity * wanted < 0.0:
        expected = abs(velocity) / d + abs(wanted) / a
    elif abs(wanted) > abs(velocity):
        expected = abs(wanted - velocity) / a
    else:
        expected = abs(wanted - velocity) / d
    assert profile.duration_ticks(pieces) == pytest.approx(expected, rel=RELATIVE, abs=1e-9)
    assert profile.demand_at(pieces, profile.duration_ticks(pieces) + 7.0)[1] == wanted
    assert profile.demand_at(pieces, 0.0)[1] == pytest.approx(velocity, abs=1e-12)
    if wanted != 0.0:
        check_limits(pieces, max(abs(velocity), abs(wanted)), a, d)


@given(st.floats(-1e6, 1e6), st.floats(-1e4, 1e4), st.floats(1e-3, 1e3))
def test_ramp_to_rest_ends_on_nearest_increment(position, velocity, d):
    pieces = profile.ramp(position, velocity, 0.0, d, d)
    end, speed = profile.demand_at(pieces, profile.duration_ticks(pieces))
    braking = position + velocity * abs(velocity) / (2 * d)
    assert speed == 0.0
    assert end == end // 1.0
    assert abs(end - braking) <= 0.5 + 1e-6


def test_line_is_linear_and_keeps_velocity_one_tick():
    pieces = profile.line(100.0, 140.0, 4.0)
    assert [profile.demand_at(pieces, t) for t in (0.0, 1.0, 3.0, 4.0, 4.5, 5.0, 99.0)] == [
        (100.0, 10.0),
        (110.0, 10.0),
        (130.0, 10.0),
        (140.0, 10.0),
        (140.0, 10.0),
        (140.0, 0.0),
        (140.0, 0.0),
    ]


def test_line_zero_ticks_takes_one_tick():
    assert profile.demand_at(profile.line(0.0, 8.0, 0.0), 1.0) == (8.0, 8.0)


@given(DISTANCES, st.floats(-1e3, 1e3), SPEEDS, ACCELERATIONS, ACCELERATIONS, SPEEDS)
@example(100, 0.0, 10.0, 1.0, 1.0, 10.0)
@example(1, 50.0, 60.0, 1.0, 1.0, 1.0)  # too fast for the distance
@example(1, 0.0, 60.0, 1.0, 1.0, 50.0)  # too slow for it
def test_move_through_passes_target_at_end_velocity(distance, v0, v, a, d, end):
    target = float(distance)
    pieces = profile.move_through(0.0, v0, target, v, a, d, end)
    forward = 1.0 if distance >= 0 else -1.0
    last = min(end, v)
    kept, speed = profile.demand_at(pieces, profile.duration_ticks(pieces))
    assert speed == forward * last
    largest = max(1.0, abs(target), *(abs(piece[2]) for piece in pieces))
    entry = max(v0 * forward, 0.0)
    change = entry * entry - last * last
    enough = -2 * a * abs(target) < change * (1 + RELATIVE) < 2 * d * abs(target)
    if v0 * forward >= 0 and enough and entry <= v:
        event("passed at the end velocity")
        assert kept == pytest.approx(target, abs=1e-6 * largest)
    for before, after in pairwise(pieces):
        assert before[0] == after[1]
        for k in (0, 1):  # no step in position or velocity
            left = profile.demand_at((before, *pieces[-1:]), before[0] * (1 - 1e-15))[k]
            late = 1e-12 * before[0] * (max(a, d) + max(v, abs(v0)))  # of rounded times
            assert profile.demand_at(pieces, after[1])[k] == pytest.approx(
                left, abs=1e-6 * largest + late
            )
    for *_, start_speed, change in pieces:
        assert within(abs(start_speed), max(v, abs(v0)))
        assert change == 0.0 or abs(change) in (a, d)
