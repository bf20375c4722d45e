"""Which durations a motion can have, and the profile that has one of them.

At a given duration T, with every ramp as steep as the limits allow, the way grows with the peak u:

    d(way) / du = T - (time for both ramps) = how long the peak is held >= 0

so there is one peak for every way that can be made in T at all, and no motion of another shape
covers a way that none of these does. Counted from c = T - (time of the direct ramp), with G the
excess that a peak makes (the words are those of `motorapi.generation.closed_form`):

    between the boundary velocities   G = u c
    above or below                    G is a square polynomial of u on each side of 0

which is solved on the one side or the other. Forms are chosen that do not cancel for long T.

A motion whose boundary velocities are both forward, and whose way is too short to stop on, can
dawdle only as long as it need not stop: until Ta. Later than that it has to stop beyond, run back
and come again, which it cannot before Tb. Between Ta and Tb there is no such motion.
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
    """The durations that a motion between these states can have: one or two ranges [s].

    Two, if both boundary velocities point along a way that is too short to stop on; the last one
    ends at inf, unless the limits allow no running back.

    Raises:
        UsageError: as for `trapezoid`.
    """
    return _possible(task_of(final, limits, initial, initial_velocity, final_velocity))


def pieces_lasting(
    task: Task, duration_s: float, initial: float, final: float
) -> tuple[Piece, ...]:
    """The pieces of the motion that takes this long; see `assembled` for the arguments.

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
    """The peak with which the motion takes `spare_s` longer than the direct ramp."""
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
    rest_s = spare_s - k * least  # how long it is held then
    if rest_s < 0.0:
        return least - _root(least * spare_s - excess, spare_s, -k)
    if excess >= stop:
        return _root(excess - stop, rest_s, k)
    return -_root(stop - excess, rest_s, -k_back)


def _root(rest: float, slope: float, bend: float) -> float:
    """The x >= 0 nearest to 0 for which slope x + bend x² / 2 = rest, for rest >= 0."""
    if rest <= 0.0:
        return 0.0
    square = slope * slope + 2.0 * bend * rest
    return 2.0 * rest / (slope + sqrt(max(square, 0.0)))


def _possible(task: Task) -> tuple[Range, ...]:
    _, excess, begin, end, low, _, rise, fall, back_rise, back_fall = task
    direct_s, shortest_s = _ramp_s(task, begin, end), _shortest_s(task)
    least = min(begin, end)
    k = 1.0 / rise + 1.0 / fall
    missing = 0.5 * k * least * least - excess  # what the way is too short by to stop
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
    """The duration, or the possible one that is the same but for rounding."""
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
    why = "the limits allow none so short"
    if duration_s > ranges[0][0]:
        why = "in between it would have to stop, and the way is too short for that"
    raise UsageError(f"this motion cannot take {duration_s:g} s, only {told}: {why}")


def _shortest_s(task: Task) -> float:
    _, excess, _, _, _, high, rise, fall, _, _ = task
    if excess > 0.0 and high == rise == fall == inf:
        return 0.0  # any duration longer than that
    return assembled(task, *peak_of(task), 0.0, 0.0)[-1][1]


def _ramp_s(task: Task, begin: float, end: float) -> float:
    """How long a ramp takes."""
    _, _, _, _, _, _, rise, fall, back_rise, back_fall = task
    forward, backward = (rise, back_rise) if end > begin else (fall, back_fall)
    return (
        abs(max(end, 0.0) - max(begin, 0.0)) / forward
        + abs(min(end, 0.0) - min(begin, 0.0)) / backward
    )
