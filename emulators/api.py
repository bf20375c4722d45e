"""The controller API: all that a third party's emulated drive may import, and enough.

An emulated drive implements `Controller`, and is built by a function that `controller` marks;
`MotorDrive` and `drive_builder` have all but protocol and states. The motor on its shaft is
motorhil's: `axis_of` makes plant, servo and profile generator from the keys that all drives share
(`MotorTable`).

`VERSION` grows when a name or a promise changes; the old name then stays for one release. Names of
other modules of motorhil may change at any time.
"""

from motorhil.emulators.can.frame import (
    BRS,
    EFF_FLAG,
    ERR_FLAG,
    FD_FRAME_BYTES,
    FD_LENGTHS,
    RTR_FLAG,
    can_id_of,
    data_of,
    pack,
    pack_fd,
    pack_remote,
)
from motorhil.emulators.controller import (
    API_VERSION as VERSION,
)
from motorhil.emulators.controller import (
    Controller,
    ControllerContext,
    NonvolatileMemory,
    controller,
)
from motorhil.emulators.firmware import flags
from motorhil.emulators.firmware.axis import NEVER_NS, Axis
from motorhil.emulators.firmware.clock import on_own_time
from motorhil.emulators.modbus.rtu import with_crc
from motorhil.emulators.motor_drive import (
    CanMotorDrive,
    MotorDrive,
    drive_builder,
    of_code,
    to_code,
    truncated,
)
from motorhil.emulators.plant.dc_motor import RANGES, MotorPlant
from motorhil.emulators.settings.motor import MotorSettings, MotorTable, axis_of
from motorhil.emulators.settings.tables import ns
from motorhil.settings import (
    REQUIRED,
    Number,
    SettingError,
    TablesByKey,
    amount,
    flag,
    nearest,
    number,
    positive,
    read,
    setting,
    table,
    text,
    whole,
    word,
)

__all__ = [
    "BRS",
    "EFF_FLAG",
    "ERR_FLAG",
    "FD_FRAME_BYTES",
    "FD_LENGTHS",
    "NEVER_NS",
    "RANGES",
    "REQUIRED",
    "RTR_FLAG",
    "VERSION",
    "Axis",
    "CanMotorDrive",
    "Controller",
    "ControllerContext",
    "MotorDrive",
    "MotorPlant",
    "MotorSettings",
    "MotorTable",
    "NonvolatileMemory",
    "Number",
    "SettingError",
    "TablesByKey",
    "amount",
    "axis_of",
    "can_id_of",
    "controller",
    "data_of",
    "drive_builder",
    "flag",
    "flags",
    "nearest",
    "ns",
    "number",
    "of_code",
    "on_own_time",
    "pack",
    "pack_fd",
    "pack_remote",
    "positive",
    "read",
    "setting",
    "table",
    "text",
    "to_code",
    "truncated",
    "whole",
    "with_crc",
    "word",
]
