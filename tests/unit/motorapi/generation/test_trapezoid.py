import pickle
from fractions import Fraction
from math import inf, nan, nextafter
from random import Random

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.generation import ProfileLimits, possible_durations, shortest, trapezoid
from tests.support.mathematics.problems import (
    assert_is_admissible,
    envelope_of,
    magnitude,
    nearly_direct_problem,
    problems,
    random_problem,
    sizes,
    way_of,
)

UNIT = ProfileLimits(1.0, 1.0)
EPS = Fraction(1, 10**12)


def sampled(profile, count=64):
    return [profile.initial_argument + profile.duration_s * k / count for k in range(count + 1)]


# --- by hand


def test_rest_to_rest_with_limits_by_direction():
    # Up at 2, down at 1, limit 2: ramps 1 s and 2 s over 1 and 2, plateau 3 in 1.5 s.
    profile = trapezoid(6.0, ProfileLimits((-9.0, 2.0), (-1.0, 2.0)))
    assert (profile.duration_s, profile.switching_times_s) == (4.5, (1.0, 2.5))
    assert [profile.value(t) for t in (0, 1, 2.5, 3.5, 4.5)] == [0, 1, 4, 5.5, 6]
    assert [profile.first(t) for t in (0, 0.5, 1, 2, 3.5, 4.5)] == [0, 1, 2, 2, 1, 0]
    assert [profile.second(t) for t in (0, 0.5, 1, 2.5, 4.5)] == [2, 2, 0, -1, -1]


def test_short_distance_between_velocities():
    # From 1 to 0 with 1/s²: the direct ramp covers 0.5 in 1 s.
    profile = trapezoid(0.5, UNIT, initial_velocity=1.0)
    assert profile.pieces == ((0.0, 1.0, 0.0, 0.5, 1.0, 0.0, -1.0),)
    # Distance 0 instead: stop 0.5 beyond, and return by 0.5 in 2 sqrt(0.5) s.
    profile = trapezoid(0.0, UNIT, initial_velocity=1.0)
    assert profile.value(1.0) == 0.5
    assert profile.value_range == (0.0, 0.5)
    assert profile.duration_s == pytest.approx(1.0 + 2.0**0.5, rel=1e-15)


def test_motor_with_gentle_deceleration_reverses_in_2_pieces():
    # Model: acceleration 2, deceleration 1. From -1 m/s: 1 s to stop (-0.5 m), then 1 s to 2 m/s.
    limits = ProfileLimits(2.0, 2.0, 1.0)
    profile = trapezoid(0.5, limits, initial_velocity=-1.0, final_velocity=2.0)
    assert [piece[:2] + piece[6:] for piece in profile.pieces] == [(0, 1, 1), (1, 2, 2)]
    assert [profile.value(t) for t in (0.5, 1.0, 1.5, 2.0)] == [-0.375, -0.5, -0.25, 0.5]


def test_trapezoid_from_rest_to_rest_equals_shortest():
    for distance, velocity, up, down in (
        (10.0, 2.0, 1.0, 1.0),
        (-6.0, 2.0, 2.0, 1.0),
        (1, 9, 2, 3),
    ):
        old = shortest(distance, velocity, up, down)
        new = trapezoid(distance, ProfileLimits(velocity, up, down))
        assert new.duration_s == pytest.approx(old.duration_s, rel=1e-15)
        for t in sampled(new):
            # Two ways to round the same closed form.
            assert new.value(t) == pytest.approx(old.position(t), rel=1e-14, abs=1e-14)
            assert new.first(t) == pytest.approx(old.velocity(t), rel=1e-14, abs=1e-14)


