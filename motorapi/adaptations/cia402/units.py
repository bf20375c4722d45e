"""Conversion between a CiA 402 drive's integers and SI units.

The unit of each object comes from the motor model or from the drive's factor objects, and is never
guessed:
- position: 60A8h (SI unit position) if it names an angle; else 6092h, feed constant: position units
  per turn of the driving (output) shaft. A feed constant of 1/1 is not trusted, as unconfigured
  drives that count encoder increments show it. Without 6092h: 608Fh x 6091h, increments per turn of
  the output shaft.
- velocity: 60A9h (SI unit velocity) if it names a rate; else position units per second if 6096h is
  1/1. Any other 6096h is not trusted: the standard's successive editions, and vendors after them,
  read it in opposite directions.
- acceleration: position units per second squared if 6097h is 1/1 and there is no 60A9h.

The model takes precedence. U is the model's unit: rad or m. For m, the model must define all units.

Source: IEC 61800-7-201 (CiA 402-2), factor group; CiA 303-2 for the unit codes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import floor, pi
from typing import Final, final

from motorhil.motorapi.errors import LimitError, UsageError
from motorhil.motorapi.model import MotionKind, MotorModel

# CiA 303-2: unit codes of angles [rad], and of time [s]
_ANGLES: Final = {
    0x10: 1.0,
    0x41: pi / 180,
    0x42: pi / 180 / 60,
    0x43: pi / 180 / 3600,
    0xB4: 2 * pi,
}
_TIMES: Final = {0x03: 1.0, 0x47: 60.0}
_INT32_MAX: Final = 0x7FFF_FFFF
_UINT32_MAX: Final = 0xFFFF_FFFF
_RAD_PER_TURN: Final = 2 * pi

ReadObject = Callable[[int, int], int | None]
"""A function (index, sub-index) -> value, or None if the drive has no such object."""


@final
@dataclass(frozen=True, slots=True)
class DriveUnits:
    """The units of the drive's objects; None if unknown, and `sources` then gives the reason.

    Attributes:
        increments_per_unit: position increments (607Ah, 6064h) per U, signed.
        velocity_unit: the unit of 6081h, 606Ch and 60FFh [U/s], > 0.
        acceleration_unit: the unit of 6083h and 6084h [U/s²], > 0.
        sources: the source of each of them, in words.
        motor, unit: the motor's name and U, for messages.
        velocity_direction: -1 if the drive's velocities have the opposite sign of its positions, as
            607Eh inverts only one of them; else 1.
    """

    motor: str
    unit: str
    increments_per_unit: float | None
    velocity_unit: float | None
    acceleration_unit: float | None
    sources: tuple[str, str, str]
    velocity_direction: int = 1

    def _position(self) -> float:
        if self.increments_per_unit is None:
            raise _missing(self.motor, f"increments_per_{self.unit}", self.sources[0])
        return self.increments_per_unit

    def _velocity(self) -> float:
        if self.velocity_unit is None:
            raise _missing(self.motor, f"velocity_unit_{self.unit}_s", self.sources[1])
        return self.velocity_unit

    def _acceleration(self) -> float:
        if self.acceleration_unit is None:
            raise _missing(self.motor, f"acceleration_unit_{self.unit}_s2", self.sources[2])
        return self.acceleration_unit

    def require_all(self) -> None:
        """Raise UsageError if one of the units is not known, as a motion needs them all."""
        self._position()
        self._velocity()
        self._acceleration()

    def _rounded_down(self, quantity: str, value: float, unit: float, largest: int) -> int:
        if value == 0.0:
            return 0
        steps = value / unit
        raw = floor(steps * (1.0 + 4e-16) + 1e-9)  # an integer number of steps is kept
        if raw > largest:
            raise LimitError(
                motor=self.motor,
                quantity=quantity,
                value=value,
                low=None,
                high=largest * unit,
                unit=f"{self.unit}/s" if quantity == "velocity" else f"{self.unit}/s²",
                reason=f"the drive counts it in steps of {unit:g} and holds {largest}",
            )
        return max(raw, 1)

    # --- position

    def position(self, position_inc: int) -> float:
        """Return increments as a position [U]."""
        return position_inc / self._position()

    def increments(self, distance: float) -> float:
        """Return a distance [U] in increments, signed, not rounded."""
        return distance * self._position()

    def position_inc(self, position: float) -> int:
        """Return the nearest increment to a position [U]; it may exceed the drive's 32 bits."""
        return round(position * self._position())

    def require_distance(self, distance_inc: int) -> None:
        """Require that a move fits the drive.

        Raises:
            LimitError: it does not fit the drive's 32 bits.
        """
        if -_INT32_MAX <= distance_inc <= _INT32_MAX:
            return
        reach = _INT32_MAX / abs(self._position())
        raise LimitError(
            motor=self.motor,
            quantity="distance of one move",
            value=self.position(distance_inc),
            low=-reach,
            high=reach,
            unit=self.unit,
            reason="607Ah has 32 bits",
        )

    # --- velocity and acceleration

    def velocity(self, velocity_raw: int) -> float:
        """Return the drive's velocity integer as a velocity [U/s]."""
        size = velocity_raw * self._velocity()
        return -size if self._counts_backwards() else size

    def _counts_backwards(self) -> bool:
        """Return whether the drive's velocities have the opposite sign of ours."""
        return (self._position() < 0.0) != (self.velocity_direction < 0)

    def velocity_raw(self, velocity: float) -> int:
        """Return a velocity [U/s] in the drive's units, rounded towards 0 but never to 0."""
        unit = self._velocity()
        raw = self._rounded_down("velocity", abs(velocity), unit, _INT32_MAX)
        return -raw if (velocity < 0.0) != self._counts_backwards() else raw

    def speed_raw(self, speed: float) -> int:
        """Return a speed [U/s], > 0, in the drive's units, rounded down but never to 0."""
        return self._rounded_down("velocity", speed, self._velocity(), _UINT32_MAX)

    def speed(self, speed_raw: int) -> float:
        """Return the speed [U/s] of an integer of the drive."""
        return speed_raw * self._velocity()

    def acceleration_raw(self, acceleration: float) -> int:
        """Return an acceleration [U/s²], > 0, in the drive's units, rounded down but never to 0."""
        unit = self._acceleration()
        return self._rounded_down("acceleration", acceleration, unit, _UINT32_MAX)

    def acceleration(self, acceleration_raw: int) -> float:
        """Return the size of an acceleration [U/s²] of an integer of the drive."""
        return acceleration_raw * self._acceleration()


