"""Adaptation for CiA 402 drives on CANopen."""

from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor, build
from motorhil.motorapi.adaptations.cia402.parameters import Cia402Parameters

__all__ = ["Cia402HwMotor", "Cia402Motor", "Cia402Parameters", "HwOptions", "build"]
