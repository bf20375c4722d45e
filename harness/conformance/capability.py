"""Capabilities of a motor, and abilities of a bench.

A clause names the capabilities and abilities that it needs. If the motor or bench does not have
one, the clause is not applicable, and the reason is reported. A claimed capability that does not
work is a failure.
"""

from enum import Enum
from typing import final


@final
class Capability(Enum):
    """An optional capability that an adaptation claims; everything else is mandatory."""

    POSITION_SET_POINT = "position set-points"
    VELOCITY_SET_POINT = "velocity set-points"
    TORQUE_SET_POINT = "torque set-points"
    CURRENT_SET_POINT = "current set-points"
    POSITION_TRAJECTORY = "position trajectories"
    VELOCITY_TRAJECTORY = "velocity trajectories"
    TORQUE_TRAJECTORY = "torque trajectories"
    COMPLEX_POSITION = "complex position trajectories"
    COMPLEX_VELOCITY = "complex velocity trajectories"
    LIMITED_SET_POINT = "set-points with a velocity limit"
    MEASURED_TORQUE = "torque measurement"
    MEASURED_FOLLOWING_ERROR = "following error measurement"
    HOMING = "homing"
    LOW_LEVEL = "low-level access"
    FAULTS = "fault reports"
    DEAD_MAN = "stopping when the host is lost"
    COMMON_TRIGGER = "starting together by a common signal"

    @property
    def key(self) -> str:
        """The name of the capability in rig files."""
        return self.name.lower()


@final
class Ability(Enum):
    """Something that a bench can do or see."""

    TRUTH = "see the true position of the motor"
    LOAD = "load the motor"
    FAULT = "cause a drive fault"
    CUT = "cut a drive off the bus for a time"
    LOSE = "lose frames or answers of a drive"
    SILENCE_HOST = "drop everything the host sends"
    BUS_ERRORS = "disturb frames on a CAN bus until a node goes bus-off"
    AFRESH = "switch everything off and on again"
    STOP_SYNC = "stop the signal that clocks streamed motions"
    RESTART = "switch a drive off and on again"
    TRAFFIC = "see the commands sent to a drive"
    SECOND_MOTOR = "move a second motor"
    SEVERAL_USERS = "create several logical motors for one physical motor"
