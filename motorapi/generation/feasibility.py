"""Whether a motion can be made, and if not why: which limit, when, and by how much."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import inf, nextafter
from typing import TYPE_CHECKING, Final, final

from motorapi.commands import ControlVariable, DerivativeLimits, Range
from motorapi.errors import LimitError, UnsupportedError, UsageError
from motorapi.generation.allowed import Allowed
from motorapi.generation.closed_form import trapezoid
from motorapi.generation.durations import possible_durations
from motorapi.generation.profile import Profile
from motorapi.limits import ROUNDING, slack
from motorapi.model import MotorModel
from motorapi.trajectory import ComplexTrajectory, Trajectory, TrapezoidalTrajectory

if TYPE_CHECKING:
    from motorapi.functions.function import Function

STEP_S: Final = 0.01
"""A derivative may step by what the next one makes in this time; samples are no smoother."""


@final
@dataclass(frozen=True, slots=True)
class Violation:
    """One limit that a motion would exceed.

    Attributes:
        quantity: which limit, in words ("velocity", "duration").
        value: the worst there is; inf if a lower derivative steps.
        low, high: the range that is allowed.
        argument: when the worst is [s]; None of a duration.
        unit: of the value; "" if no model tells it.
        reason: more, in words; "" if there is no more to say.
    """

    quantity: str
    value: float
    low: float
    high: float
    argument: float | None
    unit: str
    reason: str = ""

    @property
    def by(self) -> float:
        """How far out of the range the worst value is."""
        return max(self.low - self.value, self.value - self.high)

    def as_error(self, motor: str) -> LimitError:
        """The same as an error about a motor."""
        when = "" if self.argument is None else f"at argument {self.argument:g}"
        return LimitError(
            motor=motor,
            quantity=f"{self.quantity} of the trajectory",
            value=self.value,
            low=None if self.low == -inf else self.low,
            high=None if self.high == inf else self.high,
            unit=self.unit,
            reason=", ".join(part for part in (when, self.reason) if part),
        )

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        when = "" if self.argument is None else f" at {self.argument:g} s"
        below = self.value < self.low
        side, limit = ("below the lowest", self.low) if below else ("above the highest", self.high)
        tail = f": {self.reason}" if self.reason else ""
        return (
            f"{self.quantity} {self.value:g}{unit}{when} is {self.by:g}{unit} {side},"
            f" {limit:g}{unit}{tail}"
        )


@final
@dataclass(frozen=True, slots=True)
class Feasibility:
    """True if nothing is violated; else it says what is, the first derivative's limits first."""

    violations: tuple[Violation, ...] = ()

    def __bool__(self) -> bool:
        return not self.violations

    def __str__(self) -> str:
        return "; ".join(map(str, self.violations)) or "feasible"


def feasible(
    motion: "Trajectory | Profile | Function",
    against: MotorModel | DerivativeLimits,
    *,
    variable: ControlVariable = ControlVariable.POSITION,
    start: float = 0.0,
    interval: Range | None = None,
) -> Feasibility:
    """Whether the motion stays within the limits, and else every one that it exceeds.

    A simple trajectory is generated first: of all motions with its boundary conditions, that which
    exceeds the least. Then it, as a complex one and a function over time, is looked at where it is
    extreme. As elsewhere, 1e-9 of a limit is rounding.

    Args:
        motion: what is to be made; a function of the time in s.
        against: a model, or limits.
        variable: what it is a motion of.
        start: where a relative trajectory begins.
        interval: of a function: from when to when; None: all of its domain.

    Raises:
        UnsupportedError: of a simple trajectory: as for `motorapi.generation.generate`.
        UsageError: the function is not bounded in its arguments, or it is no motion.
    """
    if isinstance(motion, TrapezoidalTrajectory):
        return Feasibility(tuple(attempt(motion, against, variable, start)[1]))
    if isinstance(motion, Profile):
        allowed = Allowed.by(against, variable, None)
        return Feasibility(tuple(_of_profile(motion, allowed)))
    offset, own = 0.0, None
    if isinstance(motion, ComplexTrajectory):
        interval, own = motion.interval, motion.limits
        if motion.relative:
            offset = start - motion.function.value(interval[0])
        motion = motion.function
    if not isinstance(getattr(motion, "domain", None), tuple):
        raise UsageError(f"{motion!r} is no trajectory, no Profile and no function of the API")
    low, high = motion.domain if interval is None else interval
    if not (-inf < low < high < inf):
        raise UsageError(f"{motion!r} has no finite beginning and end: give interval=")
    allowed = Allowed.by(against, variable, own)
    return Feasibility(tuple(_of_function(motion, offset, allowed, (low, high))))


