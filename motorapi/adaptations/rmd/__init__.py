"""Adaptation for MyActuator RMD actuators on CAN."""

from motorhil.motorapi.adaptations.rmd.hardware import RmdHwMotor, RmdOptions
from motorhil.motorapi.adaptations.rmd.motor import RmdMotor, build

__all__ = ["RmdHwMotor", "RmdMotor", "RmdOptions", "build"]
