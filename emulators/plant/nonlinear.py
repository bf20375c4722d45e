"""Nonlinear effects of a plant, each off by default.

The base model is a linear motor with Coulomb friction. The effects belong to one motor with its
gear, load, supply and housing. Parameters of the output are in radians and newton metres at the
output. Friction and cogging of the motor are at its shaft.

- Backlash and elasticity of the gear: rotor and load are two bodies. A spring with a damper
  connects them only when the backlash is used up. Within the backlash the load moves freely.
- End stops: the load stops there and rebounds with `stop_restitution` of its speed.
- Static friction: at standstill it exceeds the Coulomb friction, and falls with the speed w as 1 /
  (1 + (w / stribeck_speed)^2) (Stribeck curve; see Armstrong-Helouvry et al., Automatica 30 (1994),
  which compares the customary forms).
- Cogging, and a load torque that depends on the position like a pendulum's: both use `wave`.
- Supply: a source with a resistance feeds the DC link's capacitor through a rectifier, so that
  braking raises its voltage. A brake chopper dissipates energy above its threshold.
- Heat: winding and housing, described by the data sheet's two thermal resistances and two time
  constants.
- I2t: the drive's own estimate for a motor whose temperature it cannot measure.
"""

from dataclasses import dataclass, fields
from typing import Final, final

NEVER_RAD: Final = 1e9  # end stop position that stands for "no end stop"
REFERENCE_C: Final = 25.0  # temperature at which data sheets give the resistance

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
"""The permitted range of each parameter; no combination overflows a double."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class PlantExtras:
    """Parameters of the nonlinear effects; immutable. With the defaults all effects are off.

    Attributes:
        backlash_rad: gear backlash from one flank to the other, at the output.
        coupling_stiffness_n_m_rad: stiffness of gear and shaft, at the output; 0: rigid, or with a
            backlash as stiff as the step allows.
        coupling_damping_n_m_s_rad: damping of gear and shaft, at the output.
        output_coulomb_friction_n_m, output_viscous_friction_n_m_s_rad: friction of the load.
        stop_low_rad, stop_high_rad: positions of the end stops, at the output.
        stop_restitution: share of the speed with which the load rebounds, 0..1.
        static_friction_n_m: friction at standstill, at the motor; 0: the Coulomb friction.
        stribeck_speed_rad_s: motor speed at which half of the excess static friction is left.
        cogging_torque_n_m: amplitude of the cogging torque, at the motor.
        cogging_periods_rev: cogging periods per motor turn.
        gravity_torque_n_m: amplitude of the position-dependent load torque, at the output.
        gravity_zero_rad: position where that torque is 0 and increases in forward direction.
        source_resistance_ohm: internal resistance of the supply; 0: an ideal supply.
        dc_link_capacitance_f: capacitance of the DC link.
        dc_link_bleed_ohm: bleed resistor of the DC link; 0: none.
        chopper_threshold_v: DC-link voltage above which the brake chopper conducts.
        chopper_resistance_ohm: resistance of the brake chopper; 0: none.
        thermal_resistance_winding_housing_k_w, thermal_resistance_housing_ambient_k_w: both > 0 if
            there is a thermal model.
        thermal_time_constant_winding_s, thermal_time_constant_motor_s: both > 0 if there is a
            thermal model.
        ambient_c: temperature of the air, and of the motor at power-on.
        copper_coefficient_1_k: temperature coefficient of the resistance (copper: 0.0039).
        i2t_continuous_a: permanently allowed current.
        i2t_peak_a: current allowed for `i2t_peak_s` from rest; 0: no I2t.
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
        """Check the parameters; each message begins with the parameter's name.

        Raises:
            ValueError: a number is not within RANGES, or two parameters contradict each other.
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
            raise ValueError(
                f"{name} = 0: does not go with the other three of the thermal model;"
                " set all four or none"
            )
        if self.copper_coefficient_1_k and not self.has_heat():
            raise ValueError(
                f"copper_coefficient_1_k = {self.copper_coefficient_1_k} needs a thermal model"
            )
        if self.i2t_peak_a and not self.i2t_peak_a > self.i2t_continuous_a > 0.0:
            raise ValueError(
                f"i2t_peak_a = {self.i2t_peak_a} A: is not above i2t_continuous_a = "
                f"{self.i2t_continuous_a} A, or the latter is 0"
            )

    def has_two_bodies(self) -> bool:
        """Return True if the load can move relative to the rotor."""
        return self.backlash_rad > 0.0 or self.coupling_stiffness_n_m_rad > 0.0

    def has_dc_link(self) -> bool:
        """Return True if the supply voltage depends on the load."""
        return self.source_resistance_ohm > 0.0

    def has_heat(self) -> bool:
        """Return True if there is a thermal model of winding and housing."""
        return self.thermal_resistance_winding_housing_k_w > 0.0

    def has_i2t(self) -> bool:
        """Return True if I2t is computed."""
        return self.i2t_peak_a > 0.0

    def is_any(self) -> bool:
        """Return True if any effect is on."""
        return self != NO_EXTRAS


NO_EXTRAS: Final = PlantExtras()
EXTRAS: Final = tuple(field.name for field in fields(PlantExtras))
