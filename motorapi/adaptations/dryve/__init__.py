"""Adaptation for the igus dryve D1 on Modbus TCP."""

from motorhil.motorapi.adaptations.dryve.hardware import DryveHwMotor
from motorhil.motorapi.adaptations.dryve.motor import DryveMotor, build

__all__ = ["DryveHwMotor", "DryveMotor", "build"]
