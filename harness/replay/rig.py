"""Rigs with recorded controllers, from the recording's own rig or another one.

A recording without a rig (imported, or of real hardware) yields a rig with its buses and the
devices that answer there, without motors.
"""

import re
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final

from motorhil.emulators.can.controller_config import PLAIN, FrameSupport
from motorhil.harness.plugins import DECODERS, installed
from motorhil.harness.replay.device_node import KIND, SET_POINTS, recorded_exchanges
from motorhil.harness.rig.config.buses import (
    CAN,
    MODBUS_RTU,
    MODBUS_TCP,
    SERIAL,
    UNIT_MAX,
    address_key,
)
from motorhil.harness.rig.config.rig_file import Known, parse_rig, read_rig
from motorhil.harness.rig.config.toml import RigError, Source
from motorhil.harness.rig.recording import named_files
from motorhil.traces.decoding.attached_rig import rig_in as rig_of
from motorhil.traces.errors import TraceError
from motorhil.traces.exchange.drive_kinds import CAN_KINDS, LINE_KINDS
from motorhil.traces.exchange.recording import RecordedExchanges
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.records import Attachment

if TYPE_CHECKING:
    from motorhil.harness.rig.config.rig_file import RigDescription

_FILES: Final = ("eds", "nonvolatile_memory")  # of a controller
_PLACE: Final = ("recorded_bus", "recorded_unit")
_DEPTH: Final = 64
"""The number of folders above the rig's folder that file names such as ../x may reach."""
_PATIENCE_MAX_S: Final = 3600
_BITRATE_BIT_S: Final = 1_000_000


def with_recorded(
    description: "RigDescription",
    recording: Path,
    set_points: str = SET_POINTS[0],
    places: Mapping[str, Mapping[str, object]] | None = None,
) -> "RigDescription":
    """Return the rig with recorded controllers, and without its faults and stimuli.

    The effects of faults and stimuli are in the recording already. `set_points` is "exact", or
    "any" if the values of set-points may differ from the recorded ones. `places` gives, by
    controller, its `recorded_bus` and `recorded_unit` where they differ from the rig's.

    Raises:
        RigError: a controller is of a kind that no recording stands in for.
    """
    controllers, others = {}, installed(DECODERS).keys() - {*CAN_KINDS, *LINE_KINDS}
    for name, controller in description.controllers.items():
        if controller.kind in others:
            raise description.error(
                ("controller", name, "kind"),
                f'no recording stands in for "{controller.kind}": its requests and answers are not'
                " known",
                "run the application on the rig, with the emulated drive (motorhil run RIG SCRIPT),"
                " or replay the host or the traffic (--as host, --as traffic)",
            )
        bus = description.buses[controller.bus]
        settings: dict[str, object] = {
            "recording": str(recording.absolute()),
            "recorded_bus": controller.bus,
        }
        if controller.node_id is not None:
            settings[address_key(bus)] = controller.node_id
        if bus.kind in (CAN, SERIAL):
            settings["set_points"] = set_points
        if bus.kind == CAN:
            settings["bitrate_bit_s"] = bus.bitrate_bit_s
            chip = bus.nodes.get(name, PLAIN)
            if bus.data_bitrate_bit_s is not None and chip.frames is FrameSupport.FD:
                settings["data_bitrate_bit_s"] = bus.data_bitrate_bit_s
        if controller.kind == KIND:  # as in the recording, also under other names
            settings |= {key: own for key, own in controller.settings.items() if key in _PLACE}
        settings |= (places or {}).get(name, {})
        controllers[name] = replace(controller, kind=KIND, settings=settings, plants_from_model=())
    return replace(description, controllers=controllers, faults=(), stimuli=())


def rig_in(recording: Path, known: Known) -> "RigDescription":
    """Return the rig of a recording, with recorded controllers.

    Raises:
        RigError: the recording cannot be read, or its rig cannot be used.
    """
    found = own_rig(recording, known)
    if found is not None:
        return with_recorded(found, recording)
    try:
        recorded = recorded_exchanges(recording)
    except TraceError as error:
        raise RigError(error.path, error.what, error.remedy) from None
    if not recorded.logs:
        what = "holds no CANopen or Modbus message of a device"
        raise RigError(recording, what, "give a recording with devices in it")
    text, places = _generated(recorded)
    found = parse_rig(Source(recording / "generated.toml", text), known)
    return with_recorded(found, recording, places=places)


