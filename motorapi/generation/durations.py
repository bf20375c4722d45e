"""Possible durations of a motion, and the profile of a given duration.

At a given duration T, with every ramp as steep as the limits allow, the distance grows with the
peak u:

    d(distance) / du = T - (time for both ramps) = duration of the plateau >= 0

So each distance that is possible in T has one peak, and no motion of another shape reaches a
distance that these do not. Let c = T - (time of the direct ramp), and G the excess caused by a peak
(the terms are those of `motorapi.generation.closed_form`):

    between the boundary velocities   G = u c
    above or below                    G is a quadratic polynomial of u on each side of 0

One of the two is solved. The formulas avoid cancellation for long T.

If both boundary velocities are forward, and the distance is too short for a stop, the motion can be
slow only as long as it need not stop: until Ta. For a longer duration it must stop beyond the
target, move back and return, which is impossible before Tb. No motion has a duration between Ta and
Tb.
"""

from math import inf, isfinite, sqrt

from motorapi.commands import Range
from motorapi.errors import UsageError
from motorapi.generation.closed_form import Task, assembled, peak_of, task_of
from motorapi.generation.limits import ProfileLimits
from motorapi.generation.profile import Piece
from motorapi.limits import ROUNDING


def possible_durations(
    final: float,
    limits: ProfileLimits,
    *,
    initial: float = 0.0,
    initial_velocity: float = 0.0,
    final_velocity: float = 0.0,
) -> tuple[Range, ...]:
    """Return the possible durations of a motion between these states, one or two ranges [s].

    There are two if both boundary velocities point along a distance too short for a stop. The last
    range ends at inf, unless the limits forbid backward motion.

    Raises:
        UsageError: as for `trapezoid`.
    """
    return _possible(task_of(final, limits, initial, initial_velocity, final_velocity))


def pieces_lasting(
    task: Task, duration_s: float, initial: float, final: float
) -> tuple[Piece, ...]:
    """Return the pieces of the motion of this duration; see `assembled` for the arguments.

    Raises:
        UsageError: the duration is not finite and >= 0, or not possible.
    """
    if not (isfinite(duration_s) and duration_s >= 0.0):
        raise UsageError(f"the duration is {duration_s} s, not a finite number >= 0")
    duration_s = _allowed(task, duration_s)
    if duration_s <= _shortest_s(task):
        return assembled(task, *peak_of(task), initial, final)
    _, _, begin, end, low, high, *_ = task
    peak = min(max(_peak(task, duration_s - _ramp_s(task, begin, end)), low), high)
    hold_s = duration_s - _ramp_s(task, begin, peak) - _ramp_s(task, peak, end)
    pieces = assembled(task, peak, peak - begin, peak - end, max(hold_s, 0.0), initial, final)
    return (*pieces[:-1], (pieces[-1][0], duration_s, *pieces[-1][2:]))


def _peak(task: Task, spare_s: float) -> float:
    """Return the peak with which the motion takes `spare_s` longer than the direct ramp."""
    _, excess, begin, end, _, _, rise, fall, back_rise, back_fall = task
    least, most = (begin, end) if begin < end else (end, begin)
    k = 1.0 / rise + 1.0 / fall
    k_back = 1.0 / back_rise + 1.0 / back_fall
    if excess > most * spare_s:
        if most >= 0.0:
            return most + _root(excess - most * spare_s, spare_s, -k)
        return _root(excess + 0.5 * k_back * most * most, spare_s + k_back * most, -k)
    if excess >= least * spare_s:
        return excess / spare_s
    stop = 0.5 * k * least * least  # the excess with a peak of 0
    rest_s = spare_s - k * least  # the duration of that standstill
    if rest_s < 0.0:
        return least - _root(least * spare_s - excess, spare_s, -k)
    if excess >= stop:
        return _root(excess - stop, rest_s, k)
    return -_root(stop - excess, rest_s, -k_back)


def _root(rest: float, slope: float, bend: float) -> float:
    """Return the smallest x >= 0 with slope x + bend x² / 2 = rest, for rest >= 0."""
    if rest <= 0.0:
        return 0.0
    square = slope * slope + 2.0 * bend * rest
    return 2.0 * rest / (slope + sqrt(max(square, 0.0)))


def _possible(task: Task) -> tuple[Range, ...]:
    _, excess, begin, end, low, _, rise, fall, back_rise, back_fall = task
    direct_s, shortest_s = _ramp_s(task, begin, end), _shortest_s(task)
    least = min(begin, end)
    k = 1.0 / rise + 1.0 / fall
    missing = 0.5 * k * least * least - excess  # distance missing for a stop
    if least <= 0.0 or missing <= 0.0:
        return ((shortest_s, inf),)
    slowest = sqrt(max(least * least - 2.0 * excess / k, 0.0))
    first_s = max(shortest_s, direct_s + 2.0 * excess / (least + slowest))
    k_back = 1.0 / back_rise + 1.0 / back_fall
    back = sqrt(2.0 * missing / k_back) if k_back else inf
    if back <= -low and back < inf:
        return ((shortest_s, first_s), (direct_s + k * least + k_back * back, inf))
    if low == 0.0:
        return ((shortest_s, first_s),)
    back_s = (missing - 0.5 * k_back * low * low) / -low if low > -inf else 0.0
    ramps_s = k_back * -low if k_back else 0.0
    return ((shortest_s, first_s), (direct_s + k * least + ramps_s + back_s, inf))


def _allowed(task: Task, duration_s: float) -> float:
    """Return the duration, or the possible one within rounding of it."""
    ranges = _possible(task)
    for low, high in ranges:
        if low <= duration_s <= high:
            return duration_s
        for end in (low, high):
            if abs(duration_s - end) <= ROUNDING * end < inf:
                return end
    told = " or ".join(
        f"at least {low:g} s" if high == inf else f"from {low:g} to {high:g} s"
        for low, high in ranges
    )
    why = "the limits do not allow a shorter one"
    if duration_s > ranges[0][0]:
        why = "in between the motion would have to stop, and the distance is too short for that"
    raise UsageError(f"this motion cannot take {duration_s:g} s, only {told}: {why}")


def _shortest_s(task: Task) -> float:
    _, excess, _, _, _, high, rise, fall, _, _ = task
    if excess > 0.0 and high == rise == fall == inf:
        return 0.0  # all longer durations are possible
    return assembled(task, *peak_of(task), 0.0, 0.0)[-1][1]


def _ramp_s(task: Task, begin: float, end: float) -> float:
    """Return the duration of a ramp [s]."""
    _, _, _, _, _, _, rise, fall, back_rise, back_fall = task
    forward, backward = (rise, back_rise) if end > begin else (fall, back_fall)
    return (
        abs(max(end, 0.0) - max(begin, 0.0)) / forward
        + abs(min(end, 0.0) - min(begin, 0.0)) / backward
    )
