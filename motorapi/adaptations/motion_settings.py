"""Objects to write to a drive when a motion begins.

They are the logical motor's parameters, and settings for this motion alone: a torque slope, a quick
stop within the model's limit, the ramp of a halt. The drive gets its own values back afterwards.
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
    """Return the values to write, by object; all other objects get the drive's own values.

    Raises:
        LimitError: a value does not fit the drive.
    """
    units = reader.known()[0]
    wanted = parameters.objects(units)
    if motion.function is not None:
        # A quick stop in mid-stream must not exceed the model's deceleration.
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
    """Return the settings for a halt with the motion's own deceleration, if it has one.

    605Dh = 1 selects the motion's own ramp, 6084h. 2 selects the quick stop ramp, 6085h, which is
    set to the motion's deceleration meanwhile.
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
    """Return the position window of the target [increments], or None if the drive has none."""
    units, limits = reader.known()
    if parameters.position_window is not None:
        return parameters.objects(units)[0x6067, 0]
    own = hardware.parameters.own((0x6067, 0))
    return limits.window if own is None else (None if own == WINDOW_OFF else own)
