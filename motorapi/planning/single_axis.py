"""Planning of motions: a command and a model give one resolved motion.

Pure functions. Every violation of a limit is found here, before anything is sent. A value may
exceed its limit by rounding only (1e-9 of it). `motor` is a name for messages.
"""

from dataclasses import replace
from math import inf, isfinite
from typing import TYPE_CHECKING, final

from motorhil.frozen import frozen
from motorhil.motorapi.commands import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    Range,
    Setpoint,
    as_number,
)
from motorhil.motorapi.errors import LimitError, UnsupportedError, UsageError
from motorhil.motorapi.generation import shortest, stretched
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.planning import functions
from motorhil.motorapi.planning.limits import ROUNDING, check_bounds, check_target
from motorhil.motorapi.trajectory import (
    ComplexTrajectory,
    Trajectory,
    TrapezoidalTrajectory,
    has_moving_ends,
)

if TYPE_CHECKING:
    from motorhil.motorapi.trajectory import Argument


@final
@frozen
class Bounds:
    """Maximum magnitudes of one motion in one direction."""

    velocity: float
    acceleration: float
    deceleration: float


def check_setpoint(
    motor: str, model: MotorModel, variable: ControlVariable, setpoint: Setpoint
) -> None:
    """Check a set-point as far as possible without the position of the motor.

    Raises:
        LimitError: the target, or one of its limits, exceeds that of the model.
        UsageError: it is not a finite number.
        UnsupportedError: a relative target of a variable other than position.
    """
    if not isfinite(as_number(setpoint.value)):
        raise UsageError(f"{motor}: set-point {setpoint.value!r} is not a finite number")
    if not isinstance(setpoint.relative, bool):
        raise UsageError(f"{motor}: relative is {setpoint.relative!r}; expected True or False")
    if not isinstance(setpoint.limits, DerivativeLimits | None):
        raise UsageError(
            f"{motor}: limits is {setpoint.limits!r}; expected DerivativeLimits or None"
        )
    if setpoint.relative and variable is not ControlVariable.POSITION:
        raise UnsupportedError(
            motor=motor,
            feature=f"a relative {variable.value} set-point",
            supported="relative position set-points",
        )
    if not setpoint.relative:
        check_target(motor, model, variable, setpoint.value, setpoint.limits)
    check_bounds(motor, model, variable, setpoint.limits, smooth=False)


def plan_setpoint(
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    setpoint: Setpoint,
    reference: float,
) -> Motion:
    """Return the motion of a set-point, from the reference position [U].

    Raises:
        LimitError: the target lies outside the limits.
    """
    target = setpoint.value + (reference if setpoint.relative else 0.0)
    check_target(motor, model, variable, target, setpoint.limits)
    first = None if setpoint.limits is None else setpoint.limits.first
    slope = inf if first is None else min(-first[0], first[1])
    if variable is ControlVariable.POSITION:
        limits = _bounds(model, setpoint.limits, target - reference)
    elif variable is ControlVariable.VELOCITY:
        limits = _velocity_bounds(model, setpoint.limits, target)
    else:
        limits = _bounds(model, None, 1.0)
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
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    trajectory: Trajectory,
    argument: "Argument | None" = None,
    *,
    limits_jerk: bool = False,
) -> None:
    """Check a trajectory as far as possible without the position of the motor.

    Raises:
        LimitError: boundary values, limits or duration exceed the ability of the motor.
        UsageError: `trajectory` is not a trajectory.
        UnsupportedError: no motor can execute it.
    """
    if isinstance(trajectory, ComplexTrajectory):
        check_bounds(motor, model, variable, trajectory.limits, smooth=True)
        functions.check(motor, model, variable, trajectory, argument)
        return
    if not isinstance(trajectory, TrapezoidalTrajectory):
        raise UsageError(
            f"{motor}: {trajectory!r} is not a trajectory; give a TrapezoidalTrajectory or a "
            "ComplexTrajectory"
        )
    if argument is not None:
        raise UnsupportedError(
            motor=motor,
            feature=f"a simple trajectory over the {argument.name}: it is a function of time",
            supported="ComplexTrajectory(function) over any argument",
        )
    if variable is not ControlVariable.POSITION:
        _require_rest_at_ends(motor, model, variable, trajectory)
    check_bounds(motor, model, variable, trajectory.limits, smooth=True)
    reference = 0.0 if trajectory.initial is None else trajectory.initial
    model = functions.model_of_profile(model, limits_jerk=limits_jerk)
    plan_trajectory(motor, model, variable, trajectory, reference, only_shape=True)


