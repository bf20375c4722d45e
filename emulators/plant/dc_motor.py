"""A permanent-magnet DC motor with gear, load and encoder.

All equations are on the motor's side of the gear (w is the rotor speed, i the current):

  L di/dt = v - R i - K w
  J dw/dt = K i - B w - friction - load,    J = rotor + load / gear^2
  dx/dt   = w * increments per radian       (x: position in increments of the encoder)

K is both the torque constant and the back-EMF constant (N m/A = V s/rad). Coulomb friction opposes
the motion with `coulomb_friction_n_m`. At standstill it holds against any torque up to that value,
and the speed is then exactly 0.0.

The sampled-data models are exact. Voltage and torque are held during the step. All matrices are
computed once, when an axis is built. Plain Python with + - * / gives bit-identical numbers on every
machine.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

from motorhil.emulators.plant.nonlinear import NO_EXTRAS, PlantExtras

PI: Final = 3.141592653589793

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
"""The permitted range of each parameter; no combination overflows a double."""

Matrix = list[list[float]]

_TAYLOR_TERMS: Final = 18  # for a norm <= 1/2 the remainder is below 1e-21


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class MotorPlant:
    """Data-sheet values of one motor with its gear and load; immutable.

    Attributes:
        resistance_ohm: terminal resistance.
        inductance_h: terminal inductance.
        torque_constant_n_m_a: torque per current, and back-EMF per speed.
        rotor_inertia_kg_m2: inertia of the motor alone.
        gear_ratio: motor turns per output turn, > 0.
        load_inertia_kg_m2: inertia at the output, >= 0.
        viscous_friction_n_m_s_rad: at the motor, >= 0.
        coulomb_friction_n_m: at the motor, >= 0; with 0 a powered axis never comes to exact rest.
        encoder_increments_rev: increments (quadrature edges) per motor turn, >= 1.
        supply_v: voltage that the power stage can apply, in either direction, > 0.
        current_max_a: current that the power stage allows, in either direction, > 0.
        load_torque_n_m: constant torque at the output; positive acts towards negative positions.
        extras: nonlinear effects; NO_EXTRAS if the equations above are complete.
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
        """Check that every number is plausible for a motor.

        Raises:
            ValueError: a number is not within RANGES.
        """
        for name, (low, high) in RANGES.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} = {getattr(self, name)} is outside {low:g}..{high:g}")

    def inertia_kg_m2(self) -> float:
        """Return the total inertia on the motor's side of the gear [kg m^2]."""
        return self.rotor_inertia_kg_m2 + self.load_inertia_kg_m2 / (
            self.gear_ratio * self.gear_ratio
        )

    def increments_per_rad(self) -> float:
        """Return the encoder increments per radian of the motor shaft."""
        return self.encoder_increments_rev / (2.0 * PI)

    def no_load_speed_rad_s(self) -> float:
        """Return the no-load speed of the motor at supply voltage, with friction [rad/s], >= 0."""
        k, r = self.torque_constant_n_m_a, self.resistance_ohm
        torque = k * self.supply_v / r - self.coulomb_friction_n_m
        return max(0.0, torque / (k * k / r + self.viscous_friction_n_m_s_rad))

    def stall_torque_n_m(self) -> float:
        """Return the stall torque at supply voltage, without the current limit [N m]."""
        return self.torque_constant_n_m_a * self.supply_v / self.resistance_ohm

    def mechanical_time_constant_s(self) -> float:
        """Return the mechanical time constant for L = 0, including the load inertia [s]."""
        k, r = self.torque_constant_n_m_a, self.resistance_ohm
        return self.inertia_kg_m2() / (k * k / r + self.viscous_friction_n_m_s_rad)

    def electrical_time_constant_s(self) -> float:
        """Return the electrical time constant L / R of the blocked motor [s]."""
        return self.inductance_h / self.resistance_ohm


def identity(size: int) -> Matrix:
    """Return the unit matrix, (size, size)."""
    return [[1.0 if row == column else 0.0 for column in range(size)] for row in range(size)]


def product(left: Matrix, right: Matrix) -> Matrix:
    """Return the matrix product, summed from the first column to the last."""
    columns = range(len(right[0]))
    return [[dot(row, [line[c] for line in right]) for c in columns] for row in left]


def dot(left: Sequence[float], right: Sequence[float]) -> float:
    """Return the inner product, summed in order (`sum` differs between Python versions)."""
    total = 0.0
    for a, b in zip(left, right, strict=True):
        total += a * b
    return total


def exponential(matrix: Matrix) -> Matrix:
    """Return the matrix exponential by scaling, Taylor series and squaring."""
    norm = max(dot([abs(value) for value in row], [1.0] * len(row)) for row in matrix)
    squarings = 0
    while norm > 0.5:
        norm *= 0.5
        squarings += 1
    scale = 1.0
    for _ in range(squarings):
        scale *= 0.5
    scaled = [[value * scale for value in row] for row in matrix]
    result = identity(len(matrix))
    for term in range(_TAYLOR_TERMS, 0, -1):  # Horner: 1 + M (1 + M/2 (1 + M/3 ...))
        result = product(scaled, result)
        result = [[value / term for value in row] for row in result]
        for index in range(len(matrix)):
            result[index][index] += 1.0
    for _ in range(squarings):
        result = product(result, result)
    return result


@final
@dataclass(frozen=True, slots=True)
class SampledMotor:
    """One exact step of the motor with voltage and torque held.

    Rows of `driven`: current [A], speed [rad/s] and position [increments] after the step. Its
    columns: the same three before the step, voltage [V], external torque on the shaft [N m].
    `coasting` is the same without current: rows speed, position; columns speed, position, torque.
    The current of a blocked motor becomes `blocked_decay` * current + `blocked_gain_a_v` * voltage.
    """

    step_s: float
    driven: Matrix
    coasting: Matrix
    blocked_decay: float
    blocked_gain_a_v: float


def sample(plant: MotorPlant, step_s: float) -> SampledMotor:
    """Return the model of the plant for one step of `step_s` [s]."""
    resistance, inductance = plant.resistance_ohm, plant.inductance_h
    k, friction = plant.torque_constant_n_m_a, plant.viscous_friction_n_m_s_rad
    inertia, scale = plant.inertia_kg_m2(), plant.increments_per_rad()
    driven = [
        [-resistance / inductance, -k / inductance, 0.0, 1.0 / inductance, 0.0],
        [k / inertia, -friction / inertia, 0.0, 0.0, 1.0 / inertia],
        [0.0, scale, 0.0, 0.0, 0.0],
        [0.0] * 5,
        [0.0] * 5,
    ]
    coasting = [
        [-friction / inertia, 0.0, 1.0 / inertia],
        [scale, 0.0, 0.0],
        [0.0] * 3,
    ]
    decay = exponential([[-resistance / inductance * step_s]])[0][0]
    return SampledMotor(
        step_s=step_s,
        driven=exponential([[value * step_s for value in row] for row in driven])[:3],
        coasting=exponential([[value * step_s for value in row] for row in coasting])[:2],
        blocked_decay=decay,
        blocked_gain_a_v=(1.0 - decay) / resistance,
    )