def test_zero_distance_has_the_state_of_the_nearer_end():
    nothing = trapezoid(2.0, UNIT, initial=2.0)
    assert nothing.duration_s == 0.0
    assert (nothing.value(-1), nothing.value(0), nothing.value(1)) == (2.0, 2.0, 2.0)
    profile = trapezoid(5.0, UNIT, initial_velocity=0.5, final_velocity=-0.25, initial_argument=3.0)
    assert (profile.value(2.9), profile.first(2.9), profile.second(2.9)) == (0.0, 0.5, 0.0)
    after = profile.final_argument + 0.1
    assert (profile.value(after), profile.first(after), profile.second(after)) == (5.0, -0.25, 0.0)
    assert pickle.loads(pickle.dumps(profile)) == profile
    assert "from 0.0 to 5.0" in repr(profile)


def test_trapezoid_arrives_to_the_last_digit():
    """Evaluate 1e-9 of the duration before the end, where d (T - t)² / 2 is left."""
    for way, down in ((3.0, 1.0), (-7.0, 0.3), (1e6, 2.0)):
        profile = trapezoid(way, ProfileLimits(2.0, 1.0, down))
        left = profile.duration_s * 1e-9
        t = profile.duration_s - left
        expected = 0.5 * down * (profile.duration_s - t) ** 2
        small = trapezoid(0.0, ProfileLimits(2.0, 1.0, down), initial=-way)
        found = small.value(small.duration_s - left)
        assert abs(found) == pytest.approx(expected, rel=1e-6)
        assert found * way < 0.0


def test_trapezoid_without_acceleration_limit_steps_velocity():
    profile = trapezoid(3.0, ProfileLimits((-1.0, 2.0), inf))
    assert profile.pieces == ((0.0, 1.5, 0.0, 3.0, 2.0, 2.0, 0.0),)
    assert (profile.first(0.0), profile.first(0.1), profile.first(1.5)) == (0.0, 2.0, 0.0)
    up_only = ProfileLimits(2.0, (-inf, 1.0))
    assert trapezoid(1.0, up_only).duration_s == pytest.approx(2.0**0.5, rel=1e-15)


def test_trapezoid_without_velocity_limit_is_a_triangle():
    assert trapezoid(1e6, ProfileLimits(inf, 1.0)).duration_s == 2000.0


# --- invalid requests


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize(
    "name", ["final", "initial", "initial_velocity", "final_velocity", "initial_argument"]
)
def test_trapezoid_with_non_finite_number_raises(name, bad):
    arguments = {"final": 1.0, name: bad}
    with pytest.raises(UsageError, match="not a finite number"):
        trapezoid(limits=ProfileLimits(inf, 1.0), **arguments)


def test_trapezoid_beyond_the_limits_raises():
    with pytest.raises(UsageError, match=r"final velocity 1\.5 lies outside its limits, -1 to 1"):
        trapezoid(1.0, UNIT, final_velocity=1.5)
    with pytest.raises(UsageError, match="allow no motion in this direction"):
        trapezoid(1.0, ProfileLimits((-1.0, 0.0), 1.0))
    with pytest.raises(UsageError, match="neither velocity nor acceleration is limited"):
        trapezoid(1.0, ProfileLimits(inf, inf))


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((0.0, 1.0), "velocity range"),
        (((1.0, 2.0), 1.0), "velocity range"),
        ((nan, 1.0), "velocity range"),
        ((1.0, 0.0), "acceleration range"),
        ((1.0, 1.0, 0.0), "deceleration"),
        ((1.0, (0.0, 1.0)), "acceleration range"),
        ((1.0, nan), "acceleration range"),
        ((1.0, (-1.0, 1.0), 1.0), "not as a range"),
    ],
)
def test_invalid_profile_limits_raise(arguments, told):
    with pytest.raises(UsageError, match=told):
        ProfileLimits(*arguments)
    with pytest.raises(UsageError, match="the value"):
        ProfileLimits(1.0, 1.0, value=(1.0, 0.0))


# --- properties


@given(problems())
def test_every_profile_is_admissible(problem):
    final, limits, states = problem
    assert_is_admissible(trapezoid(final, limits, **states), final, limits, states)


