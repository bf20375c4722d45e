"""Motor-dependent values for objects without a value in EDS and rig."""

from fractions import Fraction
from typing import Final, final

from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.cia402.units import Units, limited
from emulators.plant.dc_motor import PI, MotorPlant

_UNSIGNED32_MAX: Final = 0xFFFF_FFFF
_GEAR_DIVISOR_MAX: Final = 10_000


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
        motor_rpm_max: `no_load_inc_s` in rpm.
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
        self.motor_rpm_max: int = _at_least_1(plant.no_load_speed_rad_s() * 30.0 / PI)


def _at_least_1(value: float) -> int:
    return max(1, min(_UNSIGNED32_MAX, limited(value, _UNSIGNED32_MAX)))
