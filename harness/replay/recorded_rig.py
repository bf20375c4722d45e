"""A rig whose controllers are out of a recording: of that recording's own rig, or of another."""

import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final

from harness.replay.factory import KIND
from harness.rig_buses import CAN, address_key
from traces.errors import TraceError
from traces.reader import read_trace

if TYPE_CHECKING:
    from harness.rig_file import RigDescription

_DEPTH: Final = 8
"""Folders above the rig's in which files that it names as ../x can be put."""


def with_recorded(description: "RigDescription", recording: Path) -> "RigDescription":
    """The rig with its controllers out of the recording, and without its faults.

    What faults did is in the recording; and what nobody heard is not.
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
        controllers[name] = replace(controller, kind=KIND, settings=settings, plants_from_model=())
    return replace(description, controllers=controllers, faults=())


def extract_rig(recording: Path, folder: Path) -> Path:
    """The rig file of a recording, with the files that it names, in this empty folder.

    Raises:
        TraceError: the recording cannot be read, or holds no rig.
    """
    with read_trace(recording) as trace:
        files = {one.name.rpartition("/")[2]: one.data for one in trace.attachments}
    for name, data in files.items():
        try:
            rig = tomllib.loads(data.decode())
        except (tomllib.TOMLDecodeError, UnicodeDecodeError):
            continue
        if isinstance(rig.get("rig"), dict):
            home = folder.joinpath(*(["in"] * _DEPTH))
            for place, contents in _places(rig, files).items():
                _write(home / place, contents)
            return _write(home / name, data)
    remedy = "name the rig it was made with: --rig RIG"
    raise TraceError(str(recording), "holds no rig file", remedy=remedy)


def _places(rig: Mapping[str, object], files: Mapping[str, bytes]) -> dict[str, bytes]:
    """Where the rig looks for files that came with it."""
    found: dict[str, bytes] = {}
    for kind, key in (("motor", "model"), ("controller", "eds")):
        tables = rig.get(kind)
        for table in tables.values() if isinstance(tables, dict) else ():
            named = table.get(key) if isinstance(table, dict) else None
            if isinstance(named, str) and not PurePosixPath(named).is_absolute():
                data = files.get(PurePosixPath(named).name)
                if data is not None and PurePosixPath(named).parts.count("..") <= _DEPTH:
                    found[named] = data
    return found


def _write(path: Path, data: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path
