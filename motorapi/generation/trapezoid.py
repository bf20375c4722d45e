"""Trapezoidal profiles in closed form, for any boundary velocities and durations.

A profile ramps from its initial velocity v0 to a peak u, holds u, and ramps to its final velocity
v1. Every ramp is as steep as the limits allow. Let p be the magnitude of the acceleration while the
velocity rises and q while it falls; either may differ between forward (v > 0) and backward motion:

    direct way   distance of the ramp from v0 straight to v1: sum of (v² - v'²) / (2 p or 2 q)
    excess       distance less the direct way. If it is < 0 everything is mirrored
    m            max(v0, v1): the ramp rises to u >= m and falls again
    k            1/p + 1/q of forward motion, k' of backward motion
    m >= 0       u² = m² + 2 excess / k          and u - m = (2 excess / k) / (u + m)
    m < 0        u² = (2 excess + k' m²) / k     the motion has to reverse first
    u > limit    u = limit, held for (excess - k (u² - m²) / 2) / u

Each profile is the shortest for its limits: at no time is another admissible motion further ahead.
Only the excess can suffer from cancellation; where it loses digits it is computed exactly, in
fractions. A direct ramp stays direct although its numbers are rounded: a motion does not reverse
for an excess within the rounding error of the distance and of the braking distance.

The extent is minimal too. Any motion with these accelerations overshoots by the braking distance
from its initial velocity, and by the distance needed to reach its final velocity. This profile does
not overshoot further. If it leaves a range of values, so does every other motion.

*Given duration.* At a duration T, with every ramp as steep as the limits allow, the distance grows
with the peak:

    d(distance) / du = T - (time for both ramps) = duration of the plateau >= 0

So each distance that is possible in T has one peak, and no motion of another shape reaches a
distance that these do not. With c = T - (time of the direct ramp) and G the excess caused by u:

    between the boundary velocities   G = u c
    above or below                    G is a quadratic polynomial of u on each side of 0

One of the two is solved. The formulas avoid cancellation for long T.

If both boundary velocities are forward, and the distance is too short for a stop, the motion can be
slow only as long as it need not stop: until Ta. For a longer duration it must stop beyond the
target, move back and return, which is impossible before Tb. No motion has a duration between Ta and
Tb.

*From rest to rest*, with distance D >= 0, speed limit v, acceleration a and deceleration d (all
magnitudes) and h = (1/a + 1/d) / 2, half of k:

    shortest   peak p = min(v, sqrt(D / h)), duration T = D/p + h p
    stretched  the peak p for which D/p + h p = T: p = 2 D / (T + sqrt(T² - 4 h D))

These are the peaks of the general form. Times and positions differ from it by rounding errors, and
recordings depend on them: docs/decisions/0041 says why both forms stay.

Source: Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), 3.2,
trapezoidal trajectories with non-null initial and final velocities; asymmetric ramps and reversing
motions follow in the same way. U is one unit of length (rad or m) throughout.
"""

from math import inf, isfinite, sqrt
from typing import TYPE_CHECKING, Final, TypeAlias, final

from motorhil.frozen import frozen
from motorhil.motorapi.commands import Range
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.generation.limits import ProfileLimits
from motorhil.motorapi.planning.limits import ROUNDING

if TYPE_CHECKING:
    from motorhil.motorapi.functions.piecewise import Piecewise

_LOST: Final = 64.0  # ratio of direct way to excess beyond which digits are lost
_ROUNDING: Final = 2.0**-50

Piece: TypeAlias = tuple[float, float, float, float, float, float, float]
"""One piece: (begin [s], end [s], initial value, final value [U], initial and final first
derivative [U/s], second derivative [U/s²]); times are relative to the beginning of the profile.
"""

