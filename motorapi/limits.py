"""Whether a number of a command is within the limits: the model's, and the command's own.

A value may exceed its limit by rounding (1e-9 of it), no more. `motor` is a name, for messages.
"""

from math import inf, isfinite
from typing import Final

from motorapi.commands import ControlVariable, DerivativeLimits, Range
from motorapi.errors import LimitError, UnsupportedError
from motorapi.model import MotorModel

ROUNDING: Final = 1e-9

_SLOPES: Final = ("slope", "change of slope")
_LIMITED: Final = {
    ControlVariable.POSITION: ("velocity", "acceleration", "jerk"),
    ControlVariable.VELOCITY: ("acceleration", "jerk"),
    ControlVariable.TORQUE: _SLOPES,
    ControlVariable.CURRENT: _SLOPES,
}
"""What the derivatives of a control variable are called; the last only trajectories can limit."""


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
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    limits: DerivativeLimits | None,
    *,
    smooth: bool,
) -> None:
    """A command's own limits may be tighter than the model's, never wider.

    Args:
        motor: its name.
        model: its model.
        variable: what is commanded.
        limits: the command's own.
        smooth: whether it is a trajectory, which may limit one derivative more: jerk.

    Raises:
        LimitError: one is wider.
        UnsupportedError: it is of a derivative that nothing can limit.
    """
    if limits is None:
        return
    jerk = inf if model.jerk_max is None else model.jerk_max
    known = _LIMITED[variable]
    tops = {"velocity": model.velocity_max, "jerk": jerk, "slope": inf}
    tops["acceleration"] = max(model.acceleration_max, model.deceleration)
    for place, limit in enumerate((limits.first, limits.second, limits.third)):
        if limit is None:
            continue
        if place >= len(known) - (0 if smooth else 1):
            supported = known if smooth else known[:-1]
            raise UnsupportedError(
                motor=motor,
                feature=f"a limit on derivative {place + 1} of {variable.value}",
                supported=f"limits on {' and '.join(supported)}",
            )
        if known[place] in tops:
            per = ("/s", "/s²", "/s³")[place + (variable is ControlVariable.VELOCITY)]
            _check_range(motor, model, f"{known[place]} limit", limit, tops[known[place]], per)


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
