"""Planning of motions that follow a function.

*Complex trajectories* are checked against value and derivative limits. The function reports its own
extrema (exact for polynomials), so that no violation between two samples is missed. U is the unit
of the control variable.

*Simple trajectories with one more limited derivative* become functions. The paper, 3.3.1: "If
necessary, we can use the same representation to bound the third derivative and represent a smoother
motion." This means position with limited jerk, velocity with limited jerk, and torque with a
limited change of its slope. So every motor that can follow a complex trajectory can follow them.
The jerk_max of the model limits such requests. It is also the limit of a trajectory without one, as
for all other limits, on motors that generate their trajectories on the host (`limits_jerk`).

*Simple trajectories with derivatives at their ends* become functions too. Such a trajectory of
position begins in the state that its initial derivatives say, which the motor must have: it follows
a motion that ended so, or replaces one that moves so now. Its profile is planned again from where
it begins, as the motor has moved on since. After a final velocity the demand continues at it, until
the next command or stop, and comes to rest at a limit of position, if there is one.

Pure functions.
"""

from dataclasses import replace
from math import isinf, sqrt
from typing import TYPE_CHECKING, Final

from motorhil.motorapi.commands import ControlMode, ControlVariable, DerivativeLimits
from motorhil.motorapi.errors import LimitError, StateError, UnsupportedError, UsageError
from motorhil.motorapi.generation import ProfileLimits, jerk_limited, trapezoid
from motorhil.motorapi.generation.feasibility import STEP_S, Allowed, feasible, generate
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.planning.limits import check_target, slack, value_range
from motorhil.motorapi.trajectory import ComplexTrajectory, TrapezoidalTrajectory, value_of

if TYPE_CHECKING:
    from motorhil.motorapi.functions.base import Function
    from motorhil.motorapi.trajectory import Argument

_PASSING_S: Final = 0.1
"""The time [s] for the start of a moving motor, in which it leaves its initial value behind."""


def check(
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    trajectory: ComplexTrajectory,
    argument: "Argument | None",
) -> None:
    """Check a complex trajectory as far as possible without the motor's position.

    Raises:
        LimitError: a derivative or an absolute value leaves the limits, or jumps; the message names
            the place.
        UsageError: it does not begin and end at rest.
    """
    if argument is not None:
        if not trajectory.relative:
            _check_values(motor, model, variable, trajectory, 0.0)
        _check_rate(motor, model, variable, trajectory, argument)
        return
    for violation in feasible(trajectory, model, variable=variable).violations:
        if not (trajectory.relative and violation.quantity == variable.value):
            raise violation.as_error(motor)
    if variable is ControlVariable.POSITION:
        _check_ends(motor, model, trajectory)


def plan(
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    trajectory: ComplexTrajectory,
    argument: "Argument | None",
    reference: float,
) -> Motion:
    """Return the motion from `reference` [U]; it begins at the present value of the argument.

    Raises:
        LimitError: the value leaves the limits from here.
        StateError: the trajectory is absolute and the motor is not at its initial value.
        MotorError: the argument has no value.
    """
    low, high = trajectory.interval
    function = trajectory.function
    begins = low if argument is None else min(max(value_of(argument), low), high)
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
    """Require that the motor is at the initial value of an absolute trajectory.

    Raises:
        StateError: it is not.
    """
    if variable is ControlVariable.POSITION:
        tolerance = model.start_tolerance
    elif variable is ControlVariable.VELOCITY:
        tolerance = model.acceleration_max * STEP_S
    else:
        return  # torque and current may jump
    if abs(start - reference) > tolerance:
        unit = model.unit_of(variable)
        raise StateError(
            motor=motor,
            operation="start",
            state=f"the trajectory begins at {start:g} {unit}, the motor is at"
            f" {reference:g} {unit}",
            remedy="move there first, or make it relative (leave out initial=, or relative=True)",
        )


def require_near_start(
    motor: str, model: MotorModel, trajectory: TrapezoidalTrajectory, reference: float
) -> None:
    """Require that a moving motor is near the initial value of an absolute trajectory.

    Raises:
        StateError: it is not within the tolerance, and 0.1 s of its way.
    """
    tolerance = model.start_tolerance + abs(trajectory.initial_velocity) * _PASSING_S
    start = trajectory.initial
    if start is not None and abs(start - reference) > tolerance:
        raise StateError(
            motor=motor,
            operation="start",
            state=f"the trajectory begins at {start:g} {model.unit}, the motor passes"
            f" {reference:g} {model.unit}",
            remedy="start it when the motor is there, or make it relative (leave out initial=)",
        )


