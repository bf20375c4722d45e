"""Rounding to what the registers of a polled drive hold, so that no limit is exceeded."""

from math import floor
from typing import TYPE_CHECKING, Final

from motorapi.errors import LimitError, UsageError
from motorapi.model import MotionKind

if TYPE_CHECKING:
    from motorapi.model import MotorModel

_ROUNDING: Final = 1e-9
"""So much below a whole number is that number: what was rounded before stays as it is."""


def gear(model: "MotorModel") -> float:
    """Motor turns per turn of the output, or per metre.

    Raises:
        UsageError: the model does not say.
    """
    if model.gear_ratio is None:
        key = "motor_turns_per_m" if model.kind is MotionKind.LINEAR else "gear_ratio"
        raise UsageError(
            f"motor model {model.name}: {key} is not given; the drive counts pulses of the motor,"
            f" so add it ({key} = 1.0, if there is no gear)"
        )
    return model.gear_ratio


def toward_zero(value: float) -> int:
    """The whole number next to `value` that is no larger, either way."""
    size = floor(abs(value) + _ROUNDING)
    return size if value > 0 else -size


def check_register(label: str, quantity: str, value: int, high: int, unit: str) -> None:
    """A register of the drive `label` holds `value`.

    Raises:
        LimitError: it is above `high`; says of what, in the drive's own unit.
    """
    if value > high:
        raise LimitError(
            motor=label,
            quantity=quantity,
            value=value,
            low=None,
            high=high,
            unit=unit,
            reason="what the drive's register holds",
        )
