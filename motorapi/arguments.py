"""Arguments that are not time: what a trajectory may be a function of instead.

Source: the paper, 3.3.1: "The argument typically is a value of time, but can be another quantity."
"""

from math import isfinite
from typing import Protocol, final

from motorapi.commands import as_number
from motorapi.errors import LinkError, MotorError, PluginError, UsageError
from motorapi.model import MotorModel
from motorapi.state import Measurement, MotorState


class Argument(Protocol):
    """A quantity that something else determines, read once per set-point."""

    @property
    def name(self) -> str:
        """What messages call it."""

    @property
    def rate_max(self) -> float | None:
        """How fast it can change [1/s]; None: not known, then no limit can be promised."""

    def value(self) -> float:
        """What it is now. Asked from callbacks: must neither wait nor send."""


def require_argument(motor: str, argument: object) -> None:
    """Raises UsageError if it is neither None nor an `Argument`; `motor` is named."""
    if argument is None:
        return
    if (
        isinstance(argument, type)
        or not callable(getattr(argument, "value", None))
        or not (hasattr(argument, "name") and hasattr(argument, "rate_max"))
    ):
        raise UsageError(
            f"{motor}: argument {argument!r} is none; give an Argument, as MotorPosition(other), or"
            " leave it out for time"
        )
    rate = argument.rate_max
    if rate is not None and not as_number(rate) >= 0.0:
        raise UsageError(
            f"{motor}: rate_max of {argument!r} is {rate!r}; a number >= 0, or None if not known"
        )


def value_of(argument: Argument) -> float:
    """What the argument is now, a finite number.

    Raises:
        MotorError: it cannot be told; PluginError of what is no number, or another error.
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
    """What may lead: any Motor."""

    @property
    def name(self) -> str:
        """What messages call it."""

    @property
    def model(self) -> MotorModel:
        """Where its maximum velocity stands."""

    def latest(self) -> Measurement | None:
        """What was heard of it last."""


@final
class MotorPosition:
    """Another motor's measured position [rad or m], as it was heard last: an electronic gear.

    Args:
        motor: the leading motor. It must report its position by itself (or cost nothing to ask).
    """

    def __init__(self, motor: Leader) -> None:
        if not callable(getattr(motor, "latest", None)):
            raise UsageError(f"{motor!r} is no motor: its position cannot be an argument")
        self._motor = motor
        self._name = f"position of {motor.name}"

    @property
    def name(self) -> str:
        """As in "position of left"."""
        return self._name

    @property
    def leader(self) -> Leader:
        """The leading motor."""
        return self._motor

    @property
    def rate_max(self) -> float | None:
        """The leading motor's maximum velocity, as its model says."""
        return self._motor.model.velocity_max

    def value(self) -> float:
        """The last position heard.

        Raises:
            LinkError: the motor is not heard any more: what was is where it is not.
            UsageError: none was heard yet.
        """
        latest = self._motor.latest()
        if latest is not None and latest.state is MotorState.OFFLINE:
            raise LinkError(link=self._motor.name, reason=f"the {self._name} is not heard any more")
        if latest is None or latest.position is None:
            raise UsageError(
                f"the {self._name} is not known: it has not been heard yet; ask for it once"
            )
        return latest.position

    def __repr__(self) -> str:
        return f"<the {self._name}>"
