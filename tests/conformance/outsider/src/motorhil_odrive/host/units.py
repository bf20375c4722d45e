"""Turns of the motor, which an ODrive counts in, and the units of the motor interface.

The motor model's gear ratio says how many turns of the motor make one of the output, or a metre,
and by its sign which way it goes. Torque is told at the motor's shaft: a gear is taken to lose
nothing. Floats have 24 bits on the wire, so numbers are rounded here as they will be there.
"""

import struct
from dataclasses import replace
from math import tau
from typing import TYPE_CHECKING, Final, final

from motorapi.commands import ControlVariable, Motion
from motorapi.errors import UsageError
from motorapi.model import MotionKind

if TYPE_CHECKING:
    from motorapi.model import MotorModel

_ROUNDING: Final = 1e-9


@final
class Units:
    """What 1 means to this motor's drive.

    Raises:
        UsageError: the model does not tell the gear ratio.
    """

    def __init__(self, model: "MotorModel") -> None:
        linear = model.kind is MotionKind.LINEAR
        if model.gear_ratio is None:
            key = "motor_turns_per_m" if linear else "gear_ratio"
            raise UsageError(
                f"motor model {model.name}: {key} is not given, and an ODrive counts turns of the"
                f" motor; add it ({key} = 1.0, if there is no gear)"
            )
        self.rev: Final = model.gear_ratio / (1.0 if linear else tau)
        """Turns of the motor per U, signed."""
        self.n_m: Final = 1.0 / (tau * model.gear_ratio if linear else model.gear_ratio)
        """Torque at the motor per N m (or N) at the output, signed."""

    def of(self, variable: ControlVariable) -> float:
        """What the drive is told for 1 of this variable."""
        return self.n_m if variable is ControlVariable.TORQUE else self.rev

    def rounded(self, motion: Motion) -> Motion:
        """The motion in numbers that a frame can hold."""
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
    """The nearest number that four bytes hold."""
    (rounded,) = struct.unpack("<f", struct.pack("<f", value))
    return float(rounded)


def single_below(value: float) -> float:
    """The nearest one > 0 that is not above `value` > 0; what is one already stays."""
    nearest = single(value)
    if nearest <= value * (1.0 + _ROUNDING / 1e3):
        return nearest
    (bits,) = struct.unpack("<I", struct.pack("<f", nearest))
    (below,) = struct.unpack("<f", struct.pack("<I", bits - 1))
    return float(below)
