"""From what was asked for to what shall be done: one command, one model, one resolved motion.

Pure functions. Whatever a limit forbids is found here, before anything is sent; a value may exceed
its limit by rounding (1e-9 of it), no more. `motor` is a name, for messages.
"""

from dataclasses import dataclass, replace
from math import inf, isfinite
from typing import Final, final

from motorapi.commands import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    Motion,
    Range,
    Setpoint,
    as_number,
)
from motorapi.errors import LimitError, StateError, UnsupportedError, UsageError
from motorapi.generation import shortest, stretched
from motorapi.model import MotorModel
from motorapi.trajectory import TrapezoidalTrajectory

_ROUNDING: Final = 1e-9


@final
@dataclass(frozen=True, slots=True)
class Bounds:
    """Sizes that one motion in one direction must not exceed."""

    velocity: float
    acceleration: float
    deceleration: float


def check_setpoint(
    motor: str, model: MotorModel, variable: ControlVariable, setpoint: Setpoint
) -> None:
    """What can be said of a set-point before it is known where the motor is.

    Raises:
        LimitError: the target, or a limit that goes with it, exceeds the model's.
        UsageError: it is not a finite number.
        UnsupportedError: a relative target of something else than position.
    """
    if not isfinite(as_number(setpoint.value)):
        raise UsageError(f"{motor}: set-point {setpoint.value!r} is not a finite number")
    if not isinstance(setpoint.limits, DerivativeLimits | None):
        raise UsageError(f"{motor}: limits are DerivativeLimits, not {setpoint.limits!r}")
    if setpoint.relative and variable is not ControlVariable.POSITION:
        raise UnsupportedError(
            motor=motor,
            feature=f"a relative {variable.value} set-point",
            supported="relative position set-points",
        )
    if not setpoint.relative:
        _check_target(motor, model, variable, setpoint.value, setpoint.limits)
    _check_bounds(motor, model, variable, setpoint.limits)


def plan_setpoint(
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    setpoint: Setpoint,
    reference: float,
) -> Motion:
    """The motion that a set-point asks for, from `reference` [U], the position held now.

    Raises:
        LimitError: the target lies outside the limits.
    """
    target = setpoint.value + (reference if setpoint.relative else 0.0)
    _check_target(motor, model, variable, target, setpoint.limits)
    slope = inf
    if variable is ControlVariable.POSITION:
        limits = _bounds(model, setpoint.limits, target - reference)
    elif variable is ControlVariable.VELOCITY:
        limits = _velocity_bounds(model, setpoint.limits, target)
    else:
        limits = _bounds(model, None, 1.0)
        if setpoint.limits is not None and setpoint.limits.first is not None:
            slope = min(-setpoint.limits.first[0], setpoint.limits.first[1])
    return Motion(
        mode=ControlMode.SETPOINT,
        variable=variable,
        start=reference,
        target=target,
        velocity=limits.velocity,
        acceleration=limits.acceleration,
        deceleration=limits.deceleration,
        slope=slope,
    )


def check_trajectory(
    motor: str, model: MotorModel, variable: ControlVariable, trajectory: TrapezoidalTrajectory
) -> None:
    """What can be said of a trajectory before it is known where the motor is.

    Raises:
        LimitError: boundary values, limits or duration are beyond what the motor can do.
        UsageError: it is no trajectory.
        UnsupportedError: the control variable is not position.
    """
    if not isinstance(trajectory, TrapezoidalTrajectory):
        raise UsageError(f"{motor}: {trajectory!r} is no trajectory; give a TrapezoidalTrajectory")
    if variable is not ControlVariable.POSITION:
        raise UnsupportedError(
            motor=motor,
            feature=f"a trapezoidal trajectory of {variable.value}",
            supported="trapezoidal trajectories of position",
        )
    _check_bounds(motor, model, variable, trajectory.limits)
    plan_trajectory(motor, model, trajectory, trajectory.initial or 0.0, only_shape=True)


