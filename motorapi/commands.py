"""Motor commands: control mode, control variable, limits, and the resolved motion.

Source: the CLARAty motor interface (Pivtoraiko, Nesnas, Nayar), 3.3 and Figure 4. U is the unit of
position of the motor: rad for a rotary motor, m for a linear one.
"""

from dataclasses import dataclass
from enum import Enum
from math import inf, isfinite, isnan, nan
from numbers import Real
from typing import TYPE_CHECKING, TypeGuard, final

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.reprs import given

if TYPE_CHECKING:
    from motorhil.motorapi.functions.base import Function
    from motorhil.motorapi.trajectory import Argument, Trajectory

Range = tuple[float, float]
"""(lowest, highest) allowed value; -inf or inf for a side without a limit."""


@final
class ControlMode(Enum):
    """The form of a command: a target value, or a profile to follow."""

    SETPOINT = "setpoint"
    TRAJECTORY = "trajectory"


@final
class ControlVariable(Enum):
    """The commanded quantity."""

    POSITION = "position"  # [U]
    VELOCITY = "velocity"  # [U/s]
    TORQUE = "torque"  # [N·m]; force [N] for a linear motor
    CURRENT = "current"  # [A]


@final
@dataclass(frozen=True, slots=True, init=False, repr=False)
class DerivativeLimits:
    """Allowed ranges of a control variable and its derivatives; None: the limit of the model.

    A single number x stands for the range (-x, x). With position as the control variable `first`
    limits velocity [U/s], `second` acceleration [U/s²]; with velocity `first` limits acceleration.

    Raises:
        UsageError: a range is empty, or does not contain 0, so that the motor could not rest.
    """

    value: Range | None
    first: Range | None
    second: Range | None
    third: Range | None

    def __repr__(self) -> str:
        set_here = ((name, getattr(self, name)) for name in self.__slots__)
        limits = ", ".join(f"{name}={limit}" for name, limit in set_here if limit is not None)
        return f"DerivativeLimits({limits})"

    def __init__(
        self,
        *,
        value: Range | None = None,
        first: Range | float | None = None,
        second: Range | float | None = None,
        third: Range | float | None = None,
    ) -> None:
        if value is not None:
            if not _is_pair(value):
                raise UsageError(f"the range of the value, {value!r}, is not a pair of numbers")
            value = (as_number(value[0]), as_number(value[1]))
            if not value[0] <= value[1]:
                raise UsageError(f"the range of the value, {value}, is empty")
        object.__setattr__(self, "value", value)
        object.__setattr__(self, "first", _around_zero("first", first))
        object.__setattr__(self, "second", _around_zero("second", second))
        object.__setattr__(self, "third", _around_zero("third", third))


def _around_zero(name: str, limit: object) -> Range | None:
    if limit is None:
        return None
    if isinstance(limit, Real):
        size = as_number(limit)
        limit = (-size, size)
    if not _is_pair(limit):
        raise UsageError(
            f"the range of the {name} derivative, {limit!r}, is not a number or a pair of numbers"
        )
    low, high = as_number(limit[0]), as_number(limit[1])
    if isnan(low) or isnan(high) or not low < 0 < high:
        raise UsageError(
            f"the range of the {name} derivative, ({low:g}, {high:g}), must contain 0 in its "
            "interior: a motor begins and ends at rest"
        )
    return (float(low), float(high))


def _is_pair(limit: object) -> TypeGuard[Range]:
    if not isinstance(limit, tuple) or len(limit) != 2:
        return False
    return all(isinstance(bound, Real) for bound in limit)


def as_number(value: object) -> float:
    """Return `value` as a float; nan if it is not a number, inf or -inf if it is too large."""
    if not isinstance(value, Real):
        return nan
    try:
        return float(value)
    except OverflowError:
        return inf if abs(value) == value else -inf


@final
@dataclass(frozen=True, slots=True, repr=False)
class Setpoint:
    """A target value that the motor tries to reach, without a prescribed profile."""

    value: float
    relative: bool = False
    limits: DerivativeLimits | None = None

    def __repr__(self) -> str:
        return given(self)


@final
@dataclass(frozen=True, slots=True, repr=False)
class Motion:
    """One resolved command for an adaptation: absolute, signed, SI units, within the limits.

    The hooks receive it. For position, `start` is the reference position that the motor holds now
    and `target` the absolute position at the end; `velocity`, `acceleration` and `deceleration` are
    magnitudes > 0 that the motion must not exceed. For velocity, `target` is the velocity;
    acceleration applies while its magnitude grows and deceleration while it shrinks. A velocity
    trajectory goes from `start` to `target` at a constant rate, and both fields hold this rate. For
    torque and current, `slope` is the steepest change [N·m/s or A/s]. For set-points of position
    and velocity, `slope` is the tighter side of the requested range (inf: no request).

    A trajectory is prescribed at every instant: by the numbers above, or by `function` if there is
    one. `demand_of` returns either as one object to be sampled.
    """

    mode: ControlMode
    variable: ControlVariable
    start: float
    target: float
    velocity: float
    acceleration: float
    deceleration: float
    slope: float = inf
    duration_s: float | None = None
    """The duration of a trajectory [s]; None for set-points and for arguments other than time."""
    trajectory: "Trajectory | None" = None
    """The requested trajectory, or None for a set-point."""
    function: "Function | None" = None
    """The profile, if not in closed form: to be followed from `interval[0]` to `interval[1]`."""
    offset: float = 0.0
    """The offset added to the values of the function."""
    interval: Range = (0.0, 0.0)
    """(initial, final) argument of the function."""
    argument: "Argument | None" = None
    """The argument of the function; None: time, from `interval[0]` at the start [s]."""
    stop_deceleration: float | None = None
    """The deceleration of a stop during the motion [U/s²]; None: `deceleration`."""

    def __repr__(self) -> str:
        text = f"<Motion {self.mode.value} of {self.variable.value}"
        if self.function is not None:
            over = "time" if self.argument is None else f"the {self.argument.name}"
            low, high = self.interval
            return f"{text}: {self.function!r} of {over} from {low:g} to {high:g}>"
        text += f": {self.start:g} to {self.target:g}"
        if self.duration_s is not None:
            text += f" in {self.duration_s:g} s"
        if self.variable is ControlVariable.POSITION:
            text += f", velocity up to {self.velocity:g}"
        if self.variable in (ControlVariable.POSITION, ControlVariable.VELOCITY):
            text += f", acceleration {self.acceleration:g}, deceleration {self.deceleration:g}"
        elif isfinite(self.slope):
            text += f", {self.slope:g} per s"
        return f"{text}>"

    @property
    def distance(self) -> float:
        """The signed change from start to target: for position [U], else in the variable's unit."""
        return self.target - self.start