def _require_rest_at_ends(
    motor: str, model: MotorModel, variable: ControlVariable, trajectory: TrapezoidalTrajectory
) -> None:
    """Refuse derivatives at the ends of a ramp: they are those of position trajectories."""
    unit = model.unit_of(variable)
    for what, derivatives in (
        ("begins", trajectory.initial_derivatives),
        ("ends", trajectory.final_derivatives),
    ):
        for order, per, value in zip(("first", "second"), ("/s", "/s²"), derivatives, strict=False):
            if value:
                raise UnsupportedError(
                    motor=motor,
                    feature=f"a simple trajectory of {variable.value} that {what} with a {order}"
                    f" derivative of {value:g} {_per(unit, per)}",
                    supported="those of position; of others, with derivatives of 0 at both ends",
                )


def _per(unit: str, per: str) -> str:
    """Return a unit divided by s or s²: that of velocity already contains one s."""
    if unit.endswith("/s"):
        return unit + {"/s": "²", "/s²": "³"}[per]
    return unit + per


def plan_trajectory(
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    trajectory: Trajectory,
    reference: float,
    *,
    argument: "Argument | None" = None,
    velocity: float | None = None,
    only_shape: bool = False,
) -> Motion:
    """Return the motion of a trajectory, from `reference` [U].

    Args:
        motor: its name.
        model: its model; without its jerk limit, if the motor does not apply it by default.
        variable: the control variable of the trajectory.
        trajectory: simple or complex.
        reference: its start: the reference position, or the value of another variable.
        argument: of a complex one; None: time.
        velocity: the present velocity of the motor [U/s], for one with an initial velocity.
        only_shape: do not check a relative one against limits of the value yet.

    Raises:
        LimitError: it leaves the limits of the value, or is impossible in its duration.
        StateError: it is absolute and the motor is not at its initial value.
    """
    if isinstance(trajectory, ComplexTrajectory):
        return functions.plan(motor, model, variable, trajectory, argument, reference)
    start = reference
    target = reference + trajectory.final
    bend = functions.bend_of(model, variable, trajectory)
    if trajectory.initial is not None:
        start, target = trajectory.initial, trajectory.final
        if trajectory.initial_velocity:
            start = reference
            functions.require_near_start(motor, model, trajectory, reference)
        else:
            functions.require_at_start(motor, model, variable, start, reference)
    if not (only_shape and trajectory.is_relative):
        for value, what in ((start, "initial"), (target, "target")):
            check_target(motor, model, variable, value, trajectory.limits, what)
    distance = target - start if trajectory.initial is not None else trajectory.final
    if velocity is not None and trajectory.initial_velocity:
        functions.require_velocity(motor, model, trajectory.initial_velocity, velocity)
    if variable is not ControlVariable.POSITION:
        return _plan_ramp(motor, model, variable, trajectory, (start, target), bend)
    if has_moving_ends(trajectory):
        shape_only = only_shape and trajectory.is_relative
        try:
            return functions.between_states(motor, model, trajectory, start, only_shape=shape_only)
        except ArithmeticError as error:
            raise _not_computed(motor, trajectory) from error
    limits = _bounds(model, trajectory.limits, distance)
    motion = Motion(
        mode=ControlMode.TRAJECTORY,
        variable=variable,
        start=start,
        target=target,
        velocity=limits.velocity,
        acceleration=limits.acceleration,
        deceleration=limits.deceleration,
        trajectory=trajectory,
    )
    return _in_time(motor, motion, trajectory, distance, model.unit, bend)


def _plan_ramp(
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    trajectory: TrapezoidalTrajectory,
    ends: Range,
    bend: float | None,
) -> Motion:
    """Plan a ramp of velocity, torque or current: the steepest allowed, or of a given duration."""
    start, target = ends
    rate = inf
    limits = trajectory.limits
    if limits is not None and limits.first is not None:
        rate = _towards(limits.first, target - start)
    if variable is ControlVariable.VELOCITY:
        rate = min(rate, _velocity_rate(model, start, target))
    motion = Motion(
        mode=ControlMode.TRAJECTORY,
        variable=variable,
        start=start,
        target=target,
        velocity=model.velocity_max,
        acceleration=rate if variable is ControlVariable.VELOCITY else model.acceleration_max,
        deceleration=rate if variable is ControlVariable.VELOCITY else model.deceleration,
        slope=inf if variable is ControlVariable.VELOCITY else rate,
        trajectory=trajectory,
    )
    if rate == inf and trajectory.duration_s is None and start != target:
        raise UsageError(
            f"{motor}: a trajectory of {variable.value} from {start:g} to {target:g} "
            f"{model.unit_of(variable)} takes no time: its rate of change is unlimited; give "
            "duration_s, or limits=DerivativeLimits(first=...)"
        )
    unit = model.unit_of(variable)
    return _in_time(motor, motion, trajectory, target - start, unit, bend)