@given(problems(9.0))
def test_every_profile_is_admissible_at_any_scale(problem):
    final, limits, states = problem
    assert_is_admissible(trapezoid(final, limits, **states), final, limits, states)


@given(problems(), st.floats(0.0, 1.0))
def test_limits_are_never_exceeded(problem, share):
    final, limits, states = problem
    profile = trapezoid(final, limits, **states)
    low, high = profile.value_range
    times = [*sampled(profile, 16), share * profile.duration_s]
    for t in profile.switching_times_s:
        times += [nextafter(t, -inf), t, nextafter(t, inf)]
    for t in times:
        velocity, acceleration = profile.first(t), profile.second(t)
        assert limits.velocity[0] <= velocity <= limits.velocity[1]
        allowed = limits.forward if velocity > 0.0 else limits.backward
        if velocity == 0.0:  # it may just reverse
            ends = (*limits.forward, *limits.backward)
            allowed = (min(ends), max(ends))
        assert allowed[0] <= acceleration <= allowed[1]
        assert low <= profile.value(t) <= high


@given(problems() | problems(9.0), st.randoms(use_true_random=False))
def test_no_shorter_profile_is_possible(problem, random):
    """Compare with the envelope of all motions, in exact arithmetic."""
    final, limits, states = problem
    profile = trapezoid(final, limits, **states)
    envelope, way = envelope_of(limits, states), way_of(final, states)
    duration = Fraction(profile.duration_s)
    event(f"{len(profile.pieces)} pieces")
    for share in (EPS, *(Fraction(random.uniform(1e-9, 1.0)) for _ in range(4))):
        assert not duration or not envelope.is_possible(way, duration * (1 - share))


def test_distance_near_that_of_the_direct_ramp_is_exact():
    random = Random("motorhil:nearly direct")
    for _ in range(300):
        final, limits, states = nearly_direct_problem(random)
        profile = trapezoid(final, limits, **states)
        envelope, way = envelope_of(limits, states), way_of(final, states)
        duration = Fraction(profile.duration_s)
        assert not envelope.is_possible(way, duration * (1 - EPS))
        (low, high), *_ = possible_durations(final, limits, **states)
        if low * (1 + 1e-11) < high:  # else there is no later time to choose
            assert envelope.is_possible(way, duration * (1 + EPS))


@given(problems())
def test_no_profile_has_a_smaller_extent(problem):
    """Compare the extent with braking and arrival distances, and both ends."""
    final, limits, states = problem
    profile = trapezoid(final, limits, **states)
    begin, end = Fraction(states["initial_velocity"]), Fraction(states["final_velocity"])
    initial, target = Fraction(states["initial"]), Fraction(final)
    needed = [initial, target]
    if begin:
        needed.append(initial - begin**2 / 2 / Fraction(_braking(limits, begin)))
    if end:
        needed.append(target - end**2 / 2 / Fraction(_arriving(limits, end)))
    low, high = profile.value_range
    slack = Fraction(1e-13) * max(map(abs, needed))
    assert Fraction(high) <= max(needed) + slack
    assert Fraction(low) >= min(needed) - slack


def _braking(limits, velocity):
    return limits.forward[0] if velocity > 0 else limits.backward[1]


def _arriving(limits, velocity):
    return limits.forward[1] if velocity > 0 else limits.backward[0]


@given(problems())
def test_mirrored_problem_changes_signs_only(problem):
    final, limits, states = problem
    mirrored = ProfileLimits((-limits.velocity[1], -limits.velocity[0]), 1.0)
    for name, (low, high) in (("forward", limits.backward), ("backward", limits.forward)):
        object.__setattr__(mirrored, name, (-high, -low))
    one = trapezoid(final, limits, **states)
    other = trapezoid(-final, mirrored, **{name: -number for name, number in states.items()})
    assert other.duration_s == one.duration_s
    assert [tuple(-x for x in piece[2:]) for piece in other.pieces] == [p[2:] for p in one.pieces]