_Task: TypeAlias = tuple[float, float, float, float, float, float, float, float, float, float]
"""A motion, mirrored if necessary so that its excess is >= 0: (sign, excess, initial velocity,
final velocity, low, high, rise, fall, back_rise, back_fall). The sign is -1 if mirrored, (low,
high) is the velocity range, and the magnitudes of the acceleration in forward and backward motion
follow.
"""


@final
@frozen(repr=False)
class Profile:
    """A function value over its argument, in pieces of constant second derivative; immutable.

    Velocity changes its sign only at the end of a piece, so the value is monotone in each piece.
    The last piece is computed from its end and all others from their beginning. So both boundary
    states are exact, and rounding errors appear between two pieces only. U is the unit of the
    value. Outside its arguments a profile has the state of the nearer end.

    Attributes:
        initial_argument: argument at the beginning, in most cases a time [s].
        initial_velocity: first derivative at the beginning [U/s].
        final_velocity: first derivative at the end [U/s].
        pieces: at least one; a piece has no duration only if the profile has none.
    """

    initial_argument: float
    initial_velocity: float
    final_velocity: float
    pieces: tuple[Piece, ...]

    @property
    def duration_s(self) -> float:
        """The duration [s], >= 0."""
        return self.pieces[-1][1]

    @property
    def final_argument(self) -> float:
        """The argument at the end."""
        return self.initial_argument + self.pieces[-1][1]

    @property
    def switching_times_s(self) -> tuple[float, ...]:
        """Times of acceleration changes and reversals, relative to the beginning [s]."""
        return tuple([piece[1] for piece in self.pieces[:-1]])

    @property
    def initial(self) -> float:
        """The value at the beginning [U]."""
        return self.pieces[0][2]

    @property
    def final(self) -> float:
        """The value at the end [U]."""
        return self.pieces[-1][3]

    @property
    def value_range(self) -> Range:
        """(lowest, highest) value of the profile [U]."""
        values = [self.initial, *(piece[3] for piece in self.pieces)]
        return min(values), max(values)

    @property
    def velocity_range(self) -> Range:
        """(lowest, highest) first derivative, both ends included [U/s]."""
        velocities = [self.initial_velocity, self.final_velocity]
        for piece in self.pieces:
            velocities += piece[4:6]
        return min(velocities), max(velocities)

    def value(self, argument: float) -> float:
        """Return the function value [U]."""
        since = argument - self.initial_argument
        pieces = self.pieces
        last = pieces[-1]
        if since >= last[1]:
            return last[3]
        if since <= 0.0:
            return pieces[0][2]
        for piece in pieces:
            if since < piece[1]:
                break
        begins_s, ends_s, begin, end, entry, leave, acceleration = piece
        if piece is last:
            since -= ends_s
            found = end + (leave + 0.5 * acceleration * since) * since
        else:
            since -= begins_s
            found = begin + (entry + 0.5 * acceleration * since) * since
        return _between(begin, found, end)

    def first(self, argument: float) -> float:
        """Return the first derivative [U/s]; outside the arguments, that of the nearer end."""
        since = argument - self.initial_argument
        pieces = self.pieces
        last = pieces[-1]
        if since >= last[1]:
            return self.final_velocity
        if since <= 0.0:
            return self.initial_velocity
        for piece in pieces:
            if since < piece[1]:
                break
        begins_s, ends_s, _, _, entry, leave, acceleration = piece
        if piece is last:
            found = leave + acceleration * (since - ends_s)
        else:
            found = entry + acceleration * (since - begins_s)
        return _between(entry, found, leave)

    def second(self, argument: float) -> float:
        """Return the second derivative [U/s²]: between pieces that of the later; outside 0."""
        since = argument - self.initial_argument
        if since < 0.0 or since > self.pieces[-1][1]:
            return 0.0
        for piece in self.pieces:
            if since < piece[1]:
                break
        return piece[6]

    def as_function(self) -> "Piecewise":
        """Return the profile as a piecewise polynomial of the argument; imports numpy.

        As in the profile, the last piece is expanded about its end and all others about their
        beginning. Pieces shorter than the resolution of the argument (far from 0) are omitted.

        Raises:
            UsageError: the profile takes no time, so that it has no value at any argument.
        """
        from motorhil.motorapi.functions.piecewise import Piecewise
        from motorhil.motorapi.functions.polynomial import Polynomial

        begin = self.initial_argument
        edges = [begin]
        polynomials: list[Polynomial] = []
        last = self.pieces[-1]
        for piece in self.pieces:
            begins_s, ends_s, first, final, entry, leave, acceleration = piece
            edge = begin + ends_s
            if edge <= edges[-1]:
                continue
            edges.append(edge)
            about, value, slope = (
                (edge, final, leave) if piece is last else (begin + begins_s, first, entry)
            )
            polynomials.append(Polynomial((value, slope, 0.5 * acceleration), about))
        if not polynomials:
            raise UsageError(f"{self!r} takes no time: it is not a function of the argument")
        return Piecewise(edges, polynomials)

    def __repr__(self) -> str:
        return (
            f"<Profile from {self.initial!r} to {self.final!r} in {self.duration_s!r} s,"
            f" velocity {self.initial_velocity!r} to {self.final_velocity!r},"
            f" {len(self.pieces)} pieces>"
        )


