"""Conversion between turns of the motor and units of the motor interface.

An ODrive counts turns of its motor. The motor model's gear ratio gives the turns per turn of the
output, or per metre, and the direction by its sign. Torque is that of the motor's shaft; the gear
is assumed to have no losses. Floats have 24 bits on the wire, so numbers are rounded here in
advance.
"""

import struct
from dataclasses import replace
from math import tau
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.api import ControlVariable, Motion, MotionKind, motor_turns

if TYPE_CHECKING:
    from motorhil.motorapi.api import MotorModel

_ROUNDING: Final = 1e-9


@final
class Units:
    """The units of this motor's drive.

    Raises:
        UsageError: the model has no gear ratio.
    """

    def __init__(self, model: "MotorModel") -> None:
        self.rev: Final = motor_turns(model)
        """Turns of the motor per U, signed."""
        way = tau if model.kind is MotionKind.LINEAR else 1.0
        self.n_m: Final = 1.0 / (way * (model.gear_ratio or 1.0))
        """Torque at the motor per N m (or N) at the output, signed."""

    def of(self, variable: ControlVariable) -> float:
        """Return the drive's value for 1 of this variable."""
        return self.n_m if variable is ControlVariable.TORQUE else self.rev

    def rounded(self, motion: Motion) -> Motion:
        """Return the motion, rounded to numbers that a frame can hold."""
        size = abs(self.rev)
        per = self.of(motion.variable)
        if motion.variable is not ControlVariable.POSITION:
            return replace(motion, target=single(motion.target * per) / per)
        return replace(
            motion,
            target=single(motion.target * per) / per,
            velocity=single_below(motion.velocity * size) / size,
            acceleration=single_below(motion.acceleration * size) / size,
            deceleration=single_below(motion.deceleration * size) / size,
        )


def single(value: float) -> float:
    """Return the nearest single-precision float."""
    (rounded,) = struct.unpack("<f", struct.pack("<f", value))
    return float(rounded)


def single_below(value: float) -> float:
    """Return the largest single-precision float > 0 that does not exceed `value` > 0."""
    nearest = single(value)
    if nearest <= value * (1.0 + _ROUNDING / 1e3):
        return nearest
    (bits,) = struct.unpack("<I", struct.pack("<f", nearest))
    (below,) = struct.unpack("<f", struct.pack("<I", bits - 1))
    return float(below)
