"""Factory of recorded controllers: entry point `motorhil.controllers`, `recorded`.

[controller.left]
kind = "recorded"
bus = "can0"
node_id = 1                     # on a line: unit
recording = "bench.mcap"        # relative to the rig's folder
recorded_bus = "can0"           # if the recording has the node on more than one bus
recorded_unit = 255             # on a line: if the recording has it as another unit
bitrate_bit_s = 1_000_000       # of the bus
data_bitrate_bit_s = 2_000_000  # of a bus where it may send CAN FD frames
"""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Final

from emulators.controller import Controller, ControllerContext, SettingError
from emulators.setting_tables import refuse_unknown, whole
from harness.replay.recorded_node import RecordedNode
from harness.replay.recorded_unit import RecordedUnit
from harness.rig_buses import BUS_KINDS, NODE_MAX, UNIT_MAX
from traces.errors import TraceError
from traces.reader import read_trace
from traces.recorded_tapes import RecordedTapes, tapes_of
from traces.tape import Tape

KIND: Final = "recorded"
_KEYS: Final = (
    *("node_id", "unit", "recording", "recorded_bus", "recorded_unit"),
    *("bitrate_bit_s", "data_bitrate_bit_s", "set_points"),
)
_BYTE_MAX: Final = 255
SET_POINTS: Final = ("exact", "any")
_RATE_MAX: Final = 1_000_000
_DATA_RATE_MAX: Final = 20_000_000


def build(settings: Mapping[str, object], context: ControllerContext) -> Controller:
    """Build the controller that a rig describes.

    Args:
        settings: its table without `kind` and `bus`.
        context: its name, the folder of relative paths, and the seed.

    Raises:
        SettingError: a key or value is wrong, or the recording has no such controller.
    """
    refuse_unknown(settings, _KEYS, ())
    is_unit = "unit" in settings
    key = "unit" if is_unit else "node_id"
    if key not in settings:
        raise SettingError((key,), "is missing", "node_id = 1, or on a line unit = 1")
    number = whole(settings[key], (key,), 1, UNIT_MAX if is_unit else NODE_MAX)
    path, found = _recording(settings, context.folder)
    recorded = number
    if is_unit and "recorded_unit" in settings:  # TCP servers may use 0 or 255
        recorded = whole(settings["recorded_unit"], ("recorded_unit",), 0, _BYTE_MAX)
    tape = _tape(path, found, settings.get("recorded_bus"), recorded, is_unit)
    note = ""
    if found.cut and tape is next(iter(found.tapes.values())):  # reported only once
        note = f"{path} is {found.cut}; commands behind that are not in it"
    if is_unit:
        return RecordedUnit(tape, number, note)
    rate = whole(settings.get("bitrate_bit_s", _RATE_MAX), ("bitrate_bit_s",), 1000, _RATE_MAX)
    data_bit_ns = 0
    key = "data_bitrate_bit_s"
    if key in settings:
        data_bit_ns = 1_000_000_000 // whole(settings[key], (key,), rate, _DATA_RATE_MAX)
    decoder = found.decoders[tape.bus]
    return RecordedNode(tape, decoder, number, 1_000_000_000 // rate, note, data_bit_ns)


build.bus_kinds = BUS_KINDS  # type: ignore[attr-defined]  # how a plugin says where it can be


def _recording(settings: Mapping[str, object], folder: Path) -> tuple[Path, RecordedTapes]:
    value = settings.get("recording")
    if not isinstance(value, str):
        raise SettingError(("recording",), "is missing or not a text", 'recording = "bench.mcap"')
    path = folder / value
    try:
        return path, recorded_tapes(path, _any_set_point(settings))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        remedy = "paths are relative to the rig's folder"
        raise SettingError(("recording",), f"{path}: {reason}", remedy) from None
    except TraceError as error:
        raise SettingError(("recording",), str(error)) from None


def _any_set_point(settings: Mapping[str, object]) -> bool:
    value = settings.get("set_points", SET_POINTS[0])
    if value not in SET_POINTS:
        words = " or ".join(f'"{one}"' for one in SET_POINTS)
        raise SettingError(("set_points",), f"{value!r} is not known", f"write {words}")
    return value == SET_POINTS[1]


def recorded_tapes(path: Path, any_set_point: bool = False) -> RecordedTapes:
    """Return the exchange logs in a file, which is read once for all its controllers.

    Raises:
        OSError: the file does not exist.
        TraceError: the file cannot be read.
    """
    about = path.stat()
    return _tapes(path, about.st_mtime_ns, about.st_size, any_set_point)


@lru_cache(maxsize=2)
def _tapes(path: Path, modified_ns: int, size: int, any_set_point: bool) -> RecordedTapes:
    """Return all exchange logs of a file in its present version."""
    with read_trace(path) as trace:
        return tapes_of(trace, any_set_point)


def _tape(path: Path, found: RecordedTapes, bus: object, number: int, is_unit: bool) -> Tape:
    word = "unit" if is_unit else "node"
    fitting = {
        where: tape
        for (where, of), tape in found.tapes.items()
        if of == number and (where in found.decoders) is not is_unit and bus in (None, where)
    }
    if len(fitting) == 1:
        return next(iter(fitting.values()))
    if fitting:
        several = ", ".join(fitting)
        problem = f"{path} has {word} {number} on several buses: {several}"
        raise SettingError(("recorded_bus",), "is missing", f"name one of them; {problem}")
    known = ", ".join(
        f"{of} on {where}" for where, of in found.tapes if (where in found.decoders) is not is_unit
    )
    on = f" on {bus}" if isinstance(bus, str) else ""
    raise SettingError(
        ("recording",),
        f"{path} has no data of {word} {number}{on}",
        f"available: {word}s {known}" if known else f"it has no {word}s",
    )
