"""Units of a drive's position, velocity and acceleration objects.

Internally, everything is counted in increments of the motor's encoder, per second and per second
squared. Externally, a drive uses the units of its factor group (CiA 402-2, factor group):

- position: 608Fh encoder resolution x 6091h gear ratio / 6092h feed constant increments per unit,
  if 608Fh matches the motor's encoder; otherwise the unit is one increment;
- velocity: position unit per second x 6096h; acceleration: per second squared x 6097h;
- units by dimension index (608Ch, 608Eh: A4h = turns of the motor per minute) or SI unit (60A8h,
  60A9h) in an EDS replace these;
- the rig's `units` table overrides all of them.

607Eh inverts positions (bit 7) and velocities (bit 6), but not torque. 607Bh defines a range in
which positions repeat, as on a turntable, if it is smaller than 32 bits.

`DriveDefaults` has the motor-dependent values for objects without a value in EDS and rig.
"""

from dataclasses import dataclass
from fractions import Fraction
from typing import Final, final

from motorhil.emulators.canopen.object_dictionary import ObjectDictionary
from motorhil.emulators.cia402.settings import DriveSettings
from motorhil.emulators.plant.dc_motor import PI, MotorPlant

POSITION_POLARITY: Final = 0x80  # 607Eh
VELOCITY_POLARITY: Final = 0x40
RPM_DIMENSION: Final = 0xA4  # 608Ch, 608Eh: turns per minute (and second), as in maxon's EDS files

# 60A8h/60A9h: bits 31-24 power of ten, 23-16 numerator, 15-8 denominator (CiA 303-2 codes).
_SI_TURNS: Final[dict[int, Fraction]] = {
    0x10: Fraction(1.0 / (2.0 * PI)).limit_denominator(1_000_000),  # radian
    0x41: Fraction(1, 360),  # degree
    0x42: Fraction(1, 360 * 60),  # minute of arc
    0x43: Fraction(1, 360 * 3600),  # second of arc
    0xB4: Fraction(1),  # revolution
}
_SI_SECONDS: Final[dict[int, int]] = {0x00: 1, 0x03: 1, 0x47: 60}

_SPAN: Final = 1 << 32
_UNSIGNED32_MAX: Final = 0xFFFF_FFFF
_GEAR_DIVISOR_MAX: Final = 10_000


