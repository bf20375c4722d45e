"""Rounding to the registers of a polled drive, without exceeding a limit."""

from math import floor
from typing import TYPE_CHECKING, Final

from motorapi.errors import LimitError, UsageError
from motorapi.model import MotionKind

if TYPE_CHECKING:
    from motorapi.model import MotorModel

_ROUNDING: Final = 1e-9
"""The tolerance below an integer that counts as the integer, so that rounding twice changes
nothing.
"""


def gear(model: "MotorModel") -> float:
    """Return the motor turns per turn of the output, or per metre.

    Raises:
        UsageError: the model does not define them.
    """
    if model.gear_ratio is None:
        key = "motor_turns_per_m" if model.kind is MotionKind.LINEAR else "gear_ratio"
        raise UsageError(
            f"motor model {model.name}: {key} is not given; the drive counts pulses of the motor,"
            f" so add it ({key} = 1.0, if there is no gear)"
        )
    return model.gear_ratio


def toward_zero(value: float) -> int:
    """Return the nearest integer towards 0."""
    size = floor(abs(value) + _ROUNDING)
    return size if value > 0 else -size


def check_register(label: str, quantity: str, value: int, high: int, unit: str) -> None:
    """Check that a register of the drive `label` can hold `value`.

    Raises:
        LimitError: the value is above `high`; the message gives the quantity in the drive's unit.
    """
    if value > high:
        raise LimitError(
            motor=label,
            quantity=quantity,
            value=value,
            low=None,
            high=high,
            unit=unit,
            reason="the range of the drive's register",
        )
