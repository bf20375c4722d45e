"""Adaptations to drives with MIT frames, and to RobStride's drives."""

from motorhil.motorapi.adaptations.mit.hardware import MitHwMotor, MitOptions
from motorhil.motorapi.adaptations.mit.motor import ClassicalHwMotor, ClassicalOptions, MitMotor

__all__ = ["ClassicalHwMotor", "ClassicalOptions", "MitHwMotor", "MitMotor", "MitOptions"]