def require_velocity(motor: str, model: MotorModel, asked: float, velocity: float) -> None:
    """Require that the motor has the initial velocity of a trajectory.

    Raises:
        StateError: it has not.
    """
    if abs(asked - velocity) > model.acceleration_max * STEP_S:
        raise StateError(
            motor=motor,
            operation="start",
            state=f"the trajectory begins at {asked:g} {model.unit}/s, the motor moves at"
            f" {velocity:g} {model.unit}/s",
            remedy="let the motion before it end with that velocity (final_derivatives=), or begin"
            " at the present one",
        )


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


def _check_rate(
    motor: str,
    model: MotorModel,
    variable: ControlVariable,
    trajectory: ComplexTrajectory,
    argument: "Argument",
) -> None:
    """Check the first derivative by time at the maximum rate of the argument."""
    rate = argument.rate_max
    if rate is None:
        return
    allowed = Allowed.by(model, variable, trajectory.limits)
    low, high = allowed.first
    size = min(-low, high)
    found = trajectory.function.derivative().extrema(*trajectory.interval)
    for value, where in (
        (found.minimum * rate, found.at_minimum),
        (found.maximum * rate, found.at_maximum),
    ):
        if abs(value) > size + slack(size):
            raise LimitError(
                motor=motor,
                quantity=f"{allowed.names[1]} of the trajectory",
                value=value,
                low=-size,
                high=size,
                unit=allowed.units[1],
                reason=f"at argument {where:g}, at the maximum rate of the {argument.name}",
            )


def _check_ends(motor: str, model: MotorModel, trajectory: ComplexTrajectory) -> None:
    """Require rest at both ends: a velocity step at an end is an infinite acceleration too."""
    allowed = min(model.acceleration_max, model.deceleration) * STEP_S
    derivative = trajectory.function.derivative()
    for where, what in zip(trajectory.interval, ("begins", "ends"), strict=True):
        velocity = derivative.value(where)
        if abs(velocity) > allowed:
            raise UsageError(
                f"{motor}: the trajectory {what} at {velocity:g} {model.unit}/s, at argument"
                f" {where:g}, where the motor is at rest; allowed is a step of {allowed:g}"
                f" {model.unit}/s: lead it in and out, or cut it where its derivative is 0"
            )


def model_of_profile(model: MotorModel, *, limits_jerk: bool) -> MotorModel:
    """Return the model for planning: its jerk limit applies only if the motor `limits_jerk`."""
    if limits_jerk or model.jerk_max is None:
        return model
    return replace(model, jerk_max=None)


def bend_of(
    model: MotorModel, variable: ControlVariable, trajectory: TrapezoidalTrajectory
) -> float | None:
    """Return the limit of the derivative beyond those of a trapezoid or a ramp; None: no limit.

    It is that of the trajectory, or else the jerk limit of the model.
    """
    limits = trajectory.limits
    asked = None
    if limits is not None:
        asked = limits.third if variable is ControlVariable.POSITION else limits.second
    if asked is not None:
        return min(-asked[0], asked[1])
    has_jerk = variable in (ControlVariable.POSITION, ControlVariable.VELOCITY)
    return model.jerk_max if has_jerk else None


def smoothed(motion: Motion, bend: float) -> Motion:
    """Return the same motion as a function, as fast as all limits allow.

    Args:
        motion: the motion, with the limits of its other derivatives.
        bend: the limit of the next derivative, jerk or the bend of a slope.
    """
    if motion.distance == 0.0:
        return replace(motion, duration_s=0.0)
    function, duration_s = _generated(motion, bend)
    return replace(motion, function=function, interval=function.domain, duration_s=duration_s)


def between_states(
    motor: str,
    model: MotorModel,
    trajectory: TrapezoidalTrajectory,
    start: float,
    *,
    only_shape: bool = False,
) -> Motion:
    """Return the motion of a position trajectory with derivatives at its ends, from `start` [U].

    With `only_shape`, limits of the value are not examined.

    Raises:
        LimitError: no such motion exists within the limits, or none comes to rest within them.
        UnsupportedError: the generating package for limited jerk is not installed; or the jerk is
            unlimited, and a second derivative not 0.
        UsageError: the motion takes no time.
    """
    asked = trajectory
    if only_shape:
        model = replace(model, position_min=None, position_max=None)
        trajectory = replace(trajectory, limits=_without_value(trajectory.limits))
    if trajectory.is_relative:
        target, trajectory = start + trajectory.final, replace(trajectory, initial=None)
    else:
        target = trajectory.final
        trajectory = replace(trajectory, final=target - start, initial=None)
    velocity = trajectory.final_velocity
    function = _generated_between(motor, model, trajectory, start, target)
    return Motion(
        mode=ControlMode.TRAJECTORY,
        variable=ControlVariable.POSITION,
        start=start,
        target=target,
        velocity=model.velocity_max,
        acceleration=model.acceleration_max,
        deceleration=model.deceleration,
        duration_s=function.domain[1],
        trajectory=asked,
        function=function,
        interval=function.domain,
        initial_velocity=trajectory.initial_velocity,
        final_velocity=velocity,
        rest_at=_rest_at(motor, model, trajectory, target),
    )