def attempt(
    trajectory: TrapezoidalTrajectory,
    against: MotorModel | DerivativeLimits,
    variable: ControlVariable,
    start: float,
) -> tuple[Profile | None, list[Violation]]:
    """The profile of a trajectory, if there is one, and all limits that it exceeds.

    Raises:
        UnsupportedError: no trapezoid can be what is asked for.
    """
    _require_trapezoid(trajectory, against)
    initial = start if trajectory.initial is None else trajectory.initial
    final_ = start + trajectory.final if trajectory.is_relative else trajectory.final
    begin, end = trajectory.initial_velocity, trajectory.final_velocity
    sizes = (initial, final_) if not (begin or end) else None
    if isinstance(against, MotorModel):
        against = replace(against, jerk_max=None)  # which plays no part in a trapezoid
    allowed = Allowed.by(against, variable, trajectory.limits, sizes=sizes)
    first_s = trajectory.initial_argument
    fast = [
        *_beyond(allowed, 1, allowed.first, begin, first_s, "where it begins"),
        *_beyond(allowed, 1, allowed.first, end, trajectory.final_argument, "where it ends"),
    ]
    if fast:
        return None, fast
    limits = allowed.profile_limits(begin, end)
    asked = trajectory.duration_s
    ranges = possible_durations(
        final_, limits, initial=initial, initial_velocity=begin, final_velocity=end
    )
    if asked is not None:
        asked, impossible = _duration(asked, ranges)
        if impossible is not None:
            return None, [impossible]
    profile = trapezoid(
        final_,
        limits,
        initial=initial,
        initial_velocity=begin,
        final_velocity=end,
        duration_s=asked,
        initial_argument=first_s,
    )
    return profile, list(_of_profile(profile, allowed))


def _require_trapezoid(
    trajectory: TrapezoidalTrajectory, against: MotorModel | DerivativeLimits
) -> None:
    """What a trapezoid does not keep to, or cannot begin or end with, is not asked for."""
    feature = ""
    if trajectory.limits is not None and trajectory.limits.third is not None:
        feature = "a trapezoidal profile with a limit of the third derivative"
    if any((*trajectory.initial_derivatives[1:], *trajectory.final_derivatives[1:])):
        feature = "a trapezoidal profile that begins or ends with a second derivative"
    if feature:
        raise UnsupportedError(
            motor=against.name if isinstance(against, MotorModel) else "a trapezoid",
            feature=feature,
            supported="that with a limited jerk: motorapi.generation.jerk_limited",
        )


def _duration(asked: float, ranges: tuple[Range, ...]) -> tuple[float, Violation | None]:
    """The duration asked for, or the possible one that rounding hides, or what is wrong with it."""
    for low, high in ranges:
        if low <= asked <= high:
            return asked, None
    nearest = min((end for both in ranges for end in both), key=lambda end: abs(end - asked))
    if abs(nearest - asked) <= ROUNDING * nearest:
        return nearest, None
    low, high = ranges[0]
    if asked < low:
        return asked, Violation("duration", asked, low, high, None, "s", "the limits allow no less")
    why = "later it would have to stop, and the way is too short for that"
    if len(ranges) > 1:
        why += f"; from {ranges[1][0]:g} s on it can run back and come again"
    return asked, Violation("duration", asked, low, high, None, "s", why)


