"""Adaptation for Leadshine PR drives on Modbus."""

from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.adaptations.leadshine.motor import LeadshineMotor, build

__all__ = ["LeadshineHwMotor", "LeadshineMotor", "build"]
