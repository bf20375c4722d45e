"""Names of nodes, units and motors from the rig and the EDS files in a recording."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, final

from traces.object_names import ObjectNames
from traces.structure import Attachment

_EDS: Final = (".eds", ".dcf")
_TABLES: Final = ("rig", "bus", "controller", "motor")


@final
@dataclass(slots=True)
class RecordedNames:
    """Names and object tables.

    Attributes:
        nodes: (bus, node or unit) to the controller's name.
        motors: a motor's name to (bus, node or unit).
        objects: (bus, node) to the objects in its EDS.
    """

    nodes: dict[tuple[str, int], str] = field(default_factory=dict)
    motors: dict[str, tuple[str, int]] = field(default_factory=dict)
    objects: dict[tuple[str, int], ObjectNames] = field(default_factory=dict)


def names_of(attachments: list[Attachment]) -> RecordedNames:
    """Return the names in the attachments; unreadable files are ignored."""
    names = RecordedNames()
    files = {one.name.rpartition("/")[2]: one.data for one in attachments}
    for data in files.values():
        rig = rig_in(data)
        if rig is not None:
            _take(names, rig, files)
            break
    return names


def rig_in(data: bytes) -> dict[str, object] | None:
    """Parse an attached rig; None if the file is something else (a motor model, an EDS)."""
    try:
        found = tomllib.loads(data.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError):
        return None
    return found if is_rig(found) else None


def is_rig(table: Mapping[str, object]) -> bool:
    """Return True if a TOML file is a rig, not a motor model or another accompanying file."""
    return any(isinstance(table.get(name), dict) for name in _TABLES)


def _take(names: RecordedNames, rig: dict[str, object], files: dict[str, bytes]) -> None:
    places: dict[str, tuple[str, int]] = {}
    for name, table in _tables(rig, "controller"):
        place = _place(table)
        if place is None:
            continue
        places[name], names.nodes[place] = place, name
        eds = str(table.get("eds", "")).rpartition("/")[2]
        if eds.lower().endswith(_EDS) and eds in files:
            names.objects[place] = ObjectNames(files[eds].decode("cp1252", errors="replace"))
    for name, table in _tables(rig, "motor"):
        controller = table.get("controller")
        place = places.get(str(controller)) if controller is not None else _place(table)
        if place is not None:
            names.motors[name] = place


def _tables(rig: dict[str, object], kind: str) -> list[tuple[str, dict[str, object]]]:
    found = rig.get(kind)
    if not isinstance(found, dict):
        return []
    return [(name, table) for name, table in found.items() if isinstance(table, dict)]


def _place(table: dict[str, object]) -> tuple[str, int] | None:
    bus, number = table.get("bus"), table.get("node_id", table.get("unit"))
    return (bus, number) if isinstance(bus, str) and isinstance(number, int) else None
