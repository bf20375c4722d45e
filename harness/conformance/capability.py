"""What a motor may be able to do, and what a bench may be able to do to it.

A clause names what it needs of both. What the motor does not claim, or the bench cannot do, is not
applicable, with the reason; what is claimed and fails is a failure.
"""

from enum import Enum
from typing import final


@final
class Capability(Enum):
    """Something that an adaptation claims its motors can do; every other thing all motors must."""

    POSITION_SET_POINT = "set-points of position"
    VELOCITY_SET_POINT = "set-points of velocity"
    TORQUE_SET_POINT = "set-points of torque"
    CURRENT_SET_POINT = "set-points of current"
    POSITION_TRAJECTORY = "trajectories of position"
    VELOCITY_TRAJECTORY = "trajectories of velocity"
    TORQUE_TRAJECTORY = "trajectories of torque"
    COMPLEX_POSITION = "complex trajectories of position"
    COMPLEX_VELOCITY = "complex trajectories of velocity"
    LIMITED_SET_POINT = "set-points with a limit of velocity"
    MEASURED_TORQUE = "measuring torque"
    MEASURED_FOLLOWING_ERROR = "measuring the following error"
    HOMING = "homing"
    LOW_LEVEL = "low-level access"
    FAULTS = "telling faults"
    DEAD_MAN = "stopping when the host is lost"
    COMMON_TRIGGER = "starting together with others by one signal"

    @property
    def key(self) -> str:
        """What a rig file calls it."""
        return self.name.lower()


@final
class Ability(Enum):
    """Something that a bench can do, or see."""

    TRUTH = "see the true position of the motor"
    LOAD = "load the motor"
    FAULT = "make the drive fail"
    CUT = "cut a drive off the bus for a time"
    LOSE = "lose frames or answers of a drive"
    SILENCE_HOST = "keep all that the host sends off the bus"
    BUS_ERRORS = "disturb frames on a CAN bus, till a node gives up"
    AFRESH = "switch everything on anew"
    STOP_SYNC = "lose the signal that streamed motions go by"
    RESTART = "switch a drive off and on again"
    TRAFFIC = "see what commands a drive on the bus"
    SECOND_MOTOR = "move a second motor"
    SEVERAL_USERS = "have several logical motors of one physical motor"
