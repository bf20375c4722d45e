"""What a plant may have besides a linear motor with dry friction; each off unless it is asked for.

All of it is physics of one motor with its gear, load, supply and housing. What is said at the
output is in the output's radians and newton metres, friction and cogging of the motor at its shaft.

- Play and elasticity in the gear: rotor and load are two bodies. Between them is a spring with a
  damper, which touches only when the play is used up; in the play the load is on its own.
- Ends of the way: the load goes no further and springs back with `stop_restitution` of its speed.
- Static friction: at standstill more than the Coulomb friction, falling with the speed w as
  1 / (1 + (w / stribeck_speed)^2) (Stribeck's curve; see Armstrong-Helouvry et al., Automatica 30
  (1994), which compares its customary forms).
- Cogging, and a load that goes with the position as a pendulum's does: waves of one shape, see
  `wave`.
- Supply: a source behind a resistance feeds the DC link's capacitor through a rectifier, so that
  braking raises its voltage; a chopper burns what is above its threshold.
- Heat: winding and housing, as two thermal resistances and two time constants in data sheets.
- I2t: what a drive reckons of a motor it cannot measure.
"""

from dataclasses import dataclass, fields
from typing import Final, final

NEVER_RAD: Final = 1e9  # as far away as an end of the way may be: there is none
REFERENCE_C: Final = 25.0  # at which data sheets give the resistance


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class PlantExtras:
    """Immutable; the defaults are a plant without any of it.

    Attributes:
        backlash_rad: play of the gear from one flank to the other, at the output.
        coupling_stiffness_n_m_rad: of gear and shaft, at the output; 0: rigid, or with a backlash
            as stiff as can be stepped.
        coupling_damping_n_m_s_rad: of the same.
        output_coulomb_friction_n_m, output_viscous_friction_n_m_s_rad: of the load.
        stop_low_rad, stop_high_rad: the ends of the way, at the output.
        stop_restitution: share of the speed with which the load springs back, 0..1.
        static_friction_n_m: at the motor, at standstill; 0: the Coulomb friction.
        stribeck_speed_rad_s: at which half of what it is more has gone, at the motor.
        cogging_torque_n_m: its largest, at the motor.
        cogging_periods_rev: of it in a turn of the motor.
        gravity_torque_n_m: the load's largest by its position, at the output.
        gravity_zero_rad: where it is 0, turning forward against a growing torque.
        source_resistance_ohm: of the supply; 0: it is ideal.
        dc_link_capacitance_f: of the DC link.
        dc_link_bleed_ohm: what empties it; 0: nothing but the motor.
        chopper_threshold_v: above which the brake chopper takes current.
        chopper_resistance_ohm: through which; 0: there is no chopper.
        thermal_resistance_winding_housing_k_w, thermal_resistance_housing_ambient_k_w: both > 0
            if there is a thermal model.
        thermal_time_constant_winding_s, thermal_time_constant_motor_s: the same.
        ambient_c: of the air, and of the motor at power-on.
        copper_coefficient_1_k: by which the resistance rises with the temperature (copper: 0.0039).
        i2t_continuous_a: which may flow for ever.
        i2t_peak_a: which may flow from rest for `i2t_peak_s`; 0: there is no I2t.
    """

    backlash_rad: float = 0.0
    coupling_stiffness_n_m_rad: float = 0.0
    coupling_damping_n_m_s_rad: float = 0.0
    output_coulomb_friction_n_m: float = 0.0
    output_viscous_friction_n_m_s_rad: float = 0.0
    stop_low_rad: float = -NEVER_RAD
    stop_high_rad: float = NEVER_RAD
    stop_restitution: float = 0.0
    static_friction_n_m: float = 0.0
    stribeck_speed_rad_s: float = 1.0
    cogging_torque_n_m: float = 0.0
    cogging_periods_rev: int = 1
    gravity_torque_n_m: float = 0.0
    gravity_zero_rad: float = 0.0
    source_resistance_ohm: float = 0.0
    dc_link_capacitance_f: float = 1e-3
    dc_link_bleed_ohm: float = 0.0
    chopper_threshold_v: float = 1e6
    chopper_resistance_ohm: float = 0.0
    thermal_resistance_winding_housing_k_w: float = 0.0
    thermal_resistance_housing_ambient_k_w: float = 0.0
    thermal_time_constant_winding_s: float = 0.0
    thermal_time_constant_motor_s: float = 0.0
    ambient_c: float = REFERENCE_C
    copper_coefficient_1_k: float = 0.0
    i2t_continuous_a: float = 0.0
    i2t_peak_a: float = 0.0
    i2t_peak_s: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what cannot be; the message begins with the name it is about.

        Raises:
            ValueError: a number is not within RANGES, or two do not go together.
        """
        for name, (low, high) in RANGES.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} = {getattr(self, name)} is outside {low:g}..{high:g}")
        if not self.stop_low_rad < self.stop_high_rad:
            raise ValueError(
                f"stop_low_rad = {self.stop_low_rad} rad is not below stop_high_rad,"
                f" {self.stop_high_rad} rad"
            )
        thermal = [getattr(self, name) for name in _THERMAL]
        if any(thermal) and not all(thermal):
            name = _THERMAL[thermal.index(0.0)]
            raise ValueError(f"{name} = 0 does not go with the other three of the thermal model")
        if self.copper_coefficient_1_k and not self.has_heat():
            raise ValueError(
                f"copper_coefficient_1_k = {self.copper_coefficient_1_k} needs a thermal model"
            )
        if self.i2t_peak_a and not self.i2t_peak_a > self.i2t_continuous_a > 0.0:
            raise ValueError(
                f"i2t_peak_a = {self.i2t_peak_a} A is not above i2t_continuous_a,"
                f" {self.i2t_continuous_a} A, or that is 0"
            )

    def has_two_bodies(self) -> bool:
        """Whether the load can move against the rotor."""
        return self.backlash_rad > 0.0 or self.coupling_stiffness_n_m_rad > 0.0

    def has_dc_link(self) -> bool:
        """Whether the supply's voltage depends on the load."""
        return self.source_resistance_ohm > 0.0

    def has_heat(self) -> bool:
        """Whether winding and housing get warm."""
        return self.thermal_resistance_winding_housing_k_w > 0.0

    def has_i2t(self) -> bool:
        """Whether I2t is reckoned."""
        return self.i2t_peak_a > 0.0

    def is_any(self) -> bool:
        """Whether anything is asked for."""
        return self != NO_EXTRAS


