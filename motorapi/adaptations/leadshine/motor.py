"""Adaptation to drives with a path table (Leadshine, StepperOnline).

| command                                  | request to the drive                                  |
| ---------------------------------------- | ----------------------------------------------------- |
| set-point or simple trajectory, position | path 0, absolute, interrupting; one request starts it |
| set-point or simple trajectory, velocity | path 0, velocity                                      |
| stop, halt, quick stop                   | trigger 40h, with the ramp of the motion              |
| homing                                   | here (35, 37), limit (17, 18) or home switch (19, 21) |
"""

from typing import Final, final

from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.adaptations.modbus.polled_motor import PolledBuilder, PolledMotor


@final
class LeadshineMotor(PolledMotor[LeadshineHwMotor]):
    """A logical motor on a PR-mode drive; any number of them may share one hardware object."""


build: Final = PolledBuilder(LeadshineHwMotor, LeadshineMotor)
