"""Adaptation for Oriental Motor AZ drives on Modbus."""

from motorhil.motorapi.adaptations.oriental_az.hardware import OrientalAzHwMotor
from motorhil.motorapi.adaptations.oriental_az.motor import (
    OrientalAzMotor,
    OrientalAzParameters,
    build,
)

__all__ = ["OrientalAzHwMotor", "OrientalAzMotor", "OrientalAzParameters", "build"]