@given(sizes(3.0), sizes(3.0), sizes(3.0))
def test_direct_ramp_with_rounded_numbers_stays_direct(begin, end, size):
    """Accelerate backward: an excess in the last digit must not cause a reversal."""
    begin, end = sorted((begin, end))
    way = -(end * end - begin * begin) / (2.0 * size)
    limits = ProfileLimits(2.0 * end, size)
    profile = trapezoid(way, limits, initial_velocity=-begin, final_velocity=-end)
    # Rounding of the distance, expressed as a time.
    assert (
        profile.duration_s <= (end - begin) / size * (1 + 1e-12) + 4e-15 * end * end / size / begin
    )


# --- ruckig


def by_ruckig(ruckig, final, limits, states):
    """Return the trajectory, or None if ruckig fails."""
    given = ruckig.InputParameter(1)
    given.current_position, given.target_position = [states["initial"]], [final]
    given.current_velocity = [states["initial_velocity"]]
    given.target_velocity = [states["final_velocity"]]
    given.min_velocity, given.max_velocity = [limits.velocity[0]], [limits.velocity[1]]
    given.min_acceleration, given.max_acceleration = [limits.forward[0]], [limits.forward[1]]
    made = ruckig.Trajectory(1)
    try:
        result = ruckig.Ruckig(1).calculate(given, made)
    except ruckig.RuckigError:
        return None
    return made if result == ruckig.Result.Working else None


def test_trapezoid_equals_ruckig_12_000_times():
    import ruckig

    random = Random("motorhil:trapezoids")
    moving = 0
    for _ in range(12_000):
        final, limits, states = random_problem(random, 1.0)
        ours = trapezoid(final, limits, **states)
        theirs = by_ruckig(ruckig, final, limits, states)
        moving += bool(states["initial_velocity"] or states["final_velocity"])
        assert abs(ours.duration_s - theirs.duration) <= 1e-12 * theirs.duration
        way = max(abs(final), abs(states["initial"]), *map(abs, ours.value_range))
        speed = max(-limits.velocity[0], limits.velocity[1])
        for share in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0):
            t = theirs.duration * share
            (position,), (velocity,), _ = theirs.at_time(t)
            assert abs(ours.value(t) - position) <= 1e-9 * way
            assert abs(ours.first(t) - velocity) <= 1e-9 * speed
            assert limits.velocity[0] <= ours.first(t) <= limits.velocity[1]
            assert limits.forward[0] <= ours.second(t) <= limits.forward[1]
    assert moving > 8_000  # otherwise boundary velocities would not be covered


def test_trapezoid_is_right_where_ruckig_differs():
    """Compare over six decades, where ruckig fails on some and errs by up to 1e-11 on a few."""
    import ruckig

    random = Random("motorhil:six decades")
    given_up, different = 0, 0
    for _ in range(4_000):
        final, limits, states = random_problem(random, 3.0)
        ours = trapezoid(final, limits, **states)
        theirs = by_ruckig(ruckig, final, limits, states)
        if theirs is None:
            given_up += 1
        elif abs(ours.duration_s - theirs.duration) > 1e-12 * theirs.duration:
            different += 1
        else:
            continue
        envelope, way = envelope_of(limits, states), way_of(final, states)
        duration = Fraction(ours.duration_s)
        assert envelope.is_possible(way, duration * (1 + EPS))
        assert not envelope.is_possible(way, duration * (1 - EPS))
        if theirs is not None:
            told = Fraction(theirs.duration)
            nearly = envelope.is_possible(way, told * (1 + EPS))
            assert not nearly or envelope.is_possible(way, told * (1 - EPS))
    assert given_up > 0
    assert different < 40


def test_problems_of_any_magnitude_are_solved():
    random = Random("motorhil:magnitudes")
    assert min(magnitude(random, 9.0) for _ in range(200)) < 1e-6
