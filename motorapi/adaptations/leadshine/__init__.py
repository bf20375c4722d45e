"""Adaptation for Leadshine PR drives on Modbus."""

from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.adaptations.leadshine.motor import LeadshineMotor, LeadshineParameters, build

__all__ = ["LeadshineHwMotor", "LeadshineMotor", "LeadshineParameters", "build"]
