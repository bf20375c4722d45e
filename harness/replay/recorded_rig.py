"""A rig whose controllers are out of a recording: of that recording's own rig, or of another.

A recording without a rig (imported, or of real hardware) has its buses and whoever answers there,
and no motors.
"""

import re
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final

from emulators.media.can_node import PLAIN, FrameSupport
from harness.replay.factory import KIND, SET_POINTS, recorded_tapes
from harness.rig_attachments import named_files
from harness.rig_buses import CAN, MODBUS_RTU, MODBUS_TCP, UNIT_MAX, address_key
from harness.rig_file import Known, parse_rig, read_rig
from harness.settings import RigError, Source
from traces.errors import TraceError
from traces.reader import read_trace
from traces.recorded_names import rig_in as rig_of
from traces.recorded_tapes import RecordedTapes
from traces.records import MAGIC
from traces.structure import Attachment

if TYPE_CHECKING:
    from harness.rig_file import RigDescription

_FILES: Final = ("eds", "nonvolatile_memory")  # of a controller
_DEPTH: Final = 64
"""Folders above the rig's in which files that it names as ../x can be put."""
_PATIENCE_MAX_S: Final = 3600
_BITRATE_BIT_S: Final = 1_000_000


def is_recording(path: Path) -> bool:
    """Whether it is a recording, and no rig file; what a pipe gives is left in it."""
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def with_recorded(
    description: "RigDescription",
    recording: Path,
    set_points: str = SET_POINTS[0],
    places: Mapping[str, Mapping[str, object]] | None = None,
) -> "RigDescription":
    """The rig with its controllers out of the recording, and without its faults and stimuli.

    What they did is in the recording; and what nobody heard is not. `set_points` is "exact", or
    "any" if their values in PDOs may be others than recorded; `places` tells by controller where
    the recording has it (`recorded_bus`, `recorded_unit`), where it is elsewhere in the rig.
    """
    controllers = {}
    for name, controller in description.controllers.items():
        bus = description.buses[controller.bus]
        settings: dict[str, object] = {
            "recording": str(recording.absolute()),
            "recorded_bus": controller.bus,
        }
        if controller.node_id is not None:
            settings[address_key(bus)] = controller.node_id
        if bus.kind == CAN:
            settings["bitrate_bit_s"] = bus.bitrate_bit_s
            settings["set_points"] = set_points
            chip = bus.nodes.get(name, PLAIN)
            if bus.data_bitrate_bit_s is not None and chip.frames is FrameSupport.FD:
                settings["data_bitrate_bit_s"] = bus.data_bitrate_bit_s
        settings |= (places or {}).get(name, {})
        controllers[name] = replace(controller, kind=KIND, settings=settings, plants_from_model=())
    return replace(description, controllers=controllers, faults=(), stimuli=())


def rig_in(recording: Path, known: Known) -> "RigDescription":
    """The rig that a recording was made with, its controllers out of the recording.

    Raises:
        RigError: the recording cannot be read, or its rig not be used.
    """
    found = own_rig(recording, known)
    if found is not None:
        return with_recorded(found, recording)
    try:
        recorded = recorded_tapes(recording)
    except TraceError as error:
        raise RigError(error.path, error.what, error.remedy) from None
    if not recorded.tapes:
        what = "holds nothing that a device told, of CANopen or Modbus"
        raise RigError(recording, what, "give a recording with devices in it")
    text, places = _generated(recorded)
    found = parse_rig(Source(recording / "generated.toml", text), known)
    return with_recorded(found, recording, places=places)


def own_rig(recording: Path, known: Known, folder: Path | None = None) -> "RigDescription | None":
    """The rig that a recording was made with, as it was; None: the recording holds none.

    Args:
        recording: the file.
        known: the plugins that the rig may name.
        folder: where controllers' files are put, to be built from; None: nobody builds.

    Raises:
        RigError: the recording cannot be read, or its rig not be used.
    """
    try:
        with read_trace(recording) as trace:
            attachments = trace.attachments
    except TraceError as error:
        raise RigError(error.path, error.what, error.remedy) from None
    if folder is not None:
        return _own_rig(recording, attachments, known, folder)
    with tempfile.TemporaryDirectory(prefix="motorhil-") as passing:
        return _own_rig(recording, attachments, known, Path(passing))


