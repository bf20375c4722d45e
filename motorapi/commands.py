"""Motor commands: control mode, control variable, limits and set-points.

Source: the CLARAty motor interface (Pivtoraiko, Nesnas, Nayar), 3.3 and Figure 4. U is the unit of
position of the motor: rad for a rotary motor, m for a linear one.
"""

from dataclasses import MISSING, dataclass, fields
from enum import Enum
from math import inf, isnan, nan
from numbers import Real
from typing import Any, TypeGuard, final

from motorhil.frozen import frozen
from motorhil.motorapi.errors import UsageError

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


def given(value: Any) -> str:
    """Return the call that creates this dataclass, without default arguments."""
    arguments = []
    for field in fields(value):
        held = getattr(value, field.name)
        if field.default is MISSING or held != field.default:
            shown = f"{type(held).__name__}.{held.name}" if isinstance(held, Enum) else repr(held)
            arguments.append(f"{field.name}={shown}")
    return f"{type(value).__name__}({', '.join(arguments)})"


@final
@frozen(repr=False)
class Setpoint:
    """A target value that the motor tries to reach, without a prescribed profile."""

    value: float
    relative: bool = False
    limits: DerivativeLimits | None = None

    def __repr__(self) -> str:
        return given(self)
