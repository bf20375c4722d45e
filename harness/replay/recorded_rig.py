"""A rig whose controllers are out of a recording: of that recording's own rig, or of another.

A recording without a rig (imported, or of real hardware) has its buses and whoever answers there,
and no motors.
"""

import re
import tempfile
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final

from harness.replay.factory import KIND, SET_POINTS, recorded_tapes
from harness.rig_attachments import named_files
from harness.rig_buses import CAN, address_key
from harness.rig_file import Known, parse_rig, read_rig
from harness.settings import RigError, Source
from traces.errors import TraceError
from traces.reader import read_trace
from traces.recorded_names import rig_in as rig_of
from traces.records import MAGIC
from traces.structure import Attachment
from traces.tape import Tape

if TYPE_CHECKING:
    from harness.rig_file import RigDescription

_DEPTH: Final = 8
"""Folders above the rig's in which files that it names as ../x can be put."""
_BITRATE_BIT_S: Final = 1_000_000
_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_NO_NAME: Final = re.compile(r"[^A-Za-z0-9_-]")


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
    recorded_as: Mapping[str, str] | None = None,
) -> "RigDescription":
    """The rig with its controllers out of the recording, and without its faults.

    What faults did is in the recording; and what nobody heard is not. `set_points` is "exact", or
    "any" if their values in PDOs may be others than recorded. `recorded_as` has what buses are
    called in the recording, where that is another name.
    """
    names = recorded_as or {}
    controllers = {}
    for name, controller in description.controllers.items():
        bus = description.buses[controller.bus]
        settings: dict[str, object] = {
            "recording": str(recording.absolute()),
            "recorded_bus": names.get(controller.bus, controller.bus),
        }
        if controller.node_id is not None:
            settings[address_key(bus)] = controller.node_id
        if bus.kind == CAN:
            settings["bitrate_bit_s"] = bus.bitrate_bit_s
            settings["set_points"] = set_points
        controllers[name] = replace(controller, kind=KIND, settings=settings, plants_from_model=())
    return replace(description, controllers=controllers, faults=())


def rig_in(recording: Path, known: Known) -> "RigDescription":
    """The rig that a recording was made with, its controllers out of the recording.

    Raises:
        RigError: the recording cannot be read, or its rig not be used.
    """
    found = own_rig(recording, known)
    if found is not None:
        return with_recorded(found, recording)
    try:
        tapes = recorded_tapes(recording).tapes
    except TraceError as error:
        raise RigError(error.path, error.what, error.remedy) from None
    if not tapes:
        what = "holds nothing that a device told, of CANopen or Modbus"
        raise RigError(recording, what, "give a recording with devices in it")
    names = _bus_names(dict.fromkeys(bus for bus, _ in tapes))
    text = _generated(tapes, names)
    found = parse_rig(Source(recording / "generated.toml", text), known)
    return with_recorded(found, recording, recorded_as={name: bus for bus, name in names.items()})


def own_rig(recording: Path, known: Known, folder: Path | None = None) -> "RigDescription | None":
    """The rig that a recording was made with, as it was; None: the recording holds none.

    Args:
        recording: the file.
        known: the plugins that the rig may name.
        folder: where the EDS files that it names are put, to be built from; None: nobody builds.

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
            one.name: replace(one, settings=_with_eds(one.settings, home))
            for one in found.controllers.values()
        }
        others = [(one.name, one.media_type, one.data) for one in files.values() if one != attached]
        return replace(
            found, motors=motors, controllers=controllers, source=source, attached=tuple(others)
        )
    return None


def _with_eds(settings: Mapping[str, object], home: Path) -> Mapping[str, object]:
    """The EDS file where it has been put: the rig's own place of it is none."""
    eds = settings.get("eds")
    return settings if not isinstance(eds, str) else {**settings, "eds": str(home / eds)}


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


def _bus_names(buses: Iterable[str]) -> dict[str, str]:
    """What each recorded bus is called in a rig: as it was, or a word made of an address."""
    names: dict[str, str] = {}
    for bus in buses:
        name = bus if _NAME.fullmatch(bus) else "bus_" + _NO_NAME.sub("_", bus)
        while name in names.values():
            name += "_"
        names[bus] = name
    return names


def _generated(tapes: Mapping[tuple[str, int], Tape], names: Mapping[str, str]) -> str:
    """A rig file of buses and whoever answers there."""
    lines = ["[rig]"]
    for bus, called in names.items():
        is_line = any(
            step.turns and step.key[0] == "modbus"
            for (where, _), tape in tapes.items()
            for step in tape.steps
            if where == bus
        )
        kind = 'kind = "modbus_rtu"' if is_line else f"bitrate_bit_s = {_BITRATE_BIT_S}"
        lines += ["", f"[bus.{_key(called)}]", kind]
        for where, number in tapes:
            if where == bus:
                key, word = ("unit", "unit") if is_line else ("node_id", "node")
                name = f"{word}_{number}" if len(names) == 1 else f"{called}_{word}_{number}"
                lines += ["", f"[controller.{_key(name)}]", f'kind = "{KIND}"']
                lines += [f'bus = "{called}"', f"{key} = {number}", 'recording = "it"']
    return "\n".join(lines) + "\n"


def _key(name: str) -> str:
    return f'"{name}"'
