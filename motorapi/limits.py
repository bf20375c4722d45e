"""Whether a number of a command is within the limits: the model's, and the command's own.

A value may exceed its limit by rounding (1e-9 of it), no more. `motor` is a name, for messages.
"""

from math import isfinite
from typing import Final

from motorapi.commands import ControlVariable, DerivativeLimits, Range
from motorapi.errors import LimitError, UnsupportedError
from motorapi.model import MotorModel

ROUNDING: Final = 1e-9


def check_target(
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    target: float,
    limits: DerivativeLimits | None,
) -> None:
    """Raises LimitError if the control variable must not have this value."""
    low, high = value_range(model, variable)
    own = None if limits is None else limits.value
    for floor, ceiling, whose in (
        (low, high, f"model {model.name}"),
        (own[0] if own else None, own[1] if own else None, "the command's own limits"),
    ):
        below = floor is not None and target < floor - slack(floor)
        above = ceiling is not None and target > ceiling + slack(ceiling)
        if below or above:
            raise LimitError(
                motor=motor,
                quantity=f"target {variable.value}",
                value=target,
                low=floor,
                high=ceiling,
                unit=model.unit_of(variable),
                reason=whose,
            )


def value_range(model: MotorModel, variable: ControlVariable) -> tuple[float | None, float | None]:
    """(lowest, highest) value that the model allows; None: no limit on that side."""
    if variable is ControlVariable.POSITION:
        return model.position_min, model.position_max
    high = {
        ControlVariable.VELOCITY: model.velocity_max,
        ControlVariable.TORQUE: model.torque_max,
        ControlVariable.CURRENT: model.current_max,
    }[variable]
    return (None if high is None else -high), high


def check_bounds(
    motor: str, model: MotorModel, variable: ControlVariable, limits: DerivativeLimits | None
) -> None:
    """A command's own limits may be tighter than the model's, never wider."""
    if limits is None:
        return
    derivatives = [limits.first, limits.second, limits.third]
    if variable is ControlVariable.POSITION:
        top = model.velocity_max
        _check_range(motor, model, "velocity limit", derivatives.pop(0), top, "/s")
    if variable in (ControlVariable.POSITION, ControlVariable.VELOCITY):
        top = max(model.acceleration_max, model.deceleration)
        _check_range(motor, model, "acceleration limit", derivatives.pop(0), top, "/s²")
    else:
        derivatives.pop(0)  # the slope: no model knows a limit
    if any(limit is not None for limit in derivatives):
        raise UnsupportedError(
            motor=motor,
            feature=f"limits on that high a derivative of {variable.value}",
            supported="limits up to acceleration, or the slope of torque and current",
        )


def _check_range(
    motor: str, model: MotorModel, quantity: str, asked: Range | None, top: float, per: str
) -> None:
    for value in asked or ():
        if isfinite(value) and abs(value) > top + slack(top):
            raise LimitError(
                motor=motor,
                quantity=quantity,
                value=value,
                low=-top,
                high=top,
                unit=model.unit + per,
                reason=f"model {model.name}",
            )


def slack(limit: float) -> float:
    """By how much rounding may exceed a limit of this size."""
    return ROUNDING * max(1.0, abs(limit))
