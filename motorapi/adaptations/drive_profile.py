"""A motion in the drive's integers, and its exact duration.

Profile velocity and accelerations are integers in the drive's units, so a profile meets a given
duration only approximately. The neighbouring integers that come closest are taken, without
exceeding a limit. A cruise velocity one step higher with flatter ramps is often better than one
step lower.
"""

from dataclasses import dataclass, replace
from typing import Final, final

from motorapi import planning
from motorapi.adaptations.cia402_units import DriveUnits
from motorapi.commands import ControlVariable, Motion
from motorapi.errors import LimitError
from motorapi.generation import shortest
from motorapi.model import MotorModel
from motorapi.trajectory import TrapezoidalTrajectory

_ROUNDING: Final = 1e-12
_TOO_SHORT: Final = 0.1  # of the requested duration; integers may deviate less than that
_STEP_ROUNDING: Final = 1e-8  # more than the rounding of DriveUnits for a limit of integer steps


@final
@dataclass(frozen=True, slots=True)
class DriveLimits:
    """The drive's own limits, in its units; None if it does not report one.

    Attributes:
        position: 607Dh, software position limits; also None if both are 0, which disables them.
        speed: 607Fh, maximum profile velocity.
        acceleration, deceleration: 60C5h, 60C6h.
        window: 6067h, position window; None if it is switched off or absent.
        has_deceleration: whether 6084h exists; without it, both ramps use 6083h.
    """

    position: tuple[int, int] | None
    speed: int | None
    acceleration: int | None
    deceleration: int | None
    window: int | None
    has_deceleration: bool


@final
@dataclass(frozen=True, slots=True)
class DriveProfile:
    """One motion in the drive's integers: 607Ah or 60FFh, 6081h, 6083h, 6084h."""

    target: int
    speed: int
    acceleration: int
    deceleration: int


def profile_of(
    motion: Motion, model: MotorModel, units: DriveUnits, limits: DriveLimits
) -> DriveProfile:
    """Return the integers that make `motion`, as nearly as the drive's units allow.

    Raises:
        LimitError: they do not fit the drive, or its smallest step exceeds a limit.
        UsageError: a unit is not known.
    """
    up, down = motion.acceleration, motion.deceleration
    if not limits.has_deceleration:
        up = down = min(up, down)
    acceleration = units.acceleration_raw(up)
    deceleration = units.acceleration_raw(down)
    steepest = _ramp_limits(motion, model, up, down)
    _check_step("acceleration", units.acceleration(acceleration), steepest[0], units)
    _check_step("deceleration", units.acceleration(deceleration), steepest[1], units)
    if motion.variable is ControlVariable.VELOCITY:
        target = units.velocity_raw(motion.target)
        return DriveProfile(target, abs(target), acceleration, deceleration)
    target = units.position_inc(motion.target)
    speed = units.speed_raw(motion.velocity)
    limit = motion.velocity if motion.trajectory is None else _speed_limit(motion, model)
    _check_step("velocity", units.speed(speed), limit, units)
    profile = DriveProfile(target, speed, acceleration, deceleration)
    distance_inc = target - units.position_inc(motion.start)
    if motion.duration_s is not None and motion.trajectory is not None and distance_inc:
        top = _speed_limit(motion, model)
        if limits.speed:
            top = min(top, units.speed(limits.speed))
        distance = abs(units.position(distance_inc))
        profile = _nearest(profile, distance, motion.duration_s, top, units)
        _check_slowness(motion, profile, distance, units)
    return profile


def _check_slowness(
    motion: Motion, profile: DriveProfile, distance: float, units: DriveUnits
) -> None:
    """Refuse a requested duration that is too long for the drive's lowest velocity."""
    trajectory = motion.trajectory
    if profile.speed != 1 or not isinstance(trajectory, TrapezoidalTrajectory):
        return
    asked_s = trajectory.duration_s
    if asked_s is None:
        return
    made_s = _duration_s(profile, distance, units)
    if made_s < asked_s * (1.0 - _TOO_SHORT):
        raise LimitError(
            motor=units.motor,
            quantity="duration",
            value=asked_s,
            low=None,
            high=made_s,
            unit="s",
            reason=f"for {distance:g} {units.unit}: the drive's lowest velocity is "
            f"{units.speed(1):g} {units.unit}/s",
        )


def _check_step(quantity: str, made: float, limit: float, units: DriveUnits) -> None:
    """Refuse a limit below the drive's smallest step, where rounding down ends."""
    if made > limit * (1.0 + _STEP_ROUNDING):
        raise LimitError(
            motor=units.motor,
            quantity=f"{quantity} limit",
            value=limit,
            low=made,
            high=None,
            unit=f"{units.unit}/s" if quantity == "velocity" else f"{units.unit}/s²",
            reason="it is below the smallest step of the drive's units",
        )