def _own_rig(
    recording: Path, attachments: list[Attachment], known: Known, folder: Path
) -> "RigDescription | None":
    """Of the first attached file that is one; its motor models stay as tables, not as files."""
    files = {one.name.rpartition("/")[2]: one for one in attachments}
    for name, attached in files.items():
        rig = rig_of(attached.data)
        if rig is None:
            continue
        home = Path(folder, *(["in"] * _DEPTH))
        for place, contents in _places(rig, files).items():
            _write(home / place, contents)
        try:
            found = read_rig(_write(home / name, attached.data), known)
        except RigError as error:
            what = error.message.replace(f"{home}/", "")
            raise RigError(
                recording / name, what, "give a rig file instead", line=error.line, key=error.key
            ) from None
        source = Source(recording / name, attached.data.decode())
        source.root()
        motors = {
            motor.name: replace(motor, model=_table(motor.model)) for motor in found.motors.values()
        }
        controllers = {
            one.name: replace(one, settings=_with_files(one.settings, home))
            for one in found.controllers.values()
        }
        others = [(one.name, one.media_type, one.data) for one in files.values() if one != attached]
        return replace(
            found, motors=motors, controllers=controllers, source=source, attached=tuple(others)
        )
    return None


def _with_files(settings: Mapping[str, object], home: Path) -> Mapping[str, object]:
    """The controller's files where they have been put: the rig's own places of them are none."""
    named = {key: settings[key] for key in _FILES if isinstance(settings.get(key), str)}
    return {**settings, **{key: str(home / str(file)) for key, file in named.items()}}


def _table(model: Path | Mapping[str, object]) -> Mapping[str, object]:
    """A motor model as what its file says, for the file does not stay."""
    return tomllib.loads(model.read_text("utf-8")) if isinstance(model, Path) else model


def _places(rig: Mapping[str, object], files: Mapping[str, Attachment]) -> dict[str, bytes]:
    """Where the rig looks for files that came with it."""
    found: dict[str, bytes] = {}
    for named, _ in named_files(rig):
        place = PurePosixPath(named)
        attached = files.get(place.name)
        if not place.is_absolute() and attached is not None and place.parts.count("..") <= _DEPTH:
            found[named] = attached.data
    return found


def _write(path: Path, data: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def _generated(recorded: RecordedTapes) -> tuple[str, dict[str, dict[str, object]]]:
    """A rig file of buses and whoever answers there; and where the recording has these."""
    places: dict[str, dict[str, object]] = {}
    lines = ["[rig]"]
    names = _plain_names([bus for bus, _ in recorded.tapes])
    for bus, plain in names.items():
        is_line = bus not in recorded.decoders
        kind = f"bitrate_bit_s = {_BITRATE_BIT_S}"
        if is_line:
            kind = f'kind = "{MODBUS_RTU}"'
        if bus in recorded.tcp:
            kind = f'kind = "{MODBUS_TCP}"\ntimeout_s = {_patience_s(recorded, bus)}'
        lines += ["", f"[bus.{plain}]", kind]
        numbers = [number for where, number in recorded.tapes if where == bus]
        free = (number for number in range(1, UNIT_MAX + 1) if number not in numbers)
        key, word = ("unit", "unit") if is_line else ("node_id", "node")
        for number in numbers:
            name = f"{word}_{number}" if len(names) == 1 else f"{plain}_{word}_{number}"
            own = number if not is_line or 0 < number <= UNIT_MAX else next(free)
            places[name] = {"recorded_bus": bus}
            if own != number:
                places[name]["recorded_unit"] = number
            lines += ["", f"[controller.{name}]", f'kind = "{KIND}"']
            lines += [f'bus = "{plain}"', f"{key} = {own}", 'recording = "it"']
    return "\n".join(lines) + "\n", places


def _patience_s(recorded: RecordedTapes, line: str) -> int:
    """How long a gateway has to wait for its units to answer as late as they did [s]."""
    turns = [
        turn
        for (where, _), tape in recorded.tapes.items()
        if where == line
        for step in tape.steps
        for turn in step.turns
    ]
    latest_ns = max((one.delay_ns for turn in turns for one in turn.answers), default=0)
    return min(_PATIENCE_MAX_S, 1 + latest_ns // 1_000_000_000 + 1)


def _plain_names(buses: Sequence[str]) -> dict[str, str]:
    """What a rig can call these buses, by name: of an address, `line_192_168_0_20`."""
    found: dict[str, str] = {}
    for bus in dict.fromkeys(buses):
        plain = re.sub(r"[^A-Za-z0-9_-]", "_", bus)
        if not plain[:1].isalpha():
            plain = f"line_{plain}"
        while plain in found.values():
            plain += "_"
        found[bus] = plain
    return found
