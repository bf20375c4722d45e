"""Trajectories as light, immutable values; generating them is somebody else's work."""

from dataclasses import dataclass
from typing import final

from motorapi.commands import DerivativeLimits


@final
@dataclass(frozen=True, slots=True)
class TrapezoidalTrajectory:
    """The simplest motion that satisfies its boundary conditions, at rest at both ends."""

    final: float
    initial: float | None = None
    limits: DerivativeLimits | None = None
    duration_s: float | None = None
