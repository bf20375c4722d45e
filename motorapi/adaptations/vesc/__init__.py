"""Adaptation for VESC motor controllers on CAN."""

from motorhil.motorapi.adaptations.vesc.hardware import VescHwMotor, VescOptions
from motorhil.motorapi.adaptations.vesc.motor import VescMotor, build

__all__ = ["VescHwMotor", "VescMotor", "VescOptions", "build"]
