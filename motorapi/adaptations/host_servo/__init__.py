"""Adaptation for CiA 401 I/O nodes with the servo on the host."""

from motorhil.motorapi.adaptations.host_servo.motor import SoftwareMotor, build

__all__ = ["SoftwareMotor", "build"]