def _of_profile(profile: Profile, allowed: Allowed) -> Iterator[Violation]:
    """The worst of each limit on each side, looked for where pieces meet."""
    found: dict[tuple[int, bool], Violation] = {}
    since_s = profile.initial_argument
    for begins_s, ends_s, begin, end, entry, leave, acceleration in profile.pieces:
        forward = max(entry, leave) > 0.0
        second = allowed.forward if forward else allowed.backward
        for order, limits, value, when in (
            (1, allowed.first, entry, begins_s),
            (1, allowed.first, leave, ends_s),
            (2, second, acceleration, begins_s),
            (0, allowed.value, begin, begins_s),
            (0, allowed.value, end, ends_s),
        ):
            for violation in _beyond(allowed, order, limits, value, since_s + when):
                place = (order, value < limits[0])
                if place not in found or violation.by > found[place].by:
                    found[place] = violation
    yield from (found[place] for place in sorted(found))


def _of_function(
    function: "Function", offset: float, allowed: Allowed, interval: Range
) -> Iterator[Violation]:
    ranges = (allowed.value, allowed.first, None, allowed.third)
    for order, limits in enumerate(ranges):
        if limits is None:
            yield from _of_second(function, allowed, interval)
            tightest = (
                max(allowed.forward[0], allowed.backward[0]),
                min(allowed.forward[1], allowed.backward[1]),
            )
            yield from _steps(function, 1, allowed, tightest, interval)
            continue
        yield from _worst(function, order, allowed, limits, [interval], offset)
        if order:
            yield from _steps(function, order - 1, allowed, limits, interval)
        offset = 0.0


def _of_second(function: "Function", allowed: Allowed, interval: Range) -> Iterator[Violation]:
    """The second derivative, whose range depends on the sign of the first."""
    if allowed.forward == allowed.backward:
        yield from _worst(function, 2, allowed, allowed.forward, [interval])
        return
    from motorapi.generation.directions import parts_by_direction

    forward, backward = parts_by_direction(function, interval)
    yield from _worst(function, 2, allowed, allowed.forward, forward)
    yield from _worst(function, 2, allowed, allowed.backward, backward)


def _worst(
    function: "Function",
    order: int,
    allowed: Allowed,
    limits: Range,
    parts: list[Range],
    offset: float = 0.0,
) -> Iterator[Violation]:
    """The lowest and the highest value over some intervals, where they lie outside the limits."""
    if limits == (-inf, inf) or not parts:
        return
    derivative = function.derivative(order)
    found = [derivative.extrema(low, high) for low, high in parts]
    least = min(found, key=lambda one: one.minimum)
    most = max(found, key=lambda one: one.maximum)
    yield from _beyond(allowed, order, (limits[0], inf), least.minimum + offset, least.at_minimum)
    yield from _beyond(allowed, order, (-inf, limits[1]), most.maximum + offset, most.at_maximum)


def _steps(
    function: "Function", order: int, allowed: Allowed, limits: Range, interval: Range
) -> Iterator[Violation]:
    """The largest step of a derivative that its own derivative's limits do not allow."""
    low, high = limits
    derivative = function.derivative(order)
    worst, at = 0.0, 0.0
    for where in derivative.breaks_between(*interval):
        before = max(nextafter(where, -inf), interval[0])
        step = derivative.value(where) - derivative.value(before)
        top = high if step > 0.0 else -low
        rounding = ROUNDING * (abs(derivative.value(where)) + abs(derivative.value(before)))
        if abs(step) > max(top * (STEP_S if order else 1e-6), rounding) and abs(step) > abs(worst):
            worst, at = step, where
    if worst:
        unit = f" {allowed.units[order]}" if allowed.units[order] else ""
        why = f"{allowed.names[order]} steps by {worst:g}{unit} there"
        value = inf if worst > 0.0 else -inf
        name, per = allowed.names[order + 1], allowed.units[order + 1]
        yield Violation(name, value, low, high, at, per, why)


def _beyond(
    allowed: Allowed,
    order: int,
    limits: Range,
    value: float,
    argument: float | None,
    reason: str = "",
) -> Iterator[Violation]:
    low, high = limits
    if value < low - slack(low) or value > high + slack(high):
        name, unit = allowed.names[order], allowed.units[order]
        yield Violation(name, value, low, high, argument, unit, reason)
