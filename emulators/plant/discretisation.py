"""Exact sampled-data models of the plant for one step.

Voltage and torque are held during the step. All matrices are computed once, when an axis is built.
Plain Python with + - * / gives bit-identical numbers on every machine.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

from emulators.plant.dc_motor import MotorPlant

Matrix = list[list[float]]

_TAYLOR_TERMS: Final = 18  # for a norm <= 1/2 the remainder is below 1e-21


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
