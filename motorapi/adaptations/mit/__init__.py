"""Adaptations to drives with MIT frames, and to RobStride's drives."""

from motorhil.motorapi.adaptations.mit.hardware import MitHwMotor, MitOptions
from motorhil.motorapi.adaptations.mit.motor import MitMotor

__all__ = ["MitHwMotor", "MitMotor", "MitOptions"]