@final
@dataclass(frozen=True, slots=True)
class Units:
    """Increments per unit, as exact ratios or floats.

    Attributes:
        position_numerator, position_divisor: increments per position unit, as whole numbers; the
            first is < 0 if 607Eh inverts positions.
        velocity_unit_inc_s: increments per second per velocity unit.
        acceleration_unit_inc_s2: increments per second squared per acceleration unit.
        velocity_sign: -1.0 if 607Eh inverts velocities.
        range_low, range_size: 607Bh: the lowest position and the number of positions; 0: no range.
    """

    position_numerator: int
    position_divisor: int
    velocity_unit_inc_s: float
    acceleration_unit_inc_s2: float
    velocity_sign: float = 1.0
    range_low: int = 0
    range_size: int = 0

    def position_inc(self, raw: int) -> int:
        """Convert position units to increments, rounded to the nearest."""
        divisor = self.position_divisor
        numerator = self.position_numerator
        if divisor == 1:
            return raw * numerator
        return (2 * raw * numerator + divisor) // (2 * divisor)

    def position_raw(self, position_inc: int) -> int:
        """Convert increments to position units, rounded to the nearest, within the range.

        Without a range: signed 32 bit, wrapping.
        """
        raw = self._raw(position_inc)
        if self.range_size:
            return self.range_low + (raw - self.range_low) % self.range_size
        return (raw + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000

    def length_raw(self, length_inc: int) -> int:
        """Convert a distance to position units, ignoring the range; signed 32 bit, wrapping."""
        return (self._raw(length_inc) + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000

    def turned_inc(self, raw: int, demand_inc: int, way: int) -> int:
        """Return the range position `raw` in increments, relative to the present demand.

        Without a range, positions repeat after 32 bits, as 6064h does.

        `way` (60F2h, rotary axis): 0 in the same turn, 1 below, 2 above, 3 the nearest.
        """
        size, low = self.range_size, self.range_low
        if size == 0:
            size, low = _SPAN, -_SPAN // 2
        demand = self._raw(demand_inc)
        target = raw + (demand - low) // size * size
        if way == 1 and target > demand:
            target -= size
        elif way == 2 and target < demand:
            target += size
        elif way == 3:
            target = demand + (target - demand + size // 2) % size - size // 2
        return self.position_inc(target)

    def _raw(self, position_inc: int) -> int:
        numerator = self.position_numerator
        if numerator == 1 and self.position_divisor == 1:
            return position_inc
        return (2 * position_inc * self.position_divisor + numerator) // (2 * numerator)

    def velocity_raw(self, velocity_inc_s: float) -> int:
        """Convert a velocity to velocity units, rounded, and limited to signed 32 bit."""
        return limited(velocity_inc_s / self.velocity_unit_inc_s * self.velocity_sign, 0x7FFF_FFFF)


@final
class FactorGroup:
    """The present `units`, as of the last `reload`."""

    def __init__(self, od: ObjectDictionary, settings: DriveSettings) -> None:
        self._od = od
        self._settings = settings
        self.units: Units = self._read()

    def reload(self) -> None:
        """Read the units again after a factor object was written."""
        self.units = self._read()

    def _read(self) -> Units:
        settings = self._settings
        return units_of(
            self._od,
            settings.plant,
            position_unit_inc=settings.position_unit_inc,
            velocity_unit_inc_s=settings.velocity_unit_inc_s,
            acceleration_unit_inc_s2=settings.acceleration_unit_inc_s2,
        )


def limited(value: float, size_max: int) -> int:
    """Return the nearest whole number within -size_max - 1 .. size_max."""
    if value >= size_max:
        return size_max
    if value <= -size_max - 1:
        return -size_max - 1
    return int(value + 0.5) if value >= 0.0 else -int(0.5 - value)


def units_of(
    od: ObjectDictionary,
    plant: MotorPlant,
    *,
    position_unit_inc: float | None,
    velocity_unit_inc_s: float | None,
    acceleration_unit_inc_s2: float | None,
) -> Units:
    """Return the units for this dictionary and motor; given numbers override the EDS."""
    if position_unit_inc is None:
        position = _position_unit(od, plant)
    else:
        position = Fraction(position_unit_inc).limit_denominator(1_000_000)
    polarity = od.integer(0x607E, 0, 0)
    low, high = od.integer(0x607B, 1, 0), od.integer(0x607B, 2, 0)
    size = high - low + 1 if low < high else 0
    return Units(
        -position.numerator if polarity & POSITION_POLARITY else position.numerator,
        position.denominator,
        velocity_unit_inc_s
        if velocity_unit_inc_s is not None
        else float(_rate_unit(od, plant, position, 0x608C, 0x6096)),
        acceleration_unit_inc_s2
        if acceleration_unit_inc_s2 is not None
        else float(_rate_unit(od, plant, position, 0x608E, 0x6097)),
        -1.0 if polarity & VELOCITY_POLARITY else 1.0,
        low,
        size if size <= 0xFFFF_FFFF else 0,
    )


def _ratio(od: ObjectDictionary, index: int) -> Fraction | None:
    """Return sub-index 1 over sub-index 2; None unless both exist and are > 0."""
    numerator = od.integer(index, 1, 0)
    divisor = od.integer(index, 2, 0)
    return Fraction(numerator, divisor) if numerator > 0 and divisor > 0 else None


def _increments_per_turn(od: ObjectDictionary, plant: MotorPlant) -> Fraction:
    """Return the encoder increments per turn of the shaft that the application sees."""
    return Fraction(plant.encoder_increments_rev) * (_ratio(od, 0x6091) or Fraction(1))


def _position_unit(od: ObjectDictionary, plant: MotorPlant) -> Fraction:
    si = od.integer(0x60A8, 0, 0)
    turns = _SI_TURNS.get(si >> 16 & 0xFF)
    if turns is not None:
        return _increments_per_turn(od, plant) * turns * _power_of_ten(si)
    resolution = _ratio(od, 0x608F)
    feed = _ratio(od, 0x6092)
    if resolution is None or feed is None or resolution != plant.encoder_increments_rev:
        return Fraction(1)
    return _increments_per_turn(od, plant) / feed


def _rate_unit(
    od: ObjectDictionary, plant: MotorPlant, position: Fraction, dimension: int, factor: int
) -> Fraction:
    """Return the rate unit in increments per second, or per second squared.

    `dimension` and `factor` are 608Ch and 6096h for velocity, 608Eh and 6097h for acceleration.
    """
    si = od.integer(0x60A9, 0, 0)
    turns = _SI_TURNS.get(si >> 16 & 0xFF)
    seconds = _SI_SECONDS.get(si >> 8 & 0xFF)
    if turns is not None and seconds is not None:
        return _increments_per_turn(od, plant) * turns * _power_of_ten(si) / seconds
    if od.integer(dimension, 0, 0) == RPM_DIMENSION:
        return Fraction(plant.encoder_increments_rev, 60)
    return position * (_ratio(od, factor) or Fraction(1))


def _power_of_ten(si: int) -> Fraction:
    exponent = (si >> 24 & 0xFF ^ 0x80) - 0x80
    return Fraction(10) ** exponent


def fill_factors(od: ObjectDictionary, plant: MotorPlant) -> None:
    """Set 608Fh, 6091h and 6092h from the plant, if visible and without a default.

    Together they then define one position unit as one increment of the encoder.
    """
    gear = Fraction(plant.gear_ratio).limit_denominator(_GEAR_DIVISOR_MAX)
    increments = plant.encoder_increments_rev
    for index, numerator, divisor in (
        (0x608F, increments, 1),
        (0x6091, gear.numerator, gear.denominator),
        (0x6092, increments * gear.numerator, gear.denominator),
    ):
        for subindex, value in ((1, numerator), (2, divisor)):
            variable = od.get(index, subindex)
            if variable is not None and not variable.has_default:
                variable.set_default(value)


@final
class DriveDefaults:
    """Defaults derived from the motor, in the drive's units.

    Attributes:
        no_load_inc_s: no-load speed at the supply's voltage.
        acceleration_inc_s2: a quarter of that speed in 0.1 s, or half of what the current allows.
        velocity, acceleration: 6081h and 6083h: a quarter of the no-load speed, and that
            acceleration.
        following_window, target_window: half a turn and 1/200 turn of the motor.
        velocity_window: 1 % of `no_load_inc_s`.
        rated_current_ma, rated_torque_mn_m: the limits of the power stage.
        motor_rpm_max: `no_load_inc_s` in rpm, rounded up.
    """

    def __init__(self, plant: MotorPlant, units: Units) -> None:
        increments = plant.encoder_increments_rev
        self.no_load_inc_s: float = plant.no_load_speed_rad_s() * plant.increments_per_rad()
        velocity_inc_s = self.no_load_inc_s / 4.0
        torque = plant.torque_constant_n_m_a * plant.current_max_a
        possible = torque / plant.inertia_kg_m2() * plant.increments_per_rad()
        self.acceleration_inc_s2: float = min(velocity_inc_s / 0.1, possible / 2.0)
        self.velocity: int = _at_least_1(velocity_inc_s / units.velocity_unit_inc_s)
        self.acceleration: int = _at_least_1(
            self.acceleration_inc_s2 / units.acceleration_unit_inc_s2
        )
        self.following_window: int = max(1, abs(units.length_raw(increments // 2)))
        self.target_window: int = max(1, abs(units.length_raw(increments // 200)))
        self.velocity_window: int = min(
            0xFFFF, _at_least_1(self.no_load_inc_s / 100.0 / units.velocity_unit_inc_s)
        )
        self.rated_current_ma: int = _at_least_1(plant.current_max_a * 1000.0)
        self.rated_torque_mn_m: int = _at_least_1(torque * 1000.0)
        # Rounded up, so that the default does not reduce the motor's speed.
        self.motor_rpm_max: int = max(1, -int(-plant.no_load_speed_rad_s() * 30.0 / PI // 1.0))


def _at_least_1(value: float) -> int:
    return max(1, min(_UNSIGNED32_MAX, limited(value, _UNSIGNED32_MAX)))
