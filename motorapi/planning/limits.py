"""Check of command values against the limits of model and command.

A value may exceed its limit by rounding only (1e-9 of it). `motor` is a name for messages.
"""

from math import inf, isfinite
from typing import Final

from motorhil.motorapi.commands import ControlVariable, DerivativeLimits, Range
from motorhil.motorapi.errors import LimitError, UnsupportedError
from motorhil.motorapi.model import MotorModel

ROUNDING: Final = 1e-9

_SLOPES: Final = ("slope", "change of slope")
_LIMITED: Final = {
    ControlVariable.POSITION: ("velocity", "acceleration", "jerk"),
    ControlVariable.VELOCITY: ("acceleration", "jerk"),
    ControlVariable.TORQUE: _SLOPES,
    ControlVariable.CURRENT: _SLOPES,
}
"""Names of the derivatives of a control variable; only trajectories can limit the last one."""


def check_target(
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    target: float,
    limits: DerivativeLimits | None,
    what: str = "target",
) -> None:
    """Raise LimitError if the control variable must not have this value; `what` names it."""
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
                quantity=f"{what} {variable.value}",
                value=target,
                low=floor,
                high=ceiling,
                unit=model.unit_of(variable),
                reason=whose,
            )


def value_range(model: MotorModel, variable: ControlVariable) -> tuple[float | None, float | None]:
    """Return the (lowest, highest) value that the model allows; None: no limit on that side."""
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
    """Check that the limits of a command are not wider than those of the model.

    Args:
        motor: its name.
        model: its model.
        variable: the control variable.
        limits: the limits of the command.
        smooth: True for a trajectory, which may limit one more derivative: jerk.

    Raises:
        LimitError: a limit is wider.
        UnsupportedError: the limited derivative cannot be limited.
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
    """Return the permitted rounding error for a limit of this size."""
    return ROUNDING * max(1.0, abs(limit))