_POLARITIES: Final = 0xC0  # 607Eh: bit 7 inverts positions, bit 6 velocities


def velocity_direction(read: ReadObject) -> int:
    """Return `DriveUnits.velocity_direction` of a drive."""
    polarity = (read(0x607E, 0) or 0) & _POLARITIES
    return 1 if polarity in (0, _POLARITIES) else -1


def _missing(motor: str, key: str, why: str) -> UsageError:
    return UsageError(f"{motor}: {key} is not known: {why}; write {key} into the motor model")


def drive_units(motor: str, model: MotorModel, read: ReadObject) -> DriveUnits:
    """Return the units of a drive, from the model or else from the drive's objects.

    Args:
        motor: the motor's name, for messages.
        model: the motor model.
        read: reads an object of the drive.

    Raises:
        UsageError: a unit in the model is not valid.
    """
    scale, position_source = model.increments_per_unit, "the motor model"
    if scale is None:
        scale, position_source = _position_unit(model, read)
    elif scale == 0.0:
        raise UsageError(f"{motor}: increments_per_unit is 0; it must be increments per rad or m")
    velocity, velocity_source = model.velocity_unit, "the motor model"
    if velocity is None:
        velocity, velocity_source = _velocity_unit(model, read, scale)
    acceleration, acceleration_source = model.acceleration_unit, "the motor model"
    if acceleration is None:
        acceleration, acceleration_source = _acceleration_unit(read, scale)
    for key, value in (("velocity_unit", velocity), ("acceleration_unit", acceleration)):
        if value is not None and value <= 0.0:
            raise UsageError(f"{motor}: {key} is {value:g}; it must be > 0")
    sources = (position_source, velocity_source, acceleration_source)
    return DriveUnits(motor, model.unit, scale, velocity, acceleration, sources)


def _ratio(read: ReadObject, index: int) -> float | None:
    numerator, divisor = read(index, 1), read(index, 2)
    if numerator is None or divisor is None or numerator <= 0 or divisor <= 0:
        return None
    return numerator / divisor


def _power_of_ten(code: int) -> float:
    exponent = code >> 24
    return float(10.0 ** (exponent - 256 if exponent & 0x80 else exponent))


def _position_unit(model: MotorModel, read: ReadObject) -> tuple[float | None, str]:
    if model.kind is MotionKind.LINEAR:
        return None, "the drive reports turns, not metres"
    code = read(0x60A8, 0) or 0
    angle = _ANGLES.get(code >> 16 & 0xFF)
    if angle is not None:
        return 1.0 / (angle * _power_of_ten(code)), f"60A8h = {code:08X}h"
    resolution, gear, feed = (_ratio(read, index) for index in (0x608F, 0x6091, 0x6092))
    if feed is not None and feed != 1.0:
        return feed / _RAD_PER_TURN, f"6092h = {feed:g} position units per turn"
    if feed is not None:
        return None, "the drive's feed constant 6092h is 1/1, as if never configured"
    if resolution is None or gear is None:
        return None, "the drive lacks the factor objects 60A8h, 6092h, 608Fh and 6091h"
    if resolution == 1.0:
        return None, "the drive's encoder resolution 608Fh is 1/1, as if never configured"
    return resolution * gear / _RAD_PER_TURN, "608Fh x 6091h"


def _velocity_unit(
    model: MotorModel, read: ReadObject, scale: float | None
) -> tuple[float | None, str]:
    code = read(0x60A9, 0) or 0
    if code:
        angle, time = _ANGLES.get(code >> 16 & 0xFF), _TIMES.get(code >> 8 & 0xFF)
        if angle is not None and time is not None and model.kind is MotionKind.ROTARY:
            return angle * _power_of_ten(code) / time, f"60A9h = {code:08X}h"
        return None, f"60A9h = {code:08X}h in the drive is not turns, degrees or radians"
    return _per_second(read, scale, 0x6096, 0x608C)


def _acceleration_unit(read: ReadObject, scale: float | None) -> tuple[float | None, str]:
    if read(0x60A9, 0):
        return None, "the drive's 60A9h names a unit of velocity, but none of acceleration"
    return _per_second(read, scale, 0x6097, 0x608E)


def _per_second(
    read: ReadObject, scale: float | None, factor_index: int, dimension_index: int
) -> tuple[float | None, str]:
    dimension = read(dimension_index, 0) or 0
    if dimension:
        return (
            None,
            f"the drive's {dimension_index:04X}h = {dimension:02X}h names a unit of its own",
        )
    factor = _ratio(read, factor_index)
    if factor is None:
        return None, f"the drive lacks the factor object {factor_index:04X}h"
    if factor != 1.0:
        return None, f"the drive's {factor_index:04X}h is {factor:g}, which vendors read both ways"
    if scale is None:
        return None, "it follows from increments_per_unit, which is not known"
    return 1.0 / abs(scale), f"{factor_index:04X}h = 1/1: position units"
