"""Trajectories as immutable values: the request, without its generation.

A *simple* trajectory states boundary conditions and limits only; a *complex* one gives the value of
the control variable for every argument. "The argument typically is a value of time, but can be
another quantity", as the position of another motor. U is the unit of the control variable: rad or m
for position, rad/s or m/s for velocity.

Source: the paper, 3.3.1.
"""

from dataclasses import field
from math import inf, isfinite
from typing import TYPE_CHECKING, Protocol, TypeAlias, final

from motorhil.frozen import frozen
from motorhil.motorapi.commands import ControlVariable, DerivativeLimits, Range, as_number
from motorhil.motorapi.errors import LinkError, MotorError, PluginError, UsageError
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.state import Measurement, MotorState

if TYPE_CHECKING:
    from motorhil.motorapi.functions.base import Function


@final
@frozen(repr=False)
class TrapezoidalTrajectory:
    """The simplest motion that satisfies its boundary conditions, by default at rest at both ends.

    `TrapezoidalTrajectory(1.0)` is a distance: 1.0 further than the present position.
    `TrapezoidalTrajectory(1.0, initial=0.25)` is absolute: from 0.25 to 1.0, and the motor must be
    at 0.25 at the start.

    With an initial velocity the motor must already move at it, and with a final one it continues at
    it: until the next command or stop, or to rest at a limit of position.

    Args:
        final: the final value [U]; without `initial`, relative to the present one.
        initial: the initial value [U].
        limits: of the value and its derivatives; those of the model by default.
        duration_s: duration [s]; None: as short as the limits allow.
        initial_derivatives: (first, second) at the beginning, [U/s], [U/s²]; missing ones are 0.
        final_derivatives: (first, second) at the end; missing ones are 0. Only trajectories of
            position may have derivatives at their ends, and second ones need a limit of jerk.
        initial_argument: time of the beginning [s], for a part of a longer motion.

    Raises:
        UsageError: a number is not finite, the duration is not > 0, there are more than two
            derivatives, or a boundary value lies outside `limits`.
    """

    final: float
    initial: float | None = None
    limits: DerivativeLimits | None = field(default=None, kw_only=True)
    duration_s: float | None = field(default=None, kw_only=True)
    initial_derivatives: tuple[float, ...] = field(default=(), kw_only=True)
    final_derivatives: tuple[float, ...] = field(default=(), kw_only=True)
    initial_argument: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        for name in ("final", "initial", "duration_s", "initial_argument"):
            value = getattr(self, name)
            if value is None and name in ("initial", "duration_s"):
                continue
            number = as_number(value)
            if not isfinite(number):
                raise UsageError(f"TrapezoidalTrajectory: {name} is {value!r}, not a finite number")
            object.__setattr__(self, name, number)
        if not isinstance(self.limits, DerivativeLimits | None):
            raise UsageError(
                f"TrapezoidalTrajectory: limits is {self.limits!r}, not DerivativeLimits"
            )
        if self.duration_s is not None and self.duration_s <= 0.0:
            raise UsageError(f"TrapezoidalTrajectory: duration_s is {self.duration_s:g}, not > 0")
        for name in ("initial_derivatives", "final_derivatives"):
            object.__setattr__(self, name, _derivatives(name, getattr(self, name)))
        if self.limits is not None:
            self._check_boundaries(self.limits)

    def _check_boundaries(self, limits: DerivativeLimits) -> None:
        values = () if self.initial is None else (self.initial, self.final)
        first = (self.initial_velocity, self.final_velocity)
        second = (self.initial_derivatives[1:], self.final_derivatives[1:])
        for what, given, allowed in (
            ("", values, limits.value),
            ("first derivative ", first, limits.first),
            ("second derivative ", (*second[0], *second[1]), limits.second),
        ):
            for value in given:
                if allowed is not None and not allowed[0] <= value <= allowed[1]:
                    raise UsageError(
                        f"TrapezoidalTrajectory: {what}{value:g} lies outside its own limits of the"
                        f" {what.strip() or 'value'}, {allowed[0]:g} to {allowed[1]:g}"
                    )

    @property
    def is_relative(self) -> bool:
        """True if `final` is relative to the position at the start."""
        return self.initial is None

    @property
    def initial_velocity(self) -> float:
        """The first derivative at the beginning [U/s]."""
        return self.initial_derivatives[0] if self.initial_derivatives else 0.0

    @property
    def final_velocity(self) -> float:
        """The first derivative at the end [U/s]."""
        return self.final_derivatives[0] if self.final_derivatives else 0.0

    @property
    def final_argument(self) -> float | None:
        """The time of the end [s]; None: as soon as the limits allow."""
        return None if self.duration_s is None else self.initial_argument + self.duration_s

    def __repr__(self) -> str:
        if self.initial is None:
            way = f"by {self.final!r}"
        else:
            way = f"from {self.initial!r} to {self.final!r}"
        time = "as fast as allowed" if self.duration_s is None else f"in {self.duration_s!r} s"
        parts = [way, time]
        for what, derivatives in (
            ("initial", self.initial_derivatives),
            ("final", self.final_derivatives),
        ):
            for order, value in zip(("first", "second"), derivatives, strict=False):
                if value:
                    parts.append(f"{what} {order} derivative {value!r}")
        if self.initial_argument:
            parts.append(f"beginning at {self.initial_argument!r} s")
        if self.limits is not None:
            for name, limit in (
                ("value", self.limits.value),
                ("first derivative", self.limits.first),
                ("second derivative", self.limits.second),
                ("third derivative", self.limits.third),
            ):
                if limit is not None:
                    parts.append(f"{name} {_range(limit)}")
        return f"<TrapezoidalTrajectory {', '.join(parts)}>"


