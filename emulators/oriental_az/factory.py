"""Factory of AZ drives: entry point `motorhil.controllers`, name `oriental_az`."""

from collections.abc import Mapping

from emulators.controller import Controller, ControllerContext, SettingError
from emulators.firmware.own_time import on_own_time
from emulators.modbus.registers import Register
from emulators.modbus_drive import read_settings
from emulators.oriental_az.drive import OrientalAz
from emulators.oriental_az.register_map import ROWS

_CLEARS: str = "trigger_auto_clear"


def build(settings: Mapping[str, object], context: ControllerContext) -> Controller:
    """Build the drive that a rig describes.

    Args:
        settings: the controller's table without `kind` and `bus`; `trigger_auto_clear` (default
            true) sets the drive parameter of that name, whose address is not known.
        context: its name, the folder of relative paths, the seed.

    Raises:
        SettingError: a key or value is wrong; names the keys.
    """
    clears = settings.get(_CLEARS, True)
    if not isinstance(clears, bool):
        raise SettingError((_CLEARS,), f"{clears!r} is neither true nor false", "true, the default")
    read = read_settings({key: settings[key] for key in settings if key != _CLEARS}, context)
    drive = OrientalAz(read, clears)
    if not read.oscillator.is_ideal():
        drive.tell("info", read.oscillator.told())
    return on_own_time(drive, read.oscillator)


def registers() -> tuple[Register, ...]:
    """Return the register map, for display."""
    return ROWS


build.bus_kinds = ("modbus_rtu", "modbus_tcp")  # type: ignore[attr-defined]  # a plugin's mark
build.registers = registers  # type: ignore[attr-defined]  # likewise
