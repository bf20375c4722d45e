"""Adaptation for ideal motors, without any bus."""

from motorhil.motorapi.adaptations.ideal.hardware import IdealHwMotor, IdealTrigger
from motorhil.motorapi.adaptations.ideal.motor import IdealMotor, build

__all__ = ["IdealHwMotor", "IdealMotor", "IdealTrigger", "build"]
