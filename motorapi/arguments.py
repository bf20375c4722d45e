"""Trajectory arguments other than time.

Source: the paper, 3.3.1: "The argument typically is a value of time, but can be another quantity."
"""

from math import isfinite
from typing import Protocol, final

from motorapi.commands import as_number
from motorapi.errors import LinkError, MotorError, PluginError, UsageError
from motorapi.model import MotorModel
from motorapi.state import Measurement, MotorState


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
