"""Trapezoidal profiles in closed form, for any boundary velocities.

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

Source: Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), 3.2,
trapezoidal trajectories with non-null initial and final velocities; asymmetric ramps and reversing
motions follow in the same way.
"""

from math import inf, isfinite, sqrt
from typing import Final, TypeAlias

from motorapi.errors import UsageError
from motorapi.generation.limits import ProfileLimits
from motorapi.generation.profile import Piece, Profile

_LOST: Final = 64.0  # ratio of direct way to excess beyond which digits are lost
_ROUNDING: Final = 2.0**-50

Task: TypeAlias = tuple[float, float, float, float, float, float, float, float, float, float]
"""A motion, mirrored if necessary so that its excess is >= 0: (sign, excess, initial velocity,
final velocity, low, high, rise, fall, back_rise, back_fall). The sign is -1 if mirrored, (low,
high) is the velocity range, and the magnitudes of the acceleration in forward and backward motion
follow.
"""


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
            profile leaves it, so does any other; see `motorapi.generation.feasible`.
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
    task = task_of(final, limits, initial, initial_velocity, final_velocity)
    if not isfinite(initial_argument):
        raise UsageError(f"the initial argument is {initial_argument}, not a finite number")
    pieces: tuple[Piece, ...]
    if duration_s is not None:
        from motorapi.generation.durations import pieces_lasting

        pieces = pieces_lasting(task, duration_s, initial, final)
        return Profile(initial_argument, initial_velocity, final_velocity, pieces)
    peak, up, down, hold_s = peak_of(task)
    sign, _, begin, end, _, _, rise, fall, _, _ = task
    if begin >= 0.0 <= end and up > 0.0 < down and rise < inf > fall:
        # One ramp up and one down, the common case: the same as `assembled`, without a list.
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
        pieces = assembled(task, peak, up, down, hold_s, initial, final)
    return Profile(initial_argument, initial_velocity, final_velocity, pieces)


def task_of(
    final: float,
    limits: ProfileLimits,
    initial: float,
    initial_velocity: float,
    final_velocity: float,
) -> Task:
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


def peak_of(task: Task) -> tuple[float, float, float, float]:
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


def assembled(
    task: Task,
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