def _between(one: float, found: float, other: float) -> float:
    """Return `found`, clipped to the range of two values against rounding errors."""
    if one <= other:
        return one if found < one else other if found > other else found
    return other if found < other else one if found > one else found


def trapezoid(
    final: float,
    limits: ProfileLimits,
    *,
    initial: float = 0.0,
    initial_velocity: float = 0.0,
    final_velocity: float = 0.0,
    duration_s: float | None = None,
    initial_argument: float = 0.0,
) -> Profile:
    """Return the shortest profile between two states within the limits, or one of a duration.

    Args:
        final: the final value [U]; the distance, if `initial` is 0.
        limits: of velocity and acceleration. The range of the value is not used: if the shortest
            profile leaves it, so does any other; see `motorhil.motorapi.generation.feasible`.
        initial: the initial value [U].
        initial_velocity: first derivative at the beginning [U/s].
        final_velocity: first derivative at the end [U/s].
        duration_s: duration [s], >= 0, with the steepest ramps and the only matching peak. Within
            1e-9 of a possible duration that one is used. None: the shortest.
        initial_argument: argument at the beginning.

    Raises:
        UsageError: a number is not finite, a boundary velocity lies outside the limits, or no
            motion (of that duration) exists; the message lists the possible durations.
    """
    task = _task_of(final, limits, initial, initial_velocity, final_velocity)
    if not isfinite(initial_argument):
        raise UsageError(f"the initial argument is {initial_argument}, not a finite number")
    pieces: tuple[Piece, ...]
    if duration_s is not None:
        pieces = _pieces_lasting(task, duration_s, initial, final)
        return Profile(initial_argument, initial_velocity, final_velocity, pieces)
    peak, up, down, hold_s = _shortest_peak(task)
    sign, _, begin, end, _, _, rise, fall, _, _ = task
    if begin >= 0.0 <= end and up > 0.0 < down and rise < inf > fall:
        # One ramp up and one down, the common case: the same as `_assembled`, without a list.
        t1 = up / rise
        t2 = t1 + hold_s
        t3 = t2 + down / fall
        x2 = final - sign * 0.5 * (peak + end) * (t3 - t2)
        top = sign * peak
        last = (t2, t3, x2, final, top, final_velocity, -sign * fall)
        if hold_s:
            x1 = initial + sign * 0.5 * (begin + peak) * t1
            first = (0.0, t1, initial, x1, initial_velocity, top, sign * rise)
            pieces = (first, (t1, t2, x1, x2, top, top, 0.0), last)
        else:
            pieces = ((0.0, t1, initial, x2, initial_velocity, top, sign * rise), last)
    else:
        pieces = _assembled(task, peak, up, down, hold_s, initial, final)
    return Profile(initial_argument, initial_velocity, final_velocity, pieces)


