"""Feasibility of motions: violated limits, with time and amount.

A motion is examined against the limits of a motor model, tightened by those of its command. The
second derivative may have different limits in forward and backward motion. Numpy is imported only
if a function is given.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from math import inf, nextafter
from typing import TYPE_CHECKING, Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.commands import ControlVariable, DerivativeLimits, Range
from motorhil.motorapi.errors import LimitError, UnsupportedError, UsageError
from motorhil.motorapi.generation.limits import ProfileLimits
from motorhil.motorapi.generation.trapezoid import Profile, possible_durations, trapezoid
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.planning.limits import ROUNDING, slack, value_range
from motorhil.motorapi.trajectory import ComplexTrajectory, Trajectory, TrapezoidalTrajectory

if TYPE_CHECKING:
    from motorhil.motorapi.functions.base import Function

STEP_S: Final = 0.01
"""The time [s] for which the next derivative may cause a step: samples are no smoother."""
_ALL: Final[Range] = (-inf, inf)
_PER: Final = ("", "/s", "/s²", "/s³", "/s⁴")
_NAMES: Final = {
    ControlVariable.POSITION: ("position", "velocity", "acceleration", "jerk"),
    ControlVariable.VELOCITY: ("velocity", "acceleration", "jerk", "derivative of jerk"),
    ControlVariable.TORQUE: ("torque", "slope of torque", "bend of torque", "third derivative"),
    ControlVariable.CURRENT: ("current", "slope of current", "bend of current", "third derivative"),
}
_PLAIN: Final = ("value", "first derivative", "second derivative", "third derivative")


@final
@frozen
class Allowed:
    """Ranges of a value and its derivatives, with their names.

    Attributes:
        whose: the name of the model, or "limits".
        names: names of the value and its derivatives.
        units: their units; "" without a model.
        value, first, third: their ranges.
        forward: range of the second derivative while the first is > 0.
        backward: range of the second derivative while the first is < 0.
    """

    whose: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    value: Range
    first: Range
    forward: Range
    backward: Range
    third: Range

    @classmethod
    def by(
        cls,
        against: MotorModel | DerivativeLimits,
        variable: ControlVariable,
        own: DerivativeLimits | None,
        *,
        sizes: Range | None = None,
    ) -> "Allowed":
        """Return the limits of `against`, tightened by `own` if given.

        Args:
            against: a model, or limits alone.
            variable: the control variable; irrelevant for limits alone.
            own: tighter limits.
            sizes: for a motion of velocity: its initial and final value, because acceleration and
                deceleration have different limits in the model; None: the tighter one.

        Raises:
            UsageError: `against` or `variable` has the wrong type.
        """
        if not isinstance(variable, ControlVariable):
            raise UsageError(f"variable is {variable!r}; give a ControlVariable")
        if isinstance(against, MotorModel):
            made = cls._by_model(against, variable, sizes)
        elif not isinstance(against, DerivativeLimits):
            raise UsageError(f"{against!r} has no limits; give a MotorModel or DerivativeLimits")
        else:
            made = cls("limits", _PLAIN, ("",) * 4, _ALL, _ALL, _ALL, _ALL, _ALL)
            made = made.tightened(against)
        return made if own is None else made.tightened(own)

    @classmethod
    def _by_model(
        cls, model: MotorModel, variable: ControlVariable, sizes: Range | None
    ) -> "Allowed":
        low, high = value_range(model, variable)
        value = (-inf if low is None else low, inf if high is None else high)
        first = forward = backward = third = _ALL
        order = 0
        jerk = _ALL if model.jerk_max is None else (-model.jerk_max, model.jerk_max)
        up, down = model.acceleration_max, model.deceleration
        if variable is ControlVariable.POSITION:
            first = (-model.velocity_max, model.velocity_max)
            forward, backward, third = (-down, up), (-up, down), jerk
        elif variable is ControlVariable.VELOCITY:
            order = 1
            if sizes is None or sizes[0] * sizes[1] < 0.0:
                up = min(up, down)
            elif abs(sizes[1]) <= abs(sizes[0]):
                up = down
            first, forward, backward = (-up, up), jerk, jerk
        base = model.unit if order else model.unit_of(variable)
        units = tuple(base + _PER[order + k] for k in range(4))
        whose = f"model {model.name}"
        return cls(whose, _NAMES[variable], units, value, first, forward, backward, third)

    def tightened(self, own: DerivativeLimits) -> "Allowed":
        """Return these limits, tightened by `own`."""
        return Allowed(
            self.whose,
            self.names,
            self.units,
            _common(self.value, own.value),
            _common(self.first, own.first),
            _common(self.forward, own.second),
            _common(self.backward, own.second),
            _common(self.third, own.third),
        )

    def profile_limits(self, *velocities: float) -> ProfileLimits:
        """Return generator limits, widened to boundary velocities that exceed them by rounding."""
        low, high = self.first
        for velocity in velocities:
            if low - slack(low) <= velocity <= high + slack(high):
                low, high = min(low, velocity), max(high, velocity)
        return ProfileLimits.by_direction(
            (low, high), self.forward, self.backward, value=self.value
        )


def _common(one: Range, other: Range | None) -> Range:
    return one if other is None else (max(one[0], other[0]), min(one[1], other[1]))


@final
@frozen
class Violation:
    """One limit that a motion would exceed.

    Attributes:
        quantity: the limited quantity, in words ("velocity", "duration").
        value: the worst value; inf if a lower derivative jumps.
        low, high: the allowed range.
        argument: argument of the worst value [s]; None for a duration.
        unit: unit of the value; "" without a model.
        reason: further details in words, or "".
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
        """The distance of the worst value from the allowed range."""
        return max(self.low - self.value, self.value - self.high)

    def as_error(self, motor: str) -> LimitError:
        """Return the violation as an error of a motor."""
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
@frozen
class Feasibility:
    """The violations of a motion, those of the first derivative first; true if there are none."""

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
    """Return all limits that the motion violates.

    A simple trajectory is generated first: the profile with the smallest violations for its
    boundary conditions. Then this profile, like a complex trajectory or a function of time, is
    examined at its extrema. As elsewhere, 1e-9 of a limit is rounding.

    Args:
        motion: the motion; a function has the time [s] as argument.
        against: a model, or limits.
        variable: the control variable of the motion.
        start: initial value of a relative trajectory.
        interval: the interval of a function; None: its whole domain.

    Raises:
        UnsupportedError: of a simple trajectory: as for `motorhil.motorapi.generation.generate`.
        UsageError: the function has an unbounded domain, or `motion` has the wrong type.
    """
    if isinstance(motion, TrapezoidalTrajectory):
        return Feasibility(tuple(_attempt(motion, against, variable, start)[1]))
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
        raise UsageError(f"{motion!r} is not a trajectory, a Profile or a function of the API")
    low, high = motion.domain if interval is None else interval
    if not (-inf < low < high < inf):
        raise UsageError(f"{motion!r} has no finite beginning and end: give interval=")
    allowed = Allowed.by(against, variable, own)
    return Feasibility(tuple(_of_function(motion, offset, allowed, (low, high))))


