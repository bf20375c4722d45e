"""A motion in the drive's integers, and its exact duration.

Profile velocity and accelerations are integers in the drive's units, so a profile meets a given
duration only approximately. The neighbouring integers that come closest are taken, without
exceeding a limit. A cruise velocity one step higher with flatter ramps is often better than one
step lower.

*Torque*: 6071h, 6074h and 6077h count in 1/1000 of the motor's rated torque 6076h [mN m] at its
shaft. Torque here is that of the output, where position is counted: times the gear ratio, from the
motor model or else from 6091h. Friction and inertia in between are not subtracted. A linear motor
has a force: 2 pi times the motor's turns per metre, which the drive does not report. Nothing is
guessed. Polarity (607Eh) inverts positions and velocities, but not torque.
"""

from collections.abc import Callable
from dataclasses import replace
from math import floor, inf, pi
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.adaptations.cia402.units import DriveUnits
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import LimitError, UnsupportedError, below_step
from motorhil.motorapi.generation import shortest
from motorhil.motorapi.model import MotionKind, MotorModel
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.planning import single_axis as planning
from motorhil.motorapi.trajectory import TrapezoidalTrajectory

_ROUNDING: Final = 1e-12
_TOO_SHORT: Final = 0.1  # of the requested duration; integers may deviate less than that
_STEP_ROUNDING: Final = 1e-8  # more than the rounding of DriveUnits for a limit of integer steps


@final
@frozen
class DriveLimits:
    """The drive's own limits, in its units; None if it does not report one.

    Attributes:
        position: 607Dh, software position limits, counted from zero; also None if both are 0, which
            disables them.
        speed: 607Fh, maximum profile velocity.
        acceleration, deceleration: 60C5h, 60C6h.
        window: 6067h, position window; None if it is switched off or absent.
        has_deceleration: whether 6084h exists; without it, both ramps use 6083h.
        halt_option: 605Dh.
    """

    position: tuple[int, int] | None
    speed: int | None
    acceleration: int | None
    deceleration: int | None
    window: int | None
    has_deceleration: bool
    halt_option: int | None = None


@final
@frozen
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
        unit = f"{units.unit}/s" if quantity == "velocity" else f"{units.unit}/s²"
        raise below_step(units.motor, f"{quantity} limit", limit, made, unit)


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


ReadObject = Callable[[int, int], int | None]

_INT16_MAX: Final = 0x7FFF
_UINT32_MAX: Final = 0xFFFF_FFFF
_POSITION_POLARITY: Final = 0x80
STEEPEST: Final = _UINT32_MAX  # 6087h: no ramp requested


@final
@frozen
class TorqueUnit:
    """The units of the drive's torque objects.

    Attributes:
        motor, unit: the motor's name, and "N·m" or "N", for messages.
        size: the torque of the output per 1/1000 of 6076h, > 0.
        sign: -1 if the drive counts in the opposite direction, else 1.
        limits: the drive's own limits, forwards and backwards in its direction: (object, 1/1000),
            the tighter one of 6072h and 60E0h or 60E1h.
        has_slope: whether the drive has 6087h, torque slope.
    """

    motor: str
    unit: str
    size: float
    sign: int
    limits: tuple[tuple[str, int], tuple[str, int]]
    has_slope: bool

    def torque(self, raw: int) -> float:
        """Return the drive's integer as a torque [N·m, N]."""
        return self.sign * raw * self.size

    def raw(self, torque: float) -> int:
        """Return a torque [N·m, N] in the drive's units, rounded towards 0.

        Raises:
            LimitError: it does not fit the object, or exceeds the drive's limit.
        """
        steps = abs(torque) / self.size
        raw = floor(steps * (1.0 + 4e-16) + 1e-9)
        forwards = (torque >= 0.0) == (self.sign > 0)
        name, highest = self.limits[0 if forwards else 1]
        if raw > highest:
            ends = sorted((self.torque(self.limits[0][1]), self.torque(-self.limits[1][1])))
            raise LimitError(
                motor=self.motor,
                quantity="target torque",
                value=torque,
                low=ends[0],
                high=ends[1],
                unit=self.unit,
                reason=f"{name} is {highest}" if name else "6071h has 16 bits",
            )
        return raw if forwards else -raw


