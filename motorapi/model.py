"""What is constant of a motor, whatever the application: limits, resolution, kind."""

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import final


@final
class MotionKind(Enum):
    """Whether the unit U of position is rad or m."""

    ROTARY = "rotary"
    LINEAR = "linear"


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class MotorModel:
    """The motor model (paper, 3.2): limits and units, immutable, shared between copies.

    U is rad or m, after `kind`. None means: no limit, or not known.
    """

    name: str
    kind: MotionKind = MotionKind.ROTARY
    velocity_max: float  # [U/s]
    acceleration_max: float  # [U/s²]
    deceleration_max: float | None = None  # [U/s²]; None: as acceleration_max
    jerk_max: float | None = None  # [U/s³]
    torque_max: float | None = None  # [N·m], linear: [N]
    current_max: float | None = None  # [A]
    position_min: float | None = None  # [U]
    position_max: float | None = None  # [U]
    position_tolerance: float | None = None  # [U]; see start_tolerance
    increments_per_unit: float | None = None  # position increments of the drive per U, signed
    velocity_unit: float | None = None  # what 1 in the drive's velocity objects means [U/s]
    acceleration_unit: float | None = None  # likewise for acceleration [U/s²]
    requires_referencing: bool = False

    @classmethod
    def load(cls, path: str | Path) -> "MotorModel":
        """The model in a TOML file."""
        raise NotImplementedError
