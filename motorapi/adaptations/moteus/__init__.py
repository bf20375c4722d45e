"""Adaptation of the motor interface to moteus controllers of mjbots, on CAN FD."""

from motorhil.motorapi.adaptations.moteus.motor import (
    MoteusHwMotor,
    MoteusMotor,
    MoteusOptions,
    MoteusTable,
    build,
)

__all__ = ["MoteusHwMotor", "MoteusMotor", "MoteusOptions", "MoteusTable", "build"]