def generate(
    trajectory: TrapezoidalTrajectory,
    model: MotorModel,
    *,
    variable: ControlVariable = ControlVariable.POSITION,
    start: float = 0.0,
) -> Profile:
    """Return the absolute profile of a trajectory for a motor with this model.

    The profile is as fast as model and trajectory allow, or has the duration of the trajectory.
    Jerk is not limited: for that see `motorhil.motorapi.generation.jerk_limited`.

    Args:
        trajectory: simple; its second derivatives at the ends, if any, must be 0.
        model: provides the limits that the trajectory does not tighten.
        variable: its control variable, which determines the unit U.
        start: initial value of a relative trajectory [U].

    Raises:
        LimitError: no such motion exists within the limits; names limit, time and amount.
        UnsupportedError: it limits the third derivative, or begins or ends with a second
            derivative.
        UsageError: no limit bounds its speed, or an argument has another type.
    """
    if not isinstance(trajectory, TrapezoidalTrajectory) or not isinstance(model, MotorModel):
        raise UsageError(
            f"generate({trajectory!r}, {model!r}): give a TrapezoidalTrajectory and a "
            "MotorModel; a ComplexTrajectory needs no generation"
        )
    profile, violations = _attempt(trajectory, model, variable, start)
    if profile is not None and not violations:
        return profile
    raise violations[0].as_error(model.name)