def plan_trajectory(
    motor: str,
    model: MotorModel,
    trajectory: TrapezoidalTrajectory,
    reference: float,
    *,
    only_shape: bool = False,
) -> Motion:
    """The motion that a trajectory asks for, from `reference` [U], the position held now.

    Args:
        motor: its name.
        model: its model.
        trajectory: of position.
        reference: where it starts.
        only_shape: a relative one is not held against position limits yet.

    Raises:
        LimitError: it leaves the position limits, or cannot be made in its duration.
        StateError: it is absolute and the motor is not at its initial value.
    """
    start = reference
    target = reference + trajectory.final
    if trajectory.initial is not None:
        start, target = trajectory.initial, trajectory.final
        if abs(start - reference) > model.start_tolerance:
            raise StateError(
                motor=motor,
                operation="start",
                state=f"the trajectory begins at {start:g} {model.unit}, the motor is at"
                f" {reference:g} {model.unit}",
                remedy="move there first, or leave out initial= for a distance",
            )
    if not (only_shape and trajectory.is_relative):
        for value in (start, target):
            _check_target(motor, model, ControlVariable.POSITION, value, trajectory.limits)
    distance = target - start if trajectory.initial is not None else trajectory.final
    limits = _bounds(model, trajectory.limits, distance)
    motion = Motion(
        mode=ControlMode.TRAJECTORY,
        variable=ControlVariable.POSITION,
        start=start,
        target=target,
        velocity=limits.velocity,
        acceleration=limits.acceleration,
        deceleration=limits.deceleration,
        trajectory=trajectory,
    )
    fastest_s = duration_of(motion)
    if trajectory.duration_s is None:
        return replace(motion, duration_s=fastest_s)
    if trajectory.duration_s < fastest_s * (1.0 - _ROUNDING):
        raise LimitError(
            motor=motor,
            quantity="duration",
            value=trajectory.duration_s,
            low=fastest_s,
            high=None,
            unit="s",
            reason=f"for {distance:g} {model.unit} within the limits",
        )
    return stretch(motion, trajectory.duration_s)


def duration_of(motion: Motion) -> float:
    """How long a profile takes over the motion's distance, as fast as its limits allow [s]."""
    profile = shortest(motion.distance, motion.velocity, motion.acceleration, motion.deceleration)
    return profile.duration_s


def stretch(motion: Motion, duration_s: float) -> Motion:
    """The same way with the same ramps in `duration_s` [s], which is no shorter than possible.

    A motion without a way stays as it is: it is over at once, whatever the duration.
    """
    if motion.distance == 0.0:
        return replace(motion, duration_s=0.0)
    profile = stretched(motion.distance, duration_s, motion.acceleration, motion.deceleration)
    return replace(
        motion, velocity=min(profile.peak, motion.velocity), duration_s=profile.duration_s
    )


def _bounds(model: MotorModel, limits: DerivativeLimits | None, direction: float) -> Bounds:
    """What holds for a motion of position in this direction: the tighter of model and command."""
    velocity, up, down = model.velocity_max, model.acceleration_max, model.deceleration
    if limits is not None:
        if limits.first is not None:
            velocity = min(velocity, _towards(limits.first, direction))
        if limits.second is not None:
            up = min(up, _towards(limits.second, direction))
            down = min(down, _towards(limits.second, -direction))
    return Bounds(velocity, up, down)


def _velocity_bounds(model: MotorModel, limits: DerivativeLimits | None, target: float) -> Bounds:
    """What holds for a motion of velocity; slowing to 0 may be from either side."""
    up, down = model.acceleration_max, model.deceleration
    if limits is not None and limits.first is not None:
        if target == 0.0:
            smaller = min(-limits.first[0], limits.first[1])
            up, down = min(up, smaller), min(down, smaller)
        else:
            up = min(up, _towards(limits.first, target))
            down = min(down, _towards(limits.first, -target))
    return Bounds(model.velocity_max, up, down)


def _towards(limit: Range, direction: float) -> float:
    return limit[1] if direction >= 0.0 else -limit[0]


def _check_target(
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    target: float,
    limits: DerivativeLimits | None,
) -> None:
    low: float | None
    high: float | None
    if variable is ControlVariable.POSITION:
        low, high = model.position_min, model.position_max
    else:
        high = {
            ControlVariable.VELOCITY: model.velocity_max,
            ControlVariable.TORQUE: model.torque_max,
            ControlVariable.CURRENT: model.current_max,
        }[variable]
        low = None if high is None else -high
    own = None if limits is None else limits.value
    for floor, ceiling, whose in (
        (low, high, f"model {model.name}"),
        (own[0] if own else None, own[1] if own else None, "the command's own limits"),
    ):
        below = floor is not None and target < floor - _slack(floor)
        above = ceiling is not None and target > ceiling + _slack(ceiling)
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


def _check_bounds(
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
        if isfinite(value) and abs(value) > top + _slack(top):
            raise LimitError(
                motor=motor,
                quantity=quantity,
                value=value,
                low=-top,
                high=top,
                unit=model.unit + per,
                reason=f"model {model.name}",
            )


def _slack(limit: float) -> float:
    return _ROUNDING * max(1.0, abs(limit))