def _task_of(
    final: float,
    limits: ProfileLimits,
    initial: float,
    initial_velocity: float,
    final_velocity: float,
) -> _Task:
    """Return the motion in the direction in which its excess is >= 0.

    Raises:
        UsageError: a number is not finite, or a boundary velocity lies outside the limits.
    """
    low, high = limits.velocity
    way = final - initial
    if not (
        low <= initial_velocity <= high
        and low <= final_velocity <= high
        and isfinite(way)
        and isfinite(initial_velocity - final_velocity)
    ):
        _refuse(final, initial, initial_velocity, final_velocity, limits)
    fall, rise = limits.forward
    back_fall, back_rise = limits.backward
    excess = way
    if initial_velocity != final_velocity:
        sizes = (rise, back_rise) if final_velocity > initial_velocity else (fall, back_fall)
        direct = _direct_way(initial_velocity, final_velocity, *sizes)
        excess = way - direct
        if abs(excess) * _LOST < abs(direct):
            excess = _exact_excess(final, initial, initial_velocity, final_velocity, *sizes)
        if initial_velocity * final_velocity > 0.0 > excess * final_velocity:
            # The motion would reverse twice: not for a rounding error of the distance.
            size = sizes[0] if final_velocity > 0.0 else sizes[1]
            squares = initial_velocity * initial_velocity + final_velocity * final_velocity
            if abs(excess) <= _ROUNDING * (abs(initial) + abs(final) + squares / abs(size)):
                excess = 0.0
    if excess >= 0.0:
        return (
            1.0, excess, initial_velocity, final_velocity, low, high,
            rise, -fall, back_rise, -back_fall,
        )  # fmt: skip
    return (
        -1.0, -excess, -initial_velocity, -final_velocity, -high, -low,
        -back_fall, back_rise, -fall, rise,
    )  # fmt: skip


def _shortest_peak(task: _Task) -> tuple[float, float, float, float]:
    """Return (peak, velocity gain to it, velocity loss after it, duration of the plateau [s]).

    Raises:
        UsageError: the limits allow no such motion, or do not bound it at all.
    """
    _, excess, initial, final, _, high, rise, fall, back_rise, back_fall = task
    peak = greater = initial if initial > final else final
    gain = hold_s = 0.0
    if excess > 0.0:
        k = 1.0 / rise + 1.0 / fall
        if greater < 0.0:
            # The motion reverses first: it must make up for the distance of the reversal.
            excess += 0.5 * (1.0 / back_rise + 1.0 / back_fall) * greater * greater
            greater = 0.0
        gained = 2.0 * excess / k if k else inf
        peak = sqrt(greater * greater + gained)
        if peak <= high and peak < inf:
            gain = gained / (peak + greater)
        else:
            if not 0.0 < high < inf:
                _refuse_way(high)
            peak, gain = high, high - greater
            hold_s = max(0.0, (excess - 0.5 * k * gain * (high + greater)) / high)
    return peak, (greater - initial) + gain, (greater - final) + gain, hold_s