def own_rig(recording: Path, known: Known, folder: Path | None = None) -> "RigDescription | None":
    """Return the original rig of a recording, or None if it holds none.

    Args:
        recording: the file.
        known: the plugins that the rig may name.
        folder: where the controllers' files are written; None: a temporary folder.

    Raises:
        RigError: the recording cannot be read, or its rig cannot be used.
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
    """Read the first attached rig file; its motor models stay as tables, not as files.

    The recording may be anybody's. Its rig runs no code but that of plugins, and the files that it
    names are those of the recording, wherever they were: they stay within `folder`.
    """
    files = {one.name.rpartition("/")[2]: one for one in attachments}
    files = {name: one for name, one in files.items() if name not in ("", ".", "..")}
    for name, attached in files.items():
        rig = rig_of(attached.data)
        if rig is None:
            continue
        home = Path(folder, *(["in"] * _DEPTH))
        text, moved = _moved(attached.data, rig, recording / name)
        for place, contents in _places(rig, moved, files).items():
            _write(home / place, contents)
        try:
            found = read_rig(_write(home / name, text), replace(known, takes_targets=False))
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
    """Return the settings with the controllers' files in their new places."""
    named = {key: settings[key] for key in _FILES if isinstance(settings.get(key), str)}
    return {**settings, **{key: str(home / str(file)) for key, file in named.items()}}


def _table(model: Path | Mapping[str, object]) -> Mapping[str, object]:
    """Return a motor model as a table, since its file is temporary."""
    return tomllib.loads(model.read_text("utf-8")) if isinstance(model, Path) else model


def _moved(text: bytes, rig: Mapping[str, object], where: Path) -> tuple[bytes, dict[str, str]]:
    """Return the rig's text with the files outside of its folders moved, and their new names."""
    moved: dict[str, str] = {}
    for named, _ in named_files(rig):
        place = PurePosixPath(named)
        if place.is_absolute() or place.parts.count("..") > _DEPTH:
            moved[named] = f"moved-{len(moved)}/{place.name or 'file'}"
    for named, name in moved.items():
        for quote in (b'"', b"'"):
            text = text.replace(quote + named.encode() + quote, b'"%s"' % name.encode())
    if any(named in moved for named, _ in named_files(tomllib.loads(text.decode()))):
        what = f"names the file {next(iter(moved))!r}, in a spelling that cannot be moved"
        raise RigError(where, what, "give a rig file instead")
    return text, moved


def _places(
    rig: Mapping[str, object], moved: Mapping[str, str], files: Mapping[str, Attachment]
) -> dict[str, bytes]:
    """Return the attached files by the path under which the rig expects them."""
    found: dict[str, bytes] = {}
    for named, _ in named_files(rig):
        attached = files.get(PurePosixPath(named).name)
        if attached is not None:
            found[moved.get(named, named)] = attached.data
    return found


def _write(path: Path, data: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def _generated(recorded: RecordedExchanges) -> tuple[str, dict[str, dict[str, object]]]:
    """Return the text of a generated rig file, and each controller's place in the recording."""
    places: dict[str, dict[str, object]] = {}
    lines = ["[rig]"]
    names = _plain_names([bus for bus, _ in recorded.logs])
    for bus, plain in names.items():
        is_line = bus not in recorded.decoders
        kind = f"bitrate_bit_s = {_BITRATE_BIT_S}"
        if is_line:
            kind = f'kind = "{MODBUS_RTU}"'
        if bus in recorded.tcp:
            kind = f'kind = "{MODBUS_TCP}"\ntimeout_s = {_patience_s(recorded, bus)}'
        lines += ["", f"[bus.{plain}]", kind]
        numbers = [number for where, number in recorded.logs if where == bus]
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


def _patience_s(recorded: RecordedExchanges, line: str) -> int:
    """Return a gateway timeout that covers the latest recorded answer of its units [s]."""
    turns = [
        turn
        for (where, _), log in recorded.logs.items()
        if where == line
        for step in log.steps
        for turn in step.turns
    ]
    latest_ns = max((one.delay_ns for turn in turns for one in turn.answers), default=0)
    return min(_PATIENCE_MAX_S, 1 + latest_ns // 1_000_000_000 + 1)


def _plain_names(buses: Sequence[str]) -> dict[str, str]:
    """Return a valid rig name for each bus; an address becomes `line_192_168_0_20`."""
    found: dict[str, str] = {}
    for bus in dict.fromkeys(buses):
        plain = re.sub(r"[^A-Za-z0-9_-]", "_", bus)
        if not plain[:1].isalpha():
            plain = f"line_{plain}"
        while plain in found.values():
            plain += "_"
        found[bus] = plain
    return found
