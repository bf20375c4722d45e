"""A permanent-magnet DC motor with gear, load, friction and an incremental encoder, as numbers.

The equations, all on the motor's side of the gear (w the rotor's speed, i the current):

    L di/dt = v - R i - K w
    J dw/dt = K i - B w - friction - load,        J = rotor + load / gear^2
    dx/dt   = w * increments per radian           (x: position in increments of the encoder)

K is torque constant and back-EMF constant in one (N m/A = V s/rad). Coulomb friction opposes the
motion with `coulomb_friction_n_m`; at standstill it holds against any torque up to that size, and
then the speed is exactly 0.0.
"""

from dataclasses import dataclass
from typing import Final, final

from emulators.plant.extras import NO_EXTRAS, PlantExtras

PI: Final = 3.141592653589793


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class MotorPlant:
    """Data-sheet numbers of one motor with its gear and load; immutable.

    Attributes:
        resistance_ohm: terminal resistance.
        inductance_h: terminal inductance.
        torque_constant_n_m_a: torque per current and back-EMF per speed.
        rotor_inertia_kg_m2: of the motor alone.
        gear_ratio: motor turns per output turn, > 0.
        load_inertia_kg_m2: at the output, >= 0.
        viscous_friction_n_m_s_rad: at the motor, >= 0.
        coulomb_friction_n_m: at the motor, >= 0; with 0 a powered axis never comes to exact rest.
        encoder_increments_rev: increments (quadrature edges) per motor turn, >= 1.
        supply_v: what the power stage can put on the motor, in either direction, > 0.
        current_max_a: what the power stage allows, in either direction, > 0.
        load_torque_n_m: at the output, constant; positive turns towards negative positions.
        extras: what it has besides; NO_EXTRAS: these equations are all.
    """

    resistance_ohm: float
    inductance_h: float
    torque_constant_n_m_a: float
    rotor_inertia_kg_m2: float
    encoder_increments_rev: int
    supply_v: float
    current_max_a: float
    coulomb_friction_n_m: float
    viscous_friction_n_m_s_rad: float = 0.0
    gear_ratio: float = 1.0
    load_inertia_kg_m2: float = 0.0
    load_torque_n_m: float = 0.0
    extras: PlantExtras = NO_EXTRAS

    def __post_init__(self) -> None:
        """Refuse numbers no motor has.

        Raises:
            ValueError: a number is not within RANGES.
        """
        for name, (low, high) in RANGES.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} = {getattr(self, name)} is outside {low:g}..{high:g}")

    def inertia_kg_m2(self) -> float:
        """Everything that turns, as felt by the motor [kg m^2]."""
        return self.rotor_inertia_kg_m2 + self.load_inertia_kg_m2 / (
            self.gear_ratio * self.gear_ratio
        )

    def increments_per_rad(self) -> float:
        """Encoder increments per radian of the motor's shaft."""
        return self.encoder_increments_rev / (2.0 * PI)

    def no_load_speed_rad_s(self) -> float:
        """Speed of the motor at the supply's voltage, friction but no load torque [rad/s], >= 0."""
        k, r = self.torque_constant_n_m_a, self.resistance_ohm
        torque = k * self.supply_v / r - self.coulomb_friction_n_m
        return max(0.0, torque / (k * k / r + self.viscous_friction_n_m_s_rad))

    def stall_torque_n_m(self) -> float:
        """Torque of the blocked motor at the supply's voltage, current limit aside [N m]."""
        return self.torque_constant_n_m_a * self.supply_v / self.resistance_ohm

    def mechanical_time_constant_s(self) -> float:
        """How fast the speed follows the voltage when L is neglected [s]; load inertia included."""
        k, r = self.torque_constant_n_m_a, self.resistance_ohm
        return self.inertia_kg_m2() / (k * k / r + self.viscous_friction_n_m_s_rad)

    def electrical_time_constant_s(self) -> float:
        """How fast the current of the blocked motor follows the voltage [s]."""
        return self.inductance_h / self.resistance_ohm


RANGES: Final[dict[str, tuple[float, float]]] = {
    "resistance_ohm": (1e-4, 1e6),
    "inductance_h": (1e-9, 1e3),
    "torque_constant_n_m_a": (1e-7, 1e4),
    "rotor_inertia_kg_m2": (1e-12, 1e6),
    "encoder_increments_rev": (1, 1 << 31),
    "supply_v": (1e-3, 1e6),
    "current_max_a": (1e-4, 1e6),
    "coulomb_friction_n_m": (0, 1e6),
    "viscous_friction_n_m_s_rad": (0, 1e6),
    "gear_ratio": (1e-4, 1e6),
    "load_inertia_kg_m2": (0, 1e9),
    "load_torque_n_m": (-1e9, 1e9),
}
"""Wider than any motor; so narrow that no combination leaves the range of a double."""
