"""Factory of I/O nodes: entry point `motorhil.controllers`, name `cia401`."""

from collections.abc import Mapping
from typing import Final

from emulators.canopen.device_description import DeviceDescription
from emulators.canopen.eds import EdsError, read_eds
from emulators.canopen.object_dictionary import ObjectDictionary, is_integer, length_bits
from emulators.cia401.io_objects import ANALOGUE_OUTPUT, POSITION, PRESET
from emulators.cia401.node import IoNode
from emulators.cia401.settings import CHANNELS_MAX, NodeSettings, read_settings
from emulators.controller import Controller, ControllerContext, NonvolatileMemory, SettingError
from emulators.firmware.own_time import on_own_time
from emulators.setting_tables import ObjectValue

_BY_CHANNEL: Final = (ANALOGUE_OUTPUT, 0x6443, 0x6444, PRESET, POSITION)
_INDISPENSABLE: Final = ((0x6000, 1), (0x6200, 1), (ANALOGUE_OUTPUT, 1), (POSITION, 1))
_INVALID: Final = 1 << 31


def build(settings: Mapping[str, object], context: ControllerContext) -> Controller:
    """Build the I/O node that a rig describes.

    Args:
        settings: the controller's table without `kind` and `bus`.
        context: its name, the folder of relative paths, the seed.

    Raises:
        SettingError: a key or value is wrong, or the EDS cannot be read; names the keys.
    """
    read = read_settings(settings, context.folder, context.stream())
    built = build_node(read, context.memory(read.nonvolatile_memory))
    return on_own_time(built, read.oscillator)


def build_node(settings: NodeSettings, memory: NonvolatileMemory | None = None) -> IoNode:
    """Build the node with these settings; all calls must use its own clock.

    Raises:
        SettingError: the EDS cannot be read or lacks an indispensable object, or an object of
            `settings.objects` cannot be set.
    """
    try:
        description = read_eds(settings.eds, settings.node_id)
    except EdsError as error:
        place = f"{error.path}:{error.line}" if error.line else str(error.path)
        raise SettingError(("eds",), f"{place}: {error.text}", error.remedy) from error
    od = _dictionary(description, len(settings.channels))
    missing = [f"{index:04X}h:{sub}" for index, sub in _INDISPENSABLE if od.get(index, sub) is None]
    if missing:
        raise SettingError(
            ("eds",),
            f"{settings.eds} has no {', '.join(missing)}: it is not the EDS of an I/O node",
            "leave eds out to use the built-in one",
        )
    for wanted in settings.objects:
        _set(od, wanted, settings.eds.name)
    events = [("warning", f"{path}:{line}: {text}") for path, line, text in description.warnings]
    if not settings.oscillator.is_ideal():
        events.append(("info", settings.oscillator.told()))
    return IoNode(od, settings, events, memory)


def _dictionary(description: DeviceDescription, channels: int) -> ObjectDictionary:
    """Return the file's dictionary, reduced to this number of channels."""
    whole = description.dictionary()
    od = ObjectDictionary()
    od.dummies = whole.dummies
    od.node_id = whole.node_id
    od.supports_lss = whole.supports_lss
    for variable in whole:
        if variable.index not in _BY_CHANNEL or variable.subindex <= channels:
            od.add(variable)
    for index in _BY_CHANNEL:
        count = od.get(index, 0)
        if count is not None and count.integer() > channels:
            count.set_default(channels)
    if channels < CHANNELS_MAX:
        for index in od.indices():
            if 0x1600 <= index <= 0x17FF or 0x1A00 <= index <= 0x1BFF:
                _shorten(od, index, channels)
    return od


def _shorten(od: ObjectDictionary, mapping: int, channels: int) -> None:
    """Remove absent objects from a PDO mapping; a PDO that maps nothing becomes invalid."""
    count = od.get(mapping, 0)
    if count is None or not count.integer():
        return
    entries = [od.integer(mapping, place, 0) for place in range(1, count.integer() + 1)]
    there = [
        entry
        for entry in entries
        if entry >> 16 not in _BY_CHANNEL or (entry >> 8 & 0xFF) <= channels
    ]
    count.set_default(len(there))
    for place in range(1, len(entries) + 1):
        variable = od.get(mapping, place)
        if variable is not None:
            variable.set_default(there[place - 1] if place <= len(there) else 0)
    cob_id = od.get(mapping - 0x200, 1)
    if not there and cob_id is not None:
        cob_id.set_default(cob_id.integer() | _INVALID)


def _set(od: ObjectDictionary, wanted: ObjectValue, file: str) -> None:
    path = ("objects", wanted.key)
    variable = od.get(wanted.index, wanted.subindex)
    if variable is None:
        raise SettingError(path, f"{file} has no such object", "leave it out")
    value = wanted.value
    try:
        if isinstance(value, str):
            if length_bits(variable.data_type):
                raise TypeError(f"{value!r} is not a number")
            variable.set_default(value.encode("utf-8"))
            return
        if is_integer(variable.data_type):
            if isinstance(value, float):
                raise TypeError(f"{value} is not a whole number")
            low, high = variable.low, variable.high
            if (low is not None and value < low) or (high is not None and value > high):
                raise ValueError(f"{value} is outside {low}..{high}")
        variable.set_default(value)
    except (TypeError, ValueError) as error:
        raise SettingError(path, str(error)) from error
