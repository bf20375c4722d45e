"""Factory of PR-mode drives: entry point `motorhil.controllers`, name `leadshine_pr`."""

from collections.abc import Mapping

from emulators.controller import Controller, ControllerContext
from emulators.firmware.own_time import on_own_time
from emulators.leadshine_pr.drive import LeadshinePr
from emulators.leadshine_pr.register_map import ROWS
from emulators.modbus.registers import Register
from emulators.modbus_drive import read_settings


def build(settings: Mapping[str, object], context: ControllerContext) -> Controller:
    """Build the drive that a rig describes.

    Args:
        settings: the controller's table without `kind` and `bus`.
        context: its name, the folder of relative paths, the seed.

    Raises:
        SettingError: a key or value is wrong; names the keys.
    """
    read = read_settings(settings, context)
    drive = LeadshinePr(read)
    if not read.oscillator.is_ideal():
        drive.tell("info", read.oscillator.told())
    return on_own_time(drive, read.oscillator)


def registers() -> tuple[Register, ...]:
    """Return the register map, for display."""
    return ROWS


build.bus_kinds = ("modbus_rtu", "modbus_tcp")  # type: ignore[attr-defined]  # a plugin's mark
build.registers = registers  # type: ignore[attr-defined]  # likewise
