"""Simple trajectories that bound one derivative more than a drive's own profile does.

The paper, 3.3.1: "If necessary, we can use the same representation to bound the third derivative
and represent a smoother motion." Position with a bounded jerk, velocity with one, torque with a
bounded change of its slope: the curve is generated and becomes the motion's function, so whoever
can follow a complex trajectory can follow these. The model's jerk_max bounds what is asked for
here; it is no limit of motions that do not ask.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

from motorapi.commands import ControlVariable, Motion
from motorapi.errors import UnsupportedError
from motorapi.generation import ProfileLimits, jerk_limited, trapezoid
from motorapi.trajectory import TrapezoidalTrajectory

if TYPE_CHECKING:
    from motorapi.functions.function import Function


def asks_for_smoothness(variable: ControlVariable, trajectory: TrapezoidalTrajectory) -> bool:
    """Whether its limits bound more than a trapezoid of position, or a ramp, keeps to."""
    limits = trajectory.limits
    if limits is None:
        return False
    highest = limits.third if variable is ControlVariable.POSITION else limits.second
    return highest is not None


def smoothed(motor: str, motion: Motion, trajectory: TrapezoidalTrajectory) -> Motion:
    """The same motion, resolved but for its duration, as a function: as fast as all limits allow.

    Raises:
        UsageError: what generates it is not installed; names the extra.
    """
    if motion.distance == 0.0:
        return replace(motion, duration_s=0.0)
    function, duration_s = _generated(motor, motion, trajectory)
    return replace(motion, function=function, interval=function.domain, duration_s=duration_s)


def slowed(motion: Motion, duration_s: float) -> Motion:
    """The same way in a longer time: time is scaled, so every derivative becomes smaller."""
    function = motion.function
    if function is None or not motion.duration_s:
        return motion
    scaled = function.scaled(duration_s / motion.duration_s)
    return replace(motion, function=scaled, interval=scaled.domain, duration_s=duration_s)


def _generated(
    motor: str, motion: Motion, trajectory: TrapezoidalTrajectory
) -> "tuple[Function, float]":
    limits = trajectory.limits
    assert limits is not None
    if motion.variable is not ControlVariable.POSITION:
        assert limits.second is not None
        rate = motion.acceleration if motion.variable is ControlVariable.VELOCITY else motion.slope
        profile = trapezoid(motion.target, ProfileLimits(rate, limits.second), initial=motion.start)
        return profile.as_function(), profile.duration_s
    assert limits.third is not None
    try:
        curve = jerk_limited(
            motion.target,
            ProfileLimits(motion.velocity, motion.acceleration, motion.deceleration),
            min(-limits.third[0], limits.third[1]),
            initial=motion.start,
        )
    except UnsupportedError as error:  # without the package that makes it
        raise UnsupportedError(
            motor=motor, feature=f"a limit on the jerk of a position ({error})"
        ) from error
    return curve, curve.domain[1]
