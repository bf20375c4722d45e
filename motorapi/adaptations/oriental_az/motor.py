"""Adaptation to AZ drives (Oriental Motor).

| command                                  | request to the drive                               |
| ---------------------------------------- | -------------------------------------------------- |
| set-point or simple trajectory, position | operation type 1, absolute; one request starts it  |
| set-point or simple trajectory, velocity | operation type 16, continuous                      |
| stop, halt, quick stop                   | operation type 0, with the ramp of the motion      |
| homing                                   | here is 0 (35, 37); its encoder is absolute        |
"""

from typing import Final, final

from motorhil.motorapi.adaptations.modbus.polled_motor import PolledBuilder, PolledMotor
from motorhil.motorapi.adaptations.oriental_az.hardware import OrientalAzHwMotor


@final
class OrientalAzMotor(PolledMotor[OrientalAzHwMotor]):
    """A logical motor on an AZ drive; any number of them may share one hardware object."""


build: Final = PolledBuilder(OrientalAzHwMotor, OrientalAzMotor)
