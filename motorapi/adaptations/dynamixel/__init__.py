"""Adaptation for Dynamixel servos of the X series, Protocol 2.0."""

from motorhil.motorapi.adaptations.dynamixel.hardware import DynamixelHwMotor
from motorhil.motorapi.adaptations.dynamixel.motor import DynamixelMotor, build

__all__ = ["DynamixelHwMotor", "DynamixelMotor", "build"]