_THERMAL: Final = (
    "thermal_resistance_winding_housing_k_w",
    "thermal_resistance_housing_ambient_k_w",
    "thermal_time_constant_winding_s",
    "thermal_time_constant_motor_s",
)

RANGES: Final[dict[str, tuple[float, float]]] = {
    "backlash_rad": (0, 6.2832),
    "coupling_stiffness_n_m_rad": (0, 1e12),
    "coupling_damping_n_m_s_rad": (0, 1e9),
    "output_coulomb_friction_n_m": (0, 1e9),
    "output_viscous_friction_n_m_s_rad": (0, 1e9),
    "stop_low_rad": (-NEVER_RAD, NEVER_RAD),
    "stop_high_rad": (-NEVER_RAD, NEVER_RAD),
    "stop_restitution": (0, 1),
    "static_friction_n_m": (0, 1e6),
    "stribeck_speed_rad_s": (1e-6, 1e6),
    "cogging_torque_n_m": (0, 1e6),
    "cogging_periods_rev": (1, 100_000),
    "gravity_torque_n_m": (-1e9, 1e9),
    "gravity_zero_rad": (-NEVER_RAD, NEVER_RAD),
    "source_resistance_ohm": (0, 1e6),
    "dc_link_capacitance_f": (1e-9, 1e3),
    "dc_link_bleed_ohm": (0, 1e9),
    "chopper_threshold_v": (0, 1e6),
    "chopper_resistance_ohm": (0, 1e6),
    "thermal_resistance_winding_housing_k_w": (0, 1e6),
    "thermal_resistance_housing_ambient_k_w": (0, 1e6),
    "thermal_time_constant_winding_s": (0, 1e7),
    "thermal_time_constant_motor_s": (0, 1e7),
    "ambient_c": (-200, 300),
    "copper_coefficient_1_k": (0, 0.1),
    "i2t_continuous_a": (0, 1e6),
    "i2t_peak_a": (0, 1e6),
    "i2t_peak_s": (1e-3, 1e6),
}
"""Wider than any drive's; so narrow that no combination leaves the range of a double."""

NO_EXTRAS: Final = PlantExtras()
EXTRAS: Final = tuple(field.name for field in fields(PlantExtras))
