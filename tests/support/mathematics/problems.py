"""Random problems of two states and limits, of every magnitude."""

from fractions import Fraction
from itertools import pairwise

from hypothesis import strategies as st

from motorhil.motorapi.generation import ProfileLimits
from tests.support.mathematics.envelope import Envelope


def magnitude(random, decades):
    return 10.0 ** random.uniform(-decades, decades)


def random_problem(random, decades):
    """Return (final, limits, keywords), with velocity and acceleration ranges as in ruckig."""
    low, high = -magnitude(random, decades), magnitude(random, decades)
    limits = ProfileLimits((low, high), (-magnitude(random, decades), magnitude(random, decades)))
    begin, end = (
        random.choice([0.0, random.uniform(low, high)]),
        random.choice([0.0, random.uniform(low, high)]),
    )
    initial = random.uniform(-10.0, 10.0)
    final = initial + random.choice([-1, 1]) * magnitude(random, decades)
    return final, limits, {"initial": initial, "initial_velocity": begin, "final_velocity": end}


def sizes(decades):
    return st.floats(-decades, decades).map(lambda power: 10.0**power)


@st.composite
def problems(draw, decades=3.0):
    """Return problems as `random_problem`, with limits by direction, and values at the limits."""
    size = sizes(decades)
    low, high = -draw(size), draw(size)
    kind = draw(st.sampled_from(["range", "model", "directions"]))
    if kind == "range":
        limits = ProfileLimits((low, high), (-draw(size), draw(size)))
    elif kind == "model":
        limits = ProfileLimits((low, high), draw(size), draw(size))
    else:
        forward, backward = (-draw(size), draw(size)), (-draw(size), draw(size))
        limits = ProfileLimits.by_direction((low, high), forward, backward)
    # Squares of velocities below 1e-150 vanish.
    some = st.floats(low, high).filter(lambda number: number == 0.0 or abs(number) > 1e-60)
    velocity = st.sampled_from([0.0, low, high]) | some
    begin, end = draw(velocity), draw(velocity)
    initial = draw(st.just(0.0) | st.floats(-10.0, 10.0))
    final = initial + draw(st.sampled_from([1.0, -1.0, 0.0])) * draw(size)
    return final, limits, {"initial": initial, "initial_velocity": begin, "final_velocity": end}


def directions_problem(random, decades):
    """Return a problem as `random_problem`, with four independent accelerations."""
    final, limits, states = random_problem(random, decades)
    backward = (-magnitude(random, decades), magnitude(random, decades))
    return final, ProfileLimits.by_direction(limits.velocity, limits.forward, backward), states


def nearly_direct_problem(random):
    """Return a distance nearly equal to that of the direct ramp, where the last digit counts."""
    begin = -magnitude(random, 2.0)
    end = random.choice([0.0, 0.0, 1e-6, 0.9]) * begin * random.random()
    size = magnitude(random, 2.0)
    direct = Fraction(end) ** 2 / 2 / Fraction(size) - Fraction(begin) ** 2 / 2 / Fraction(size)
    off = Fraction(random.choice([-1, 1]) * 10.0 ** -random.uniform(2.0, 13.0))
    limits = ProfileLimits(2.0 * abs(begin), (-magnitude(random, 2.0), size))
    states = {"initial": 0.0, "initial_velocity": begin, "final_velocity": end}
    return float(direct * (1 + off)), limits, states


def way_of(final, given):
    return Fraction(final) - Fraction(given["initial"])


def envelope_of(limits, given):
    return Envelope(
        given["initial_velocity"],
        given["final_velocity"],
        limits.velocity,
        limits.forward,
        limits.backward,
    )


def assert_is_admissible(profile, final, limits, given):
    """Check that the pieces form a motion between these states within these limits."""
    pieces = profile.pieces
    assert pieces[0][0] == 0.0
    assert (profile.initial, profile.final) == (given["initial"], final)
    assert pieces[0][4] == profile.initial_velocity == given["initial_velocity"]
    assert pieces[-1][5] == profile.final_velocity == given["final_velocity"]
    for before, after in pairwise(pieces):
        assert before[1] == after[0]
        assert before[3] == after[2]
        assert before[5] == after[4]
    longest = Fraction(0)
    low, high = limits.velocity
    for begins, ends, value, target, entry, leave, acceleration in pieces:
        lasts, mean = Fraction(ends) - Fraction(begins), (Fraction(entry) + Fraction(leave)) / 2
        assert ends >= begins
        assert low <= min(entry, leave) <= max(entry, leave) <= high
        assert entry * leave >= 0.0
        allowed = limits.forward if max(entry, leave) > 0.0 else limits.backward
        assert acceleration == 0.0 or acceleration in allowed
        # Rounding: of times and velocities, each to 2^-53 of the largest.
        slack = Fraction(1e-14) * max(abs(Fraction(acceleration)) * Fraction(pieces[-1][1]), 0)
        slack += Fraction(1e-14) * (abs(Fraction(entry)) + abs(Fraction(leave)))
        assert abs(Fraction(acceleration) * lasts - (Fraction(leave) - Fraction(entry))) <= slack
        longest = max(longest, abs(Fraction(value)), abs(Fraction(target)))
        slack = abs(mean) * Fraction(1e-14) * Fraction(pieces[-1][1]) + Fraction(1e-14) * longest
        assert abs(mean * lasts - (Fraction(target) - Fraction(value))) <= slack
