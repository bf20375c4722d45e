"""Adaptation for MyActuator RMD actuators on CAN."""

from motorhil.motorapi.adaptations.rmd.motor import RmdHwMotor, RmdMotor, RmdOptions, build

__all__ = ["RmdHwMotor", "RmdMotor", "RmdOptions", "build"]
