"""Planning of simple trajectories with one more limited derivative.

The paper, 3.3.1: "If necessary, we can use the same representation to bound the third derivative
and represent a smoother motion." This means position with limited jerk, velocity with limited jerk,
and torque with a limited change of its slope. The curve is generated and becomes the function of
the motion, so every motor that can follow a complex trajectory can follow it. The jerk_max of the
model limits such requests; it does not limit motions without a request.
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
    """Return True if its limits exceed those of a position trapezoid, or of a ramp."""
    limits = trajectory.limits
    if limits is None:
        return False
    highest = limits.third if variable is ControlVariable.POSITION else limits.second
    return highest is not None


def smoothed(motor: str, motion: Motion, trajectory: TrapezoidalTrajectory) -> Motion:
    """Return the same motion as a function, as fast as all limits allow.

    Raises:
        UsageError: the generating package is not installed; names the extra.
    """
    if motion.distance == 0.0:
        return replace(motion, duration_s=0.0)
    function, duration_s = _generated(motor, motion, trajectory)
    return replace(motion, function=function, interval=function.domain, duration_s=duration_s)


def slowed(motion: Motion, duration_s: float) -> Motion:
    """Return the motion with scaled time, so that every derivative becomes smaller."""
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
    except UnsupportedError as error:  # without the package that generates it
        raise UnsupportedError(
            motor=motor, feature=f"a limit on the jerk of a position ({error})"
        ) from error
    return curve, curve.domain[1]