def check_limits(motor: str, profile: DriveProfile, units: DriveUnits, limits: DriveLimits) -> None:
    """Check that the drive would not clip this motion.

    Raises:
        LimitError: the drive would; the message names the object of the limit.
    """
    pairs = (
        ("velocity", profile.speed, limits.speed, units.speed, "607Fh", "/s"),
        (
            "acceleration",
            profile.acceleration,
            limits.acceleration,
            units.acceleration,
            "60C5h",
            "/s²",
        ),
        (
            "deceleration",
            profile.deceleration,
            limits.deceleration,
            units.acceleration,
            "60C6h",
            "/s²",
        ),
    )
    for quantity, raw, highest, scale, name, per in pairs:
        if highest and raw > highest:
            raise LimitError(
                motor=motor,
                quantity=quantity,
                value=scale(raw),
                low=None,
                high=scale(highest),
                unit=f"{units.unit}{per}",
                reason=f"{name} in the drive is {highest}",
            )


def check_target(motor: str, target: int, units: DriveUnits, limits: DriveLimits) -> None:
    """Check a target [increments] against the drive's own software position limits.

    Raises:
        LimitError: the target is outside.
    """
    if limits.position is None or limits.position[0] <= target <= limits.position[1]:
        return
    ends = sorted(units.position(end) for end in limits.position)
    raise LimitError(
        motor=motor,
        quantity="target position",
        value=units.position(target),
        low=ends[0],
        high=ends[1],
        unit=units.unit,
        reason="607Dh in the drive",
    )


def as_motion(motion: Motion, profile: DriveProfile, units: DriveUnits) -> Motion:
    """Return `profile` as a motion in SI units, with its exact duration."""
    acceleration = units.acceleration(profile.acceleration)
    deceleration = units.acceleration(profile.deceleration)
    if motion.variable is ControlVariable.VELOCITY:
        made = replace(
            motion,
            target=units.velocity(profile.target),
            acceleration=acceleration,
            deceleration=deceleration,
        )
        if motion.duration_s is None:
            return made
        return replace(made, duration_s=planning.duration_of(made))
    return replace(
        motion,
        start=units.position(units.position_inc(motion.start)),
        target=units.position(profile.target),
        velocity=units.speed(profile.speed),
        acceleration=acceleration,
        deceleration=deceleration,
        duration_s=None if motion.duration_s is None else expected_s(motion, profile, units),
    )


def expected_s(motion: Motion, profile: DriveProfile, units: DriveUnits) -> float:
    """Return the duration of the profile over the motion's distance [s] (position only)."""
    start = units.position(units.position_inc(motion.start))
    return _duration_s(profile, units.position(profile.target) - start, units)


def _ramp_limits(motion: Motion, model: MotorModel, up: float, down: float) -> tuple[float, float]:
    """Return the limits of model and command, as a group may request less than a step."""
    if motion.trajectory is None or motion.variable is not ControlVariable.POSITION:
        return up, down
    bounds = planning.bounds_of(model, motion)
    return max(up, bounds.acceleration), max(down, bounds.deceleration)


def _speed_limit(motion: Motion, model: MotorModel) -> float:
    """Return the velocity limit of model and command [U/s], at least that of the motion."""
    top = model.velocity_max
    limits = None if motion.trajectory is None else motion.trajectory.limits
    if limits is not None and limits.first is not None:
        top = min(top, limits.first[1] if motion.distance >= 0.0 else -limits.first[0])
    return max(top, motion.velocity)


def _nearest(
    first: DriveProfile, distance: float, duration_s: float, top: float, units: DriveUnits
) -> DriveProfile:
    """Return the profile whose duration is nearest to `duration_s`; `first` if none is nearer."""
    best, best_s = first, abs(_duration_s(first, distance, units) - duration_s)
    half = 0.5 / units.acceleration(first.acceleration) + 0.5 / units.acceleration(
        first.deceleration
    )
    for speed in (first.speed, first.speed + 1):
        peak = units.speed(speed)
        if speed != first.speed and peak > top * (1.0 + _ROUNDING):
            continue
        ramps_s = duration_s - distance / peak
        if ramps_s < peak * half or ramps_s > distance / peak:
            continue  # the ramps cannot be so steep, or would not reach the peak
        flatter = peak * half / ramps_s
        for up in _around(first.acceleration, flatter):
            for down in _around(first.deceleration, flatter):
                candidate = DriveProfile(first.target, speed, up, down)
                off_s = abs(_duration_s(candidate, distance, units) - duration_s)
                if off_s < best_s:
                    best, best_s = candidate, off_s
    return best


def _around(raw: int, factor: float) -> tuple[int, ...]:
    """Return the integers next to raw * factor, not 0 and not above raw."""
    floor = int(raw * factor)
    return tuple(number for number in (floor, floor + 1) if 1 <= number <= raw)


def _duration_s(profile: DriveProfile, distance: float, units: DriveUnits) -> float:
    return shortest(
        distance,
        units.speed(profile.speed),
        units.acceleration(profile.acceleration),
        units.acceleration(profile.deceleration),
    ).duration_s
