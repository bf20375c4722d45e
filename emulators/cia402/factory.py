"""Construction of a drive from its rig table (`motorhil.controllers` entry point `cia402`)."""

from collections.abc import Mapping
from typing import Final

from emulators.canopen.eds import EdsError, read_eds
from emulators.canopen.object_dictionary import (
    DataType,
    ObjectDictionary,
    Value,
    Variable,
    is_integer,
    length_bits,
)
from emulators.cia402.drive import Cia402Drive
from emulators.cia402.objects import DriveObjects
from emulators.cia402.quirk_catalogue import told
from emulators.cia402.quirks import wire_quirks
from emulators.cia402.quirky_wire import QuirkyWire
from emulators.cia402.settings import EMULATED_MODES, MODES, DriveSettings, read_settings
from emulators.cia402.switch_settings import out_of_reach
from emulators.controller import Controller, ControllerContext, NonvolatileMemory, SettingError
from emulators.firmware.own_time import on_own_time

_ABSENT: Final = -(1 << 70)

# Communication objects that a rig can configure although the EDS lacks them.
_COMMUNICATION: Final[dict[tuple[int, int], DataType]] = {
    (0x1005, 0): DataType.UNSIGNED32,
    (0x1006, 0): DataType.UNSIGNED32,
    (0x1007, 0): DataType.UNSIGNED32,
    (0x100C, 0): DataType.UNSIGNED16,
    (0x100D, 0): DataType.UNSIGNED8,
    (0x1014, 0): DataType.UNSIGNED32,
    (0x1015, 0): DataType.UNSIGNED16,
    (0x1016, 1): DataType.UNSIGNED32,
    (0x1017, 0): DataType.UNSIGNED16,
    (0x1019, 0): DataType.UNSIGNED8,
    (0x1029, 1): DataType.UNSIGNED8,
    (0x1029, 2): DataType.UNSIGNED8,
}


def build(settings: Mapping[str, object], context: ControllerContext) -> Controller:
    """Build the drive that a rig describes.

    Args:
        settings: the controller's table without `kind` and `bus`.
        context: the controller's name, the folder of relative paths, the seed.

    Raises:
        SettingError: a key or value is wrong, or the EDS cannot be read; names the keys.
    """
    read = read_settings(settings, context.folder, context.stream())
    drive: Controller = build_drive(read, context.memory(read.nonvolatile_memory))
    wire = wire_quirks(read.quirks)
    if wire.are_any():
        drive = QuirkyWire(drive, wire, context.stream())
    return on_own_time(drive, read.oscillator)


def build_drive(settings: DriveSettings, memory: NonvolatileMemory | None = None) -> Cia402Drive:
    """Build the drive with these settings; all times passed to it must be by its own clock.

    Raises:
        SettingError: the EDS cannot be read, or an object of `settings.objects` cannot be set.
    """
    try:
        description = read_eds(settings.eds, settings.node_id)
    except EdsError as error:
        place = f"{error.path}:{error.line}" if error.line else str(error.path)
        raise SettingError(("eds",), f"{place}: {error.text}", error.remedy) from error
    od = description.dictionary()
    if od.get(0x6040) is None or od.get(0x6041) is None:
        raise SettingError(
            ("eds",),
            f"{settings.eds} has no 6040h and 6041h: it is not the EDS of a CiA 402 drive",
            "use the drive's own EDS, or omit eds for ours",
        )
    events = [("warning", f"{path}:{line}: {text}") for path, line, text in description.warnings]
    if not settings.oscillator.is_ideal():
        events.append(("info", settings.oscillator.told()))
    events += [("info", line) for line in told(settings.quirks)]
    events += [("warning", line) for line in out_of_reach(settings.switches, settings.plant)]
    stated = od.integer(0x6502, 0, 0)
    _set_objects(od, settings)
    if settings.supported_modes is None:
        left_out = [
            name
            for name, mode in MODES.items()
            if stated >> (mode - 1) & 1 and name not in EMULATED_MODES
        ]
        if left_out:
            text = f"6502h of {settings.eds.name} also names {', '.join(left_out)}: not emulated"
            events.append(("info", text))
    try:
        return Cia402Drive(od, settings, events, memory)
    except ValueError as error:
        raise SettingError(
            ("servo",), str(error), "reduce the gains of the current loop"
        ) from error


def _set_objects(od: ObjectDictionary, settings: DriveSettings) -> None:
    """Set the power-on values of the rig; absent objects can have one if the drive uses them."""
    if not settings.objects:
        return
    behind = ObjectDictionary()
    DriveObjects(behind, settings)
    for wanted in settings.objects:
        path = ("objects", wanted.key)
        variable = od.get(wanted.index, wanted.subindex)
        if variable is None:
            variable = _hidden(od, behind, wanted.index, wanted.subindex)
        if variable is None:
            raise SettingError(
                path,
                f"{settings.eds.name} has no such object, and the drive does not use it internally",
                "remove it, or use an EDS that has it",
            )
        try:
            variable.set_default(_value(variable, wanted.value))
        except (TypeError, ValueError) as error:
            raise SettingError(path, str(error)) from error


def _hidden(
    od: ObjectDictionary, behind: ObjectDictionary, index: int, subindex: int
) -> Variable | None:
    data_type: int | None = _COMMUNICATION.get((index, subindex))
    if data_type is None and behind.integer(index, subindex, _ABSENT) != _ABSENT:
        data_type = behind.ensure(index, subindex, DataType.UNSIGNED32, 0).data_type
    return None if data_type is None else od.ensure(index, subindex, data_type, 0)


def _value(variable: Variable, value: int | float | str) -> Value:
    """Return the rig's value in the Python type that the variable holds."""
    if isinstance(value, str):
        if length_bits(variable.data_type):
            raise TypeError(f"{value!r} is not a number")
        return value.encode("utf-8")
    if not is_integer(variable.data_type):
        return float(value)
    if isinstance(value, float):
        raise TypeError(f"{value} is not a whole number")
    low, high = variable.low, variable.high
    if (low is not None and value < low) or (high is not None and value > high):
        raise ValueError(f"{value} is outside {low}..{high}")
    return value