def _velocity_rate(model: MotorModel, start: float, target: float) -> float:
    """Return the acceleration allowed for the whole way between two velocities."""
    up, down = model.acceleration_max, model.deceleration
    if start * target < 0.0:
        return min(up, down)
    return up if abs(target) > abs(start) else down


def _in_time(
    motor: str,
    motion: Motion,
    trajectory: TrapezoidalTrajectory,
    distance: float,
    unit: str,
    bend: float | None,
) -> Motion:
    """Return the motion with its duration: the shortest, or the requested one."""
    try:
        return _timed(motor, motion, trajectory, distance, unit, bend)
    except ArithmeticError as error:
        raise _not_computed(motor, trajectory) from error


def _not_computed(motor: str, trajectory: TrapezoidalTrajectory) -> UsageError:
    what = f"{motor}: {trajectory!r} cannot be computed"
    return UsageError(f"{what}: one of its numbers is too large or too small")


def _timed(
    motor: str,
    motion: Motion,
    trajectory: TrapezoidalTrajectory,
    distance: float,
    unit: str,
    bend: float | None,
) -> Motion:
    asked_s = trajectory.duration_s
    if bend is not None:
        motion = functions.smoothed(motion, bend)
    fastest_s = duration_of(motion)
    if asked_s is None:
        return replace(motion, duration_s=fastest_s)
    if asked_s < fastest_s * (1.0 - ROUNDING):
        raise LimitError(
            motor=motor,
            quantity="duration",
            value=asked_s,
            low=fastest_s,
            high=None,
            unit="s",
            reason=f"for {distance:g} {unit} within the limits",
        )
    return stretch(motion, asked_s)


def duration_of(motion: Motion) -> float:
    """Return the shortest duration of a trajectory over time within its limits [s]."""
    if motion.function is not None:
        return motion.duration_s or 0.0
    if motion.variable is ControlVariable.POSITION:
        profile = shortest(
            motion.distance, motion.velocity, motion.acceleration, motion.deceleration
        )
        return profile.duration_s
    if motion.distance == 0.0:
        return 0.0
    return abs(motion.distance) / _rate(motion)


def _rate(motion: Motion) -> float:
    if motion.variable is ControlVariable.VELOCITY:
        return min(motion.acceleration, motion.deceleration)
    return motion.slope


def stretch(motion: Motion, duration_s: float) -> Motion:
    """Return the motion with the same ramps in `duration_s` [s], at least its shortest.

    A motion without a distance stays unchanged: it ends at once, whatever the duration.
    """
    if motion.distance == 0.0:
        return replace(motion, duration_s=0.0)
    if motion.function is not None:
        return functions.slowed(motion, duration_s)
    if motion.variable is ControlVariable.POSITION:
        profile = stretched(motion.distance, duration_s, motion.acceleration, motion.deceleration)
        return replace(
            motion, velocity=min(profile.peak, motion.velocity), duration_s=profile.duration_s
        )
    rate = abs(motion.distance) / duration_s
    if motion.variable is ControlVariable.VELOCITY:
        return replace(motion, acceleration=rate, deceleration=rate, duration_s=duration_s)
    return replace(motion, slope=rate, duration_s=duration_s)


def bounds_of(model: MotorModel, motion: Motion) -> Bounds:
    """Return the bounds of model and command for a trajectory of position."""
    limits = None if motion.trajectory is None else motion.trajectory.limits
    return _bounds(model, limits, motion.distance)


def _bounds(model: MotorModel, limits: DerivativeLimits | None, direction: float) -> Bounds:
    """Return the bounds of a position motion in this direction: tighter of model and command."""
    velocity, up, down = model.velocity_max, model.acceleration_max, model.deceleration
    if limits is not None:
        if limits.first is not None:
            velocity = min(velocity, _towards(limits.first, direction))
        if limits.second is not None:
            up = min(up, _towards(limits.second, direction))
            down = min(down, _towards(limits.second, -direction))
    return Bounds(velocity, up, down)


def _velocity_bounds(model: MotorModel, limits: DerivativeLimits | None, target: float) -> Bounds:
    """Return the bounds of a velocity motion; a motion to 0 may begin on either side."""
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