def _assembled(
    task: _Task,
    peak: float,
    up: float,
    down: float,
    hold_s: float,
    initial: float,
    final: float,
) -> tuple[Piece, ...]:
    """Return the pieces, computed from the beginning up to the peak and from the end after it.

    Args:
        task: the motion.
        peak: the velocity of the plateau; in the direction of the task, as the next arguments.
        up: velocity gain to the peak, < 0 if it falls.
        down: velocity loss after the peak, < 0 if it rises.
        hold_s: duration of the plateau [s].
        initial: the value at the beginning.
        final: the value at the end.
    """
    sign, _, begin, end, _, _, rise, fall, back_rise, back_fall = task
    sizes = (rise, back_rise) if up > 0.0 else (-fall, -back_fall)
    before = _ramp(begin, peak, up, sizes[0], sizes[1])
    sizes = (-fall, -back_fall) if down > 0.0 else (rise, back_rise)
    after = _ramp(peak, end, -down, sizes[0], sizes[1])
    if hold_s > 0.0:
        before.append((hold_s, peak, peak, 0.0))
    if not after:
        after = before[-1:]  # the last piece, whichever it is, is computed from the end
        del before[-1:]
    half = 0.5 * sign
    kink = meeting = final  # values where the last ramp reverses, and where it begins
    for lasts_s, entry, leave, _ in reversed(after):
        kink, meeting = meeting, meeting - half * (entry + leave) * lasts_s
    pieces: list[Piece] = []
    time_s, value = 0.0, initial
    left = len(before)
    for lasts_s, entry, leave, acceleration in before:
        since_s, since = time_s, value
        time_s += lasts_s
        left -= 1
        # Both computations meet where the last ramp begins.
        value = value + half * (entry + leave) * lasts_s if left else meeting
        pieces.append(
            (since_s, time_s, since, value, sign * entry, sign * leave, sign * acceleration)
        )
    for lasts_s, entry, leave, acceleration in after:
        since_s, since = time_s, value
        time_s += lasts_s
        value, kink = kink, final
        pieces.append(
            (since_s, time_s, since, value, sign * entry, sign * leave, sign * acceleration)
        )
    if not pieces:
        pieces.append((0.0, 0.0, final, final, sign * end, sign * end, 0.0))
    return tuple(pieces)


def _ramp(
    begin: float, end: float, change: float, forward: float, backward: float
) -> list[tuple[float, float, float, float]]:
    """Return (duration, initial velocity, final velocity, acceleration) of each piece of a ramp.

    `change` is the difference of the velocities, perhaps more accurate than their subtraction.
    `forward` and `backward` are the accelerations, with the sign of the change. Without a limit of
    acceleration a ramp takes no time and has no piece.
    """
    if begin >= 0.0 <= end:
        lasts_s = change / forward
        return [(lasts_s, begin, end, forward)] if lasts_s > 0.0 else []
    if begin <= 0.0 >= end:
        lasts_s = change / backward
        return [(lasts_s, begin, end, backward)] if lasts_s > 0.0 else []
    one, other = (forward, backward) if begin > 0.0 else (backward, forward)
    return _ramp(begin, 0.0, -begin, one, one) + _ramp(0.0, end, end, other, other)


def _direct_way(begin: float, end: float, size: float, back_size: float) -> float:
    """Return the distance of a direct ramp; `size` and `back_size` have the sign of the ramp."""
    if begin >= 0.0 <= end:
        return 0.5 * (end - begin) * (end + begin) / size
    if begin <= 0.0 >= end:
        return 0.5 * (end - begin) * (end + begin) / back_size
    if begin < 0.0:
        return 0.5 * (end * end / size - begin * begin / back_size)
    return 0.5 * (end * end / back_size - begin * begin / size)


def _exact_excess(
    final: float, initial: float, begin: float, end: float, size: float, back_size: float
) -> float:
    """Return the excess with a single rounding: slow, and seldom needed."""
    from fractions import Fraction

    def way_to(velocity: float) -> "Fraction":
        """Return the distance from rest to `velocity`."""
        taken = size if velocity > 0.0 else back_size
        return Fraction(velocity) ** 2 / (2 * Fraction(taken)) if isfinite(taken) else Fraction(0)

    return float(Fraction(final) - Fraction(initial) - way_to(end) + way_to(begin))


