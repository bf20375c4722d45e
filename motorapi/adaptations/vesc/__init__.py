"""Adaptation for VESC motor controllers on CAN."""

from motorhil.motorapi.adaptations.vesc.motor import VescHwMotor, VescMotor, VescOptions, build

__all__ = ["VescHwMotor", "VescMotor", "VescOptions", "build"]