def _attempt(
    trajectory: TrapezoidalTrajectory,
    against: MotorModel | DerivativeLimits,
    variable: ControlVariable,
    start: float,
) -> tuple[Profile | None, list[Violation]]:
    """Return the profile of a trajectory, if any, and all limits that it violates.

    Raises:
        UnsupportedError: the request is impossible for a trapezoid.
    """
    _require_trapezoid(trajectory, against)
    initial = start if trajectory.initial is None else trajectory.initial
    final_ = start + trajectory.final if trajectory.is_relative else trajectory.final
    begin, end = trajectory.initial_velocity, trajectory.final_velocity
    sizes = (initial, final_) if not (begin or end) else None
    if isinstance(against, MotorModel):
        against = replace(against, jerk_max=None)  # not used by a trapezoid
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
    """Raise UnsupportedError for limits or boundary derivatives that a trapezoid cannot meet."""
    feature = ""
    if trajectory.limits is not None and trajectory.limits.third is not None:
        feature = "a trapezoidal profile with a limit of the third derivative"
    if any((*trajectory.initial_derivatives[1:], *trajectory.final_derivatives[1:])):
        feature = "a trapezoidal profile that begins or ends with a second derivative"
    if feature:
        raise UnsupportedError(
            motor=against.name if isinstance(against, MotorModel) else "a trapezoid",
            feature=feature,
            supported="that with a limited jerk: motorhil.motorapi.generation.jerk_limited",
        )


def _duration(asked: float, ranges: tuple[Range, ...]) -> tuple[float, Violation | None]:
    """Return the requested duration, or a possible one within rounding, and any violation."""
    for low, high in ranges:
        if low <= asked <= high:
            return asked, None
    nearest = min((end for both in ranges for end in both), key=lambda end: abs(end - asked))
    if abs(nearest - asked) <= ROUNDING * nearest:
        return nearest, None
    low, high = ranges[0]
    if asked < low:
        return asked, Violation(
            "duration", asked, low, high, None, "s", "the limits do not allow a shorter one"
        )
    why = "a longer motion would have to stop, and the distance is too short for that"
    if len(ranges) > 1:
        why += f"; from {ranges[1][0]:g} s on it can move back and return"
    return asked, Violation("duration", asked, low, high, None, "s", why)


def _of_profile(profile: Profile, allowed: Allowed) -> Iterator[Violation]:
    """Yield the worst violation of each limit on each side, found at the ends of pieces."""
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
    """Yield violations of the second derivative, whose range depends on the sign of the first."""
    if allowed.forward == allowed.backward:
        yield from _worst(function, 2, allowed, allowed.forward, [interval])
        return

    forward, backward = _parts_by_direction(function, interval)
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
    """Yield the minimum and maximum over some intervals, if outside the limits."""
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
    """Yield the largest jump of a derivative that the limits of the next one do not allow."""
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
        why = f"{allowed.names[order]} jumps by {worst:g}{unit} there"
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


def _parts_by_direction(function: "Function", interval: Range) -> tuple[list[Range], list[Range]]:
    """Return the parts of the interval where the first derivative may be > 0, and < 0.

    The result is exact for (piecewise) polynomials. For other functions a part between two breaks
    with both signs is listed twice.
    """
    from motorhil.motorapi.functions.piecewise import Piecewise
    from motorhil.motorapi.functions.polynomial import Polynomial
    from motorhil.motorapi.functions.polynomial_math import candidates

    low, high = interval
    pieces = (
        function.within(low, high) if isinstance(function, Piecewise) else [(function, low, high)]
    )
    slope = function.derivative()
    forward: list[Range] = []
    backward: list[Range] = []
    for piece, first, last in pieces:
        exact = isinstance(piece, Polynomial)
        if isinstance(piece, Polynomial):
            about = piece.about
            turns = candidates(piece.coefficients, first - about, last - about)
            inner = [about + turn for turn in turns if first < about + turn < last]
        else:
            inner = list(piece.breaks_between(first, last))
        for begin, end in pairwise([first, *inner, last]):
            if not begin < end:
                continue
            middle = slope.value(0.5 * (begin + end))
            lowest, highest = (middle, middle) if exact else slope.bounds(begin, end)
            # The right end of a part belongs to the next part.
            part = (begin, end if end == high else nextafter(end, begin))
            if highest > 0.0:
                forward.append(part)
            if lowest < 0.0:
                backward.append(part)
    return forward, backward