def _refuse(
    final: float,
    initial: float,
    initial_velocity: float,
    final_velocity: float,
    limits: ProfileLimits,
) -> None:
    for name, number in (
        ("final value", final),
        ("initial value", initial),
        ("way", final - initial),
        ("initial velocity", initial_velocity),
        ("final velocity", final_velocity),
    ):
        if not isfinite(number):
            raise UsageError(f"the {name} is {number}, not a finite number")
    low, high = limits.velocity
    for name, number in (("initial", initial_velocity), ("final", final_velocity)):
        if not low <= number <= high:
            raise UsageError(
                f"the {name} velocity {number:g} lies outside its limits, {low:g} to {high:g}"
            )


def _refuse_way(high: float) -> None:
    if high <= 0.0:
        raise UsageError("the velocity limits allow no motion in this direction")
    raise UsageError("neither velocity nor acceleration is limited: the motion would take no time")


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
    return _possible(_task_of(final, limits, initial, initial_velocity, final_velocity))


def _pieces_lasting(
    task: _Task, duration_s: float, initial: float, final: float
) -> tuple[Piece, ...]:
    """Return the pieces of the motion of this duration; see `_assembled`.

    Raises:
        UsageError: the duration is not finite and >= 0, or not possible.
    """
    if not (isfinite(duration_s) and duration_s >= 0.0):
        raise UsageError(f"the duration is {duration_s} s, not a finite number >= 0")
    duration_s = _allowed(task, duration_s)
    if duration_s <= _shortest_s(task):
        return _assembled(task, *_shortest_peak(task), initial, final)
    _, _, begin, end, low, high, *_ = task
    peak = min(max(_peak_lasting(task, duration_s - _ramp_s(task, begin, end)), low), high)
    hold_s = duration_s - _ramp_s(task, begin, peak) - _ramp_s(task, peak, end)
    pieces = _assembled(task, peak, peak - begin, peak - end, max(hold_s, 0.0), initial, final)
    return (*pieces[:-1], (pieces[-1][0], duration_s, *pieces[-1][2:]))


def _peak_lasting(task: _Task, spare_s: float) -> float:
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


def _possible(task: _Task) -> tuple[Range, ...]:
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


def _allowed(task: _Task, duration_s: float) -> float:
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


def _shortest_s(task: _Task) -> float:
    _, excess, _, _, _, high, rise, fall, _, _ = task
    if excess > 0.0 and high == rise == fall == inf:
        return 0.0  # all longer durations are possible
    return _assembled(task, *_shortest_peak(task), 0.0, 0.0)[-1][1]


def _ramp_s(task: _Task, begin: float, end: float) -> float:
    """Return the duration of a ramp [s]."""
    _, _, _, _, _, _, rise, fall, back_rise, back_fall = task
    forward, backward = (rise, back_rise) if end > begin else (fall, back_fall)
    return (
        abs(max(end, 0.0) - max(begin, 0.0)) / forward
        + abs(min(end, 0.0) - min(begin, 0.0)) / backward
    )


@final
@frozen
class Trapezoid:
    """A generated profile from rest at 0 to rest at `distance`; immutable.

    Attributes:
        distance: signed [U].
        peak: highest speed [U/s], >= 0.
        acceleration: magnitude while speeding up [U/s²], > 0.
        deceleration: magnitude while slowing down [U/s²], > 0.
        ramp_up_s: beginning of the plateau [s], t_1 in the paper.
        ramp_down_s: end of the plateau [s], t_2 in the paper.
        duration_s: time of arrival at `distance` [s], t_f in the paper.
    """

    distance: float
    peak: float
    acceleration: float
    deceleration: float
    ramp_up_s: float
    ramp_down_s: float
    duration_s: float

    def position(self, time_s: float) -> float:
        """Return the position [U] at `time_s` [s]; 0 before the start, `distance` after the end."""
        if time_s <= 0.0:
            return 0.0
        if time_s >= self.duration_s:
            return self.distance
        way = abs(self.distance)
        if time_s < self.ramp_up_s:
            made = 0.5 * self.acceleration * time_s * time_s
        elif time_s <= self.ramp_down_s:
            made = self.peak * (time_s - 0.5 * self.ramp_up_s)
        else:
            left_s = self.duration_s - time_s
            made = way - 0.5 * self.deceleration * left_s * left_s
        return min(made, way) if self.distance > 0.0 else -min(made, way)

    def velocity(self, time_s: float) -> float:
        """Return the signed velocity [U/s] at `time_s` [s]; 0 outside the motion."""
        if time_s <= 0.0 or time_s >= self.duration_s:
            return 0.0
        speed = min(
            self.acceleration * time_s,
            self.peak,
            self.deceleration * (self.duration_s - time_s),
        )
        return speed if self.distance > 0.0 else -speed