@final
@frozen
class TorqueProfile:
    """One torque motion in the drive's integers: 6071h, 6087h (None: the drive has none)."""

    target: int
    slope: int | None


def torque_unit(
    motor: str, model: MotorModel, increments_per_unit: float, read: ReadObject
) -> TorqueUnit:
    """Return the torque units of this drive.

    Raises:
        UnsupportedError: neither the drive nor the model defines them.
    """
    rated = read(0x6076, 0)
    if not rated:
        raise _unsupported(motor, "the drive does not report its rated torque, 6076h")
    gear = None if model.gear_ratio is None else abs(model.gear_ratio)
    if model.kind is MotionKind.LINEAR:
        if gear is None:
            raise _unsupported(motor, "write motor_turns_per_m into the motor model")
        gear *= 2.0 * pi
    elif gear is None:
        turns, shaft = read(0x6091, 1), read(0x6091, 2)
        if not turns or not shaft or turns < 0 or shaft < 0:
            reason = "the drive does not report its gear ratio, 6091h; write gear_ratio into the"
            raise _unsupported(motor, f"{reason} motor model")
        gear = turns / shaft
    is_inverted = (read(0x607E, 0) or 0) & _POSITION_POLARITY != 0
    return TorqueUnit(
        motor=motor,
        unit="N·m" if model.kind is MotionKind.ROTARY else "N",
        size=rated * 1e-6 * gear,
        sign=-1 if (increments_per_unit < 0.0) is not is_inverted else 1,
        limits=(_limit(read, 0x60E0), _limit(read, 0x60E1)),
        has_slope=read(0x6087, 0) is not None,
    )


def _limit(read: ReadObject, own: int) -> tuple[str, int]:
    """Return the tightest limit in one direction, and the object that holds it ("" if none)."""
    tightest = ("", _INT16_MAX)
    for index in (0x6072, own):
        limit = read(index, 0)
        if limit is not None and limit < tightest[1]:
            tightest = (f"{index:04X}h", limit)
    return tightest


def _unsupported(motor: str, reason: str) -> UnsupportedError:
    return UnsupportedError(motor=motor, feature=f"torque in SI units ({reason})")


def torque_profile_of(motion: Motion, unit: TorqueUnit) -> TorqueProfile:
    """Return the integers that make `motion`; the slope is rounded down, but never to 0.

    Raises:
        LimitError: they do not fit the drive, or its smallest step exceeds a limit.
        UnsupportedError: a ramp is requested, and the drive has none.
    """
    target = unit.raw(motion.target)
    if not unit.has_slope:
        if motion.slope < inf:
            raise UnsupportedError(
                motor=unit.motor, feature="a ramp of torque: the drive has no 6087h"
            )
        return TorqueProfile(target, None)
    steps = motion.slope / unit.size
    if steps >= _UINT32_MAX:
        return TorqueProfile(target, STEEPEST)
    slope = floor(steps * (1.0 + 4e-16) + 1e-9)
    if slope < 1:
        slowest = f"{unit.unit}/s"
        raise below_step(unit.motor, "slope of torque", motion.slope, unit.size, slowest)
    return TorqueProfile(target, slope)


def as_torque_motion(motion: Motion, profile: TorqueProfile, unit: TorqueUnit) -> Motion:
    """Return `profile` as a motion in SI units, with its duration."""
    target = unit.torque(profile.target)
    slope = inf if profile.slope in (None, STEEPEST) else (profile.slope or 0) * unit.size
    made = replace(motion, target=target, slope=slope)
    if motion.mode is ControlMode.SETPOINT or motion.duration_s is None:
        return made
    return replace(made, duration_s=abs(target - motion.start) / slope)


def ramp_s(motion: Motion, profile: TorqueProfile, unit: TorqueUnit) -> float:
    """Return the approximate duration of the drive's ramp [s]."""
    if profile.slope in (None, 0):
        return 0.0
    return abs(motion.distance) / ((profile.slope or 1) * unit.size)