def _range(limit: Range) -> str:
    if limit[0] == -limit[1]:
        return f"at most {limit[1]!r}"
    return f"{limit[0]!r} to {limit[1]!r}"


def _derivatives(name: str, given: object) -> tuple[float, ...]:
    if not isinstance(given, tuple | list) or len(given) > 2:
        raise UsageError(
            f"TrapezoidalTrajectory: {name} is {given!r}; give (first,) or (first, second)"
        )
    numbers = tuple(as_number(value) for value in given)
    if not all(isfinite(number) for number in numbers):
        raise UsageError(f"TrapezoidalTrajectory: {name} is {given!r}, not finite numbers")
    return numbers


@final
@frozen(repr=False)
class ComplexTrajectory:
    """A motion with a value prescribed for every argument, by any `Function`.

    `ComplexTrajectory(function)` follows `function(t)` over its domain, t in seconds since the
    start; an argument given to `Motor.set_trajectory` replaces time.

    Args:
        function: the value of the control variable [U] over the argument.
        initial_argument: argument at the beginning; None: the lower end of the domain.
        final_argument: argument at the end; None: the upper end of the domain.
        relative: only the change of the value counts, from the position at the start.
        limits: of the value and its derivatives by time, if tighter than those of the model.

    Raises:
        UsageError: an end is not finite or lies outside the domain, or the interval is empty.
    """

    function: "Function"
    initial_argument: float | None = None
    final_argument: float | None = None
    relative: bool = field(default=False, kw_only=True)
    limits: DerivativeLimits | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        domain = getattr(self.function, "domain", None)
        if not isinstance(domain, tuple) or not callable(getattr(self.function, "extrema", None)):
            raise UsageError(
                f"ComplexTrajectory: {self.function!r} is not a function (see motorapi.functions)"
            )
        if not isinstance(self.relative, bool):
            raise UsageError(
                f"ComplexTrajectory: relative is {self.relative!r}; expected True or False"
            )
        if not isinstance(self.limits, DerivativeLimits | None):
            raise UsageError(f"ComplexTrajectory: limits is {self.limits!r}, not DerivativeLimits")
        for name, end in zip(("initial_argument", "final_argument"), domain, strict=True):
            given = getattr(self, name)
            number = as_number(end if given is None else given)
            if not isfinite(number):
                raise UsageError(
                    f"ComplexTrajectory: {name} is {number if given is None else given!r}:"
                    " the motion needs a finite beginning and end"
                )
            if not domain[0] <= number <= domain[1]:
                raise UsageError(
                    f"ComplexTrajectory: {name} {number:g} lies outside the function's domain,"
                    f" {domain[0]:g} to {domain[1]:g}"
                )
            object.__setattr__(self, name, number)
        if not self.interval[0] < self.interval[1]:
            raise UsageError(
                f"ComplexTrajectory: the interval from {self.interval[0]:g} to "
                f"{self.interval[1]:g} is empty; the final argument must exceed the initial one"
            )

    @property
    def is_relative(self) -> bool:
        """True if values are relative to the position at the start."""
        return self.relative

    @property
    def interval(self) -> Range:
        """(initial, final) argument."""
        low, high = self.initial_argument, self.final_argument
        return (-inf if low is None else low, inf if high is None else high)

    def __repr__(self) -> str:
        low, high = self.interval
        how = ", relative" if self.relative else ""
        tight = "" if self.limits is None else f", {self.limits!r}"
        return f"<ComplexTrajectory {self.function!r} from {low!r} to {high!r}{how}{tight}>"