def shortest(
    distance: float, velocity: float, acceleration: float, deceleration: float
) -> Trapezoid:
    """Return the shortest profile over `distance` within the limits.

    Args:
        distance: signed [U], finite.
        velocity: speed limit [U/s], finite, > 0.
        acceleration: limit while speeding up [U/s²], finite, > 0.
        deceleration: limit while slowing down [U/s²], finite, > 0.

    Raises:
        UsageError: an argument violates these conditions.
    """
    _check(distance, velocity, acceleration, deceleration)
    way = abs(distance)
    if way == 0.0:
        return Trapezoid(distance, 0.0, acceleration, deceleration, 0.0, 0.0, 0.0)
    k = _ramp_time(acceleration, deceleration)
    triangle = sqrt(way / k)
    if triangle <= velocity:
        return _trapezoid(distance, triangle, acceleration, deceleration, 0.0)
    plateau_s = max(0.0, way / velocity - k * velocity)
    return _trapezoid(distance, velocity, acceleration, deceleration, plateau_s)


def stretched(
    distance: float, duration_s: float, acceleration: float, deceleration: float
) -> Trapezoid:
    """Return the profile over `distance` of duration `duration_s`, with a lower plateau.

    Args:
        distance: signed [U], finite.
        duration_s: > 0 [s], at least the duration of `shortest` (within rounding).
        acceleration: while speeding up [U/s²], finite, > 0.
        deceleration: while slowing down [U/s²], finite, > 0.

    Raises:
        UsageError: an argument violates these conditions, or the duration is too short.
    """
    _check(distance, duration_s, acceleration, deceleration)
    way = abs(distance)
    if way == 0.0:
        return Trapezoid(distance, 0.0, acceleration, deceleration, 0.0, duration_s, duration_s)
    k = _ramp_time(acceleration, deceleration)
    rest = duration_s * duration_s - 4.0 * k * way
    if rest < -1e-9 * duration_s * duration_s:
        raise UsageError(
            f"distance {way:g} in {duration_s:g} s is impossible with ramps of "
            f"{acceleration:g} and {deceleration:g}; it takes at least {2.0 * sqrt(k * way):g} "
            "s"
        )
    peak = 2.0 * way / (duration_s + sqrt(max(rest, 0.0)))
    plateau_s = max(0.0, way / peak - k * peak)
    return _trapezoid(distance, peak, acceleration, deceleration, plateau_s)


def _ramp_time(acceleration: float, deceleration: float) -> float:
    return 0.5 / acceleration + 0.5 / deceleration


def _trapezoid(
    distance: float, peak: float, acceleration: float, deceleration: float, plateau_s: float
) -> Trapezoid:
    up_s = peak / acceleration
    end_s = up_s + plateau_s + peak / deceleration
    return Trapezoid(distance, peak, acceleration, deceleration, up_s, up_s + plateau_s, end_s)


def _check(distance: float, *positive: float) -> None:
    if not isfinite(distance):
        raise UsageError(f"distance {distance} is not a finite number")
    for value in positive:
        if not (isfinite(value) and value > 0.0):
            raise UsageError(f"{value} must be finite and > 0 (a limit or a duration)")