def from_here(motor: str, model: MotorModel, motion: Motion, position: float) -> Motion:
    """Return a motion with an initial velocity, planned again from where it begins [U].

    All other motions begin where they were planned.

    Raises:
        MotorError: as `between_states`.
    """
    trajectory = motion.trajectory
    if not motion.initial_velocity or not isinstance(trajectory, TrapezoidalTrajectory):
        return motion
    return between_states(motor, model, trajectory, position)


def _without_value(limits: DerivativeLimits | None) -> DerivativeLimits | None:
    if limits is None:
        return None
    return DerivativeLimits(first=limits.first, second=limits.second, third=limits.third)


def _generated_between(
    motor: str, model: MotorModel, trajectory: TrapezoidalTrajectory, start: float, target: float
) -> "Function":
    """Return the profile of a trajectory with derivatives at its ends, in absolute values."""
    jerk = bend_of(model, ControlVariable.POSITION, trajectory)
    trajectory = replace(trajectory, initial_argument=0.0)
    if jerk is None:
        if any((*trajectory.initial_derivatives[1:], *trajectory.final_derivatives[1:])):
            raise UnsupportedError(
                motor=motor,
                feature="a second derivative at an end of a trajectory with unlimited jerk",
                supported="it with limits=DerivativeLimits(third=...)",
            )
        for violation in feasible(trajectory, model, start=start).violations:
            raise violation.as_error(motor)
        return generate(trajectory, model, start=start).as_function()
    allowed = Allowed.by(model, ControlVariable.POSITION, trajectory.limits)
    try:
        function = jerk_limited(
            target,
            allowed.profile_limits(trajectory.initial_velocity, trajectory.final_velocity),
            jerk,
            initial=start,
            initial_derivatives=trajectory.initial_derivatives,
            final_derivatives=trajectory.final_derivatives,
            duration_s=trajectory.duration_s,
        )
    except UnsupportedError as error:
        raise _without_package(motor, error) from error
    for violation in feasible(function, model).violations:
        raise violation.as_error(motor)
    return function


def _rest_at(
    motor: str, model: MotorModel, trajectory: TrapezoidalTrajectory, target: float
) -> float | None:
    """Return where the motor comes to rest after a final velocity; None: nowhere.

    Raises:
        LimitError: it cannot come to rest within the limits.
    """
    velocity = trajectory.final_velocity
    if not velocity:
        return None
    allowed = Allowed.by(model, ControlVariable.POSITION, trajectory.limits).value
    limit = allowed[1] if velocity > 0.0 else allowed[0]
    if isinf(limit):
        return None
    way = 0.5 * velocity * velocity / model.deceleration
    if abs(limit - target) < way - slack(way):
        raise LimitError(
            motor=motor,
            quantity="final velocity of the trajectory",
            value=velocity,
            low=None,
            high=sqrt(2.0 * model.deceleration * abs(limit - target)),
            unit=f"{model.unit}/s",
            reason=f"it ends {abs(limit - target):g} {model.unit} before the limit {limit:g}",
        )
    return limit


def slowed(motion: Motion, duration_s: float) -> Motion:
    """Return the motion with scaled time, so that every derivative becomes smaller."""
    function = motion.function
    if function is None or not motion.duration_s:
        return motion
    scaled = function.scaled(duration_s / motion.duration_s)
    return replace(motion, function=scaled, interval=scaled.domain, duration_s=duration_s)


def _generated(motion: Motion, bend: float) -> "tuple[Function, float]":
    if motion.variable is not ControlVariable.POSITION:
        rate = motion.acceleration if motion.variable is ControlVariable.VELOCITY else motion.slope
        profile = trapezoid(motion.target, ProfileLimits(rate, bend), initial=motion.start)
        return profile.as_function(), profile.duration_s
    limits = ProfileLimits(motion.velocity, motion.acceleration, motion.deceleration)
    curve = jerk_limited(motion.target, limits, bend, initial=motion.start)
    return curve, curve.domain[1]


def _without_package(motor: str, error: UnsupportedError) -> UnsupportedError:
    """Return the error for a motion that an absent package would generate."""
    feature = f"a limit on the jerk of a position ({error})"
    return UnsupportedError(motor=motor, feature=feature)
