"""Complex trajectories held against the limits: of the value, and of what it does to the motor.

Pure functions. The function says itself where it is extreme (exactly, if it is a polynomial), so a
limit is not missed between two samples. U stands for the unit of the control variable.
"""

from math import inf, nextafter
from typing import TYPE_CHECKING, Final

from motorapi.commands import ControlMode, ControlVariable, DerivativeLimits, Motion, Range
from motorapi.errors import LimitError, StateError, UsageError
from motorapi.limits import check_target, slack, value_range
from motorapi.model import MotorModel
from motorapi.trajectory import ComplexTrajectory

if TYPE_CHECKING:
    from motorapi.arguments import Argument

_STEP_S: Final = 0.01
"""A velocity may step by what the acceleration makes in this time: samples are no smoother."""

_VALUE_STEP_S: Final = 1e-6
"""A position may step by what the velocity makes in this time: rounding, that is."""


def check(
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    trajectory: ComplexTrajectory,
    argument: "Argument | None",
) -> None:
    """What can be said before it is known where the motor is.

    Raises:
        LimitError: a derivative, or an absolute value, leaves the limits; says where.
        UsageError: it steps, or does not begin and end at rest.
    """
    limits = trajectory.limits
    if not trajectory.relative:
        _check_values(motor, model, variable, trajectory, 0.0)
    for order, low, high, quantity in _derivative_ranges(model, variable, limits):
        if argument is None:
            unit = model.unit_of(variable) + ("/s", "/s²", "/s³")[order - 1]
            _check_derivative(motor, trajectory, order, (low, high), (1.0, quantity, unit))
            below = model.unit_of(variable) + ("", "/s", "/s²")[order - 1]
            at_once = _VALUE_STEP_S if variable is ControlVariable.POSITION else _STEP_S
            step = min(-low, high) * (at_once if order == 1 else _STEP_S)
            rests = order == 2 and variable is ControlVariable.POSITION
            _check_steps(motor, trajectory, order - 1, step, below, rests=rests)
        elif order == 1 and argument.rate_max is not None:
            # How fast the rate itself changes is not known, so higher orders cannot be checked.
            size = min(-low, high)
            unit = f"{model.unit_of(variable)}/s while the {argument.name} changes fastest"
            told = (argument.rate_max, quantity, unit)
            _check_derivative(motor, trajectory, order, (-size, size), told)


def plan(
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    trajectory: ComplexTrajectory,
    argument: "Argument | None",
    reference: float,
) -> Motion:
    """The motion, from `reference` [U]. It begins where the argument is now.

    Raises:
        LimitError: the value leaves the limits from here.
        StateError: it is absolute and the motor is not where it begins.
        MotorError: the argument cannot be told.
    """
    low, high = trajectory.interval
    function = trajectory.function
    begins = low if argument is None else min(max(argument.value(), low), high)
    first, last = function.value(begins), function.value(high)
    offset = reference - first if trajectory.relative else 0.0
    if trajectory.relative:
        _check_values(motor, model, variable, trajectory, offset)
    else:
        require_at_start(motor, model, variable, first, reference)
    return Motion(
        mode=ControlMode.TRAJECTORY,
        variable=variable,
        start=first + offset,
        target=last + offset,
        velocity=model.velocity_max,
        acceleration=model.acceleration_max,
        deceleration=model.deceleration,
        duration_s=high - low if argument is None else None,
        trajectory=trajectory,
        function=function,
        offset=offset,
        interval=(low, high),
        argument=argument,
    )


def require_at_start(
    motor: str, model: MotorModel, variable: ControlVariable, start: float, reference: float
) -> None:
    """The motor is where an absolute trajectory begins.

    Raises:
        StateError: it is not.
    """
    if variable is ControlVariable.POSITION:
        tolerance = model.start_tolerance
    elif variable is ControlVariable.VELOCITY:
        tolerance = model.acceleration_max * _STEP_S
    else:
        return  # torque and current may step
    if abs(start - reference) > tolerance:
        unit = model.unit_of(variable)
        raise StateError(
            motor=motor,
            operation="start",
            state=f"the trajectory begins at {start:g} {unit}, the motor is at"
            f" {reference:g} {unit}",
            remedy="move there first, or make it relative (leave out initial=, or relative=True)",
        )


def _derivative_ranges(
    model: MotorModel, variable: ControlVariable, limits: DerivativeLimits | None
) -> list[tuple[int, float, float, str]]:
    """(order, lowest, highest, name) of what is limited, by time."""
    own = (None, None, None) if limits is None else (limits.first, limits.second, limits.third)
    speed = model.velocity_max
    change = min(model.acceleration_max, model.deceleration)
    jerk = inf if model.jerk_max is None else model.jerk_max
    by_model: list[tuple[float, str]] = []
    if variable is ControlVariable.POSITION:
        by_model = [(speed, "velocity"), (change, "acceleration"), (jerk, "jerk")]
    elif variable is ControlVariable.VELOCITY:
        by_model = [(change, "acceleration"), (jerk, "jerk")]
    else:
        by_model = [(inf, f"slope of {variable.value}")]
    ranges: list[tuple[int, float, float, str]] = []
    for place, (bound, name) in enumerate(by_model):
        low, high = own[place] or (-inf, inf)
        low, high = max(low, -bound), min(high, bound)
        if low > -inf or high < inf:
            ranges.append((place + 1, low, high, name))
    return ranges


def _check_values(
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    trajectory: ComplexTrajectory,
    offset: float,
) -> None:
    own = None if trajectory.limits is None else trajectory.limits.value
    if value_range(model, variable) == (None, None) and own is None:
        return
    found = trajectory.function.extrema(*trajectory.interval)
    for value in (found.minimum, found.maximum):
        check_target(motor, model, variable, value + offset, trajectory.limits)


def _check_derivative(
    motor: str,
    trajectory: ComplexTrajectory,
    order: int,
    allowed: Range,
    told: tuple[float, str, str],
) -> None:
    rate, quantity, unit = told
    low, high = allowed
    found = trajectory.function.derivative(order).extrema(*trajectory.interval)
    for value, where in (
        (found.minimum * rate, found.at_minimum),
        (found.maximum * rate, found.at_maximum),
    ):
        if value < low - slack(low) or value > high + slack(high):
            raise LimitError(
                motor=motor,
                quantity=f"{quantity} of the trajectory",
                value=value,
                low=None if low == -inf else low,
                high=None if high == inf else high,
                unit=unit,
                reason=f"at argument {where:g}",
            )


def _check_steps(
    motor: str,
    trajectory: ComplexTrajectory,
    order: int,
    allowed: float,
    unit: str,
    *,
    rests: bool,
) -> None:
    """No step of a derivative that would need more of the next one than there is.

    Steps are where pieces meet; and at both ends, if the motor `rests` there.
    """
    low, high = trajectory.interval
    function = trajectory.function.derivative(order)
    steps = [
        (where, function.value(where) - function.value(nextafter(where, -inf)))
        for where in function.breaks_between(low, high)
        if low < where < high
    ]
    if rests:
        steps += [(low, function.value(low)), (high, -function.value(high))]
    for where, step in steps:
        if abs(step) > allowed:
            raise UsageError(
                f"{motor}: the trajectory steps by {step:g} {unit} at argument {where:g}"
                f"{' (the motor is at rest there)' if where in (low, high) else ''}, allowed is"
                f" {allowed:g} {unit}; join it smoothly, or begin and end where its derivative is 0"
            )
