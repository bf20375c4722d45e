"""What a drive is to hold beside a motion's own mode, profile and target, when it begins.

That is the logical motor's parameters; and what a motion needs for its time alone, which the drive
has back afterwards: a slope of torque, a quick stop within the model's limit, the ramp of a halt.
"""

from motorapi.adaptations.cia402_hardware import Cia402HwMotor
from motorapi.adaptations.cia402_parameters import (
    HALT_OPTION,
    WINDOW_OFF,
    Cia402Parameters,
    Place,
)
from motorapi.adaptations.drive_reader import DriveReader
from motorapi.adaptations.drive_torque import STEEPEST, torque_profile_of
from motorapi.commands import ControlVariable, Motion


def settings_of(
    motion: Motion, parameters: Cia402Parameters, hardware: Cia402HwMotor, reader: DriveReader
) -> dict[Place, int]:
    """By object, what the drive is to hold; of all others it has its own value.

    Raises:
        LimitError: it does not fit the drive.
    """
    units = reader.known()[0]
    wanted = parameters.objects(units)
    if motion.function is not None:
        # A quick stop in mid-stream is no harder than the model allows.
        own = hardware.parameters.own((0x6085, 0))
        if own is None:
            own = hardware.objects.read_optional(0x6085)
        highest = units.acceleration_raw(motion.deceleration)
        if own is not None and (own == 0 or own > highest):
            wanted[0x6085, 0] = highest
    elif motion.variable is ControlVariable.TORQUE:
        slope = torque_profile_of(motion, reader.torque_unit()).slope
        if slope is not None and slope != STEEPEST:
            wanted[0x6087, 0] = slope
    return wanted | _halt_settings(motion, hardware, reader)


def _halt_settings(
    motion: Motion, hardware: Cia402HwMotor, reader: DriveReader
) -> dict[Place, int]:
    """What makes a halt slow down as the motion says; nothing, if it says nothing of its own.

    605Dh = 1 is the motion's own ramp, 6084h; 2 is that of a quick stop, 6085h, which then is as
    steep as the motion says, for its time.
    """
    asked = motion.stop_deceleration
    if asked is None or hardware.objects.read_optional(HALT_OPTION) is None:
        return {}
    units = reader.known()[0]
    steepest = units.acceleration_raw(asked)
    if steepest == units.acceleration_raw(motion.deceleration):
        return {(HALT_OPTION, 0): 1}
    return {(HALT_OPTION, 0): 2, (0x6085, 0): steepest}


def window_of(
    parameters: Cia402Parameters, hardware: Cia402HwMotor, reader: DriveReader
) -> int | None:
    """How near the target is reached [increments]; None: the drive does not say."""
    units, limits = reader.known()
    if parameters.position_window is not None:
        return parameters.objects(units)[0x6067, 0]
    own = hardware.parameters.own((0x6067, 0))
    return limits.window if own is None else (None if own == WINDOW_OFF else own)
