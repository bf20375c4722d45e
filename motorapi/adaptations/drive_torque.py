"""Torque units and torque motions of a CiA 402 drive.

6071h, 6074h and 6077h count in 1/1000 of the motor's rated torque 6076h [mN m] at its shaft. Torque
here is that of the output, where position is counted: times the gear ratio, from the motor model or
else from 6091h. Friction and inertia in between are not subtracted. A linear motor has a force: 2
pi times the motor's turns per metre, which the drive does not report. Nothing is guessed.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import floor, inf, pi
from typing import Final, final

from motorapi.commands import ControlMode, Motion
from motorapi.errors import LimitError, UnsupportedError
from motorapi.model import MotionKind, MotorModel

ReadObject = Callable[[int, int], int | None]

_INT16_MAX: Final = 0x7FFF
_UINT32_MAX: Final = 0xFFFF_FFFF
STEEPEST: Final = _UINT32_MAX  # 6087h: no ramp requested


@final
@dataclass(frozen=True, slots=True)
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
@dataclass(frozen=True, slots=True)
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
    return TorqueUnit(
        motor=motor,
        unit="N·m" if model.kind is MotionKind.ROTARY else "N",
        size=rated * 1e-6 * gear,
        sign=-1 if increments_per_unit < 0.0 else 1,
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
        raise LimitError(
            motor=unit.motor,
            quantity="slope of torque",
            value=motion.slope,
            low=unit.size,
            high=None,
            unit=f"{unit.unit}/s",
            reason="it is below the smallest step of the drive's units",
        )
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