def has_moving_ends(trajectory: object) -> bool:
    """Return True for a simple trajectory with derivatives other than 0 at an end."""
    return isinstance(trajectory, TrapezoidalTrajectory) and any(
        (*trajectory.initial_derivatives, *trajectory.final_derivatives)
    )


Trajectory: TypeAlias = TrapezoidalTrajectory | ComplexTrajectory
"""Any trajectory that `Motor.set_trajectory` accepts."""


class Argument(Protocol):
    """A trajectory argument that another system determines, read once per set-point."""

    @property
    def name(self) -> str:
        """The name of the argument in messages."""

    @property
    def rate_max(self) -> float | None:
        """The maximum rate of change [1/s], or None if unknown; then no limit is guaranteed."""

    def value(self) -> float:
        """Return the present value. Callbacks call this: it must neither wait nor send."""


def require_argument(motor: str, argument: object) -> None:
    """Raise UsageError for `motor` if `argument` is neither None nor an `Argument`."""
    if argument is None:
        return
    if (
        isinstance(argument, type)
        or not callable(getattr(argument, "value", None))
        or not (hasattr(argument, "name") and hasattr(argument, "rate_max"))
    ):
        raise UsageError(
            f"{motor}: {argument!r} is not an Argument; give an Argument, as "
            "MotorPosition(other), or leave it out for time"
        )
    rate = argument.rate_max
    if rate is not None and not as_number(rate) >= 0.0:
        raise UsageError(
            f"{motor}: rate_max of {argument!r} is {rate!r}; expected a number >= 0, or None "
            "if unknown"
        )


def value_of(argument: Argument) -> float:
    """Return the present value of the argument, a finite number.

    Raises:
        PluginError: the value is not a finite number, or `value` raised a foreign exception.
        MotorError: `value` raised it.
    """
    try:
        value = argument.value()
    except MotorError:
        raise
    except Exception as error:
        what = type(argument).__qualname__
        raise PluginError(plugin=what, where="value", problem=repr(error)) from error
    number = as_number(value)
    if not isfinite(number):
        problem = f"the {argument.name} is {value!r}, not a finite number"
        raise PluginError(plugin=type(argument).__qualname__, where="value", problem=problem)
    return number


class Leader(Protocol):
    """The part of a Motor that `MotorPosition` needs from the leading motor."""

    @property
    def name(self) -> str:
        """The name of the motor in messages."""

    @property
    def model(self) -> MotorModel:
        """The motor model, which holds the maximum velocity."""

    def latest(self) -> Measurement | None:
        """Return the last measurement received from the motor, or None."""


@final
class MotorPosition:
    """The last measured position of another motor [rad or m], for an electronic gear.

    Args:
        motor: the leading motor. It must report its position by itself, or at no cost.
    """

    def __init__(self, motor: Leader) -> None:
        if not callable(getattr(motor, "latest", None)):
            raise UsageError(f"{motor!r} is not a motor: its position cannot be an argument")
        self._motor = motor
        self._name = f"position of {motor.name}"

    @property
    def name(self) -> str:
        """The name of the argument, as in "position of left"."""
        return self._name

    @property
    def leader(self) -> Leader:
        """The leading motor."""
        return self._motor

    @property
    def rate_max(self) -> float | None:
        """The maximum velocity of the leading motor, from its model."""
        return self._motor.model.velocity_max

    def value(self) -> float:
        """Return the last position received from the leading motor.

        Raises:
            LinkError: the motor is offline, so the last position is out of date.
            UsageError: no position has been received yet.
        """
        latest = self._motor.latest()
        if latest is not None and latest.state is MotorState.OFFLINE:
            raise LinkError(
                link=self._motor.name,
                reason=f"the {self._name} is out of date: the motor is offline",
            )
        if latest is None or latest.position is None:
            raise UsageError(
                f"the {self._name} is unknown: none has been received yet; read it once before "
                "the start"
            )
        return latest.position

    def __repr__(self) -> str:
        return f"<the {self._name}>"


def asks_for_smoothness(variable: ControlVariable, trajectory: TrapezoidalTrajectory) -> bool:
    """Return True if its limits exceed those of a position trapezoid, or of a ramp."""
    limits = trajectory.limits
    if limits is None:
        return False
    highest = limits.third if variable is ControlVariable.POSITION else limits.second
    return highest is not None
