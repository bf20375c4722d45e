"""Facts from the rig, the motor models and the EDS files attached to a recording.

They give names, places, bit rates and units. Without a rig, nothing is known, except the objects of
nodes with an EDS of their own:

    [[eds]]                 # a file of TOML without tables of a rig
    node_id = 5
    bus = "can0"            # "": every bus
    file = "1a2b3c4d.eds"   # attached as well
"""

import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from math import tau
from typing import Any, Final, final

from motorhil.frozen import frozen
from motorhil.settings import parse_toml
from motorhil.traces.decoding.objects import ObjectNames
from motorhil.traces.mcap.records import Attachment

# A TOML table, hence Any.
Table = dict[str, Any]
_EDS: Final = (".eds", ".dcf")
_TABLES: Final = ("rig", "bus", "controller", "motor")


@final
@frozen
class MotorFacts:
    """The known facts of a motor.

    Attributes:
        name: its name.
        unit: "rad", "m", or "" without a model.
        increments_per_unit: increments of the drive's position per unit; None: unknown.
        velocity_unit: the value of 1 in the drive's velocities [unit/s]; None: unknown.
        controller: its controller; None: not given.
        place: bus, and node or unit; None: not given.
        channel: channel of the controller, from 1.
        model: the file that gives the units.
        model_table: the contents of the model.
    """

    name: str
    unit: str = ""
    increments_per_unit: float | None = None
    velocity_unit: float | None = None
    controller: str | None = None
    place: tuple[str, int] | None = None
    channel: int = 1
    model: str = ""
    model_table: Table = field(default_factory=dict)


@final
@dataclass(slots=True)
class RigFacts:
    """The known facts of a rig.

    Attributes:
        name: its name.
        bitrates: bit rates of CAN buses and serial lines [bit/s].
        data_bitrates: data bit rates of CAN FD buses [bit/s].
        by_priority: for each CAN bus, nodes that send their most urgent frame first.
        motors: the motors, in the rig's order.
        groups: the motors of each group.
        settings: the settings of each controller, as in the rig.
    """

    name: str = ""
    bitrates: dict[str, int] = field(default_factory=dict)
    data_bitrates: dict[str, int] = field(default_factory=dict)
    by_priority: dict[str, frozenset[str]] = field(default_factory=dict)
    motors: dict[str, MotorFacts] = field(default_factory=dict)
    groups: dict[str, list[str]] = field(default_factory=dict)
    settings: dict[str, Table] = field(default_factory=dict)


@final
@dataclass(slots=True)
class RecordedNames:
    """Names and object tables.

    Attributes:
        nodes: (bus, node or unit) to the controller's name.
        motors: a motor's name to (bus, node or unit).
        objects: (bus, node) to the objects in its EDS; bus "" stands for every bus.
    """

    nodes: dict[tuple[str, int], str] = field(default_factory=dict)
    motors: dict[str, tuple[str, int]] = field(default_factory=dict)
    objects: dict[tuple[str, int], ObjectNames] = field(default_factory=dict)

    def completed_by(self, other: "RecordedNames") -> "RecordedNames":
        """Return these names, and those of `other` where they say nothing."""
        known = self.objects
        more = {
            (bus, number): objects
            for (bus, number), objects in other.objects.items()
            if ("", number) not in known  # bus "" stands for every bus
        }
        return RecordedNames(
            {**other.nodes, **self.nodes}, {**other.motors, **self.motors}, {**more, **known}
        )

    def objects_on(self, bus: str) -> dict[int, ObjectNames]:
        """Return the objects of the nodes on a bus, by node-ID."""
        return {
            node: objects
            for where in ("", bus)
            for (place, node), objects in self.objects.items()
            if place == where
        }


def rig_in(data: bytes) -> Table | None:
    """Parse an attached rig; None if the file is something else (a motor model, an EDS)."""
    table = _toml(data)
    return table if table is not None and is_rig(table) else None


def is_rig(table: Mapping[str, object]) -> bool:
    """Return True if a TOML file is a rig, not a motor model or another accompanying file."""
    return any(isinstance(table.get(name), dict) for name in _TABLES)


def names_of(attachments: Iterable[Attachment]) -> RecordedNames:
    """Return the names in the attachments; unreadable files are ignored."""
    files = {one.name.rpartition("/")[2]: one for one in attachments}
    facts = facts_of(files.values())
    names = RecordedNames()
    for name, table in facts.settings.items():
        place = place_of(table)
        if place is None:
            continue
        names.nodes[place] = name
        eds = str(table.get("eds", "")).rpartition("/")[2]
        if eds.lower().endswith(_EDS) and eds in files:
            names.objects[place] = objects_in(files[eds].data)
    for bus, node, file in _given_eds(files.values()):
        if file in files:
            for place in [one for one in names.objects if one[1] == node and bus in ("", one[0])]:
                del names.objects[place]
            names.objects[bus, node] = objects_in(files[file].data)
    names.motors = {one.name: one.place for one in facts.motors.values() if one.place is not None}
    return names


def objects_in(eds: bytes) -> ObjectNames:
    """Return the objects in an EDS or DCF; vendors use the code page of Windows."""
    return ObjectNames(eds.decode("cp1252", errors="replace"))


def eds_attachments(given: Iterable[tuple[str, int, bytes]]) -> list[Attachment]:
    """Return the attachments that give nodes an EDS: bus ("" for every bus), node-ID, contents.

    They take precedence over the EDS files of a rig.
    """
    found: list[Attachment] = []
    rows: list[str] = []
    for bus, node, eds in given:
        name = f"{zlib.crc32(eds):08x}.eds"
        found.append(Attachment(name, "text/plain", 0, eds))
        quoted = bus.replace("\\", "\\\\").replace('"', '\\"')
        rows.append(f'[[eds]]\nbus = "{quoted}"\nnode_id = {node}\nfile = "{name}"\n')
    if rows:
        table = "".join(rows).encode()
        found.append(Attachment(f"{zlib.crc32(table):08x}.toml", "application/toml", 0, table))
    return found


def _given_eds(attachments: Iterable[Attachment]) -> Iterator[tuple[str, int, str]]:
    """Yield bus, node-ID and file of each EDS that is given without a rig."""
    for one in attachments:
        table = _toml(one.data) or {}
        rows = table.get("eds")
        for row in rows if isinstance(rows, list) else ():
            if isinstance(row, dict):
                bus, node, file = row.get("bus"), row.get("node_id"), row.get("file")
                if isinstance(bus, str) and isinstance(node, int) and isinstance(file, str):
                    yield bus, node, file


def facts_of(attachments: Iterable[Attachment]) -> RigFacts:
    """Return the facts in the attachments; unreadable attachments are ignored."""
    tables: dict[str, Table] = {}
    rig: Table | None = None
    for one in attachments:
        table = _toml(one.data)
        if table is not None:
            tables[one.name.rpartition("/")[2]] = table
            rig = table if rig is None and is_rig(table) else rig
    facts = RigFacts()
    if rig is None:
        return facts
    head = rig.get("rig")
    facts.name = str(head.get("name", "")) if isinstance(head, dict) else ""
    for name, bus in _tables(rig, "bus").items():
        rate = bus.get("bitrate_bit_s", bus.get("baud_bit_s"))
        if isinstance(rate, int) and rate > 0:
            facts.bitrates[name] = rate
        data_rate = bus.get("data_bitrate_bit_s")
        if isinstance(data_rate, int) and data_rate > 0:
            facts.data_bitrates[name] = data_rate
        nodes = _tables(bus, "node").items()
        urgent = frozenset(node for node, chip in nodes if chip.get("queue") == "priority")
        facts.by_priority[name] = urgent
    controllers = facts.settings = _tables(rig, "controller")
    for name, motor in _tables(rig, "motor").items():
        facts.motors[name] = _motor(name, motor, controllers, tables)
    for name, group in _tables(rig, "group").items():
        members = group.get("motors", [])
        if isinstance(members, list):
            facts.groups[name] = [str(member) for member in members]
    return facts


def _motor(
    name: str, motor: Table, controllers: dict[str, Table], files: dict[str, Table]
) -> MotorFacts:
    controller = motor.get("controller")
    place = place_of(controllers.get(controller, {}) if isinstance(controller, str) else motor)
    if controller is None and place is not None:
        controller = next((c for c, table in controllers.items() if place_of(table) == place), None)
    channel = motor.get("channel", 1)
    given = motor.get("model")
    model = given if isinstance(given, dict) else {}
    file = ""
    if isinstance(given, str):
        file = given.rpartition("/")[2]
        model = files.get(file, {})
    unit = ""
    if model:
        unit = "m" if model.get("kind") == "linear" else "rad"
    scale = model.get(f"increments_per_{unit}") if unit else None
    if scale is None:
        scale = _by_gear(model, unit)
    return MotorFacts(
        name,
        unit,
        _positive_or_negative(scale),
        _positive_or_negative(model.get(f"velocity_unit_{unit}_s")),
        controller if isinstance(controller, str) else None,
        place,
        channel if isinstance(channel, int) else 1,
        file,
        model,
    )


def _positive_or_negative(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and value else None


def _by_gear(model: Table, unit: str) -> float | None:
    """Return the increments per unit from gear and encoder of a motor model."""
    encoder = model.get("encoder_increments_rev")
    gear = model.get("motor_turns_per_m" if unit == "m" else "gear_ratio")
    if not isinstance(encoder, int | float) or not isinstance(gear, int | float):
        return None
    return encoder * gear if unit == "m" else encoder * gear / tau


def _toml(data: bytes) -> Table | None:
    try:
        return parse_toml(data.decode())
    except (ValueError, RecursionError):  # not TOML, a number of 5,000 digits, nested too deeply
        return None


def _tables(rig: Table, kind: str) -> dict[str, Table]:
    found = rig.get(kind)
    if not isinstance(found, dict):
        return {}
    return {name: table for name, table in found.items() if isinstance(table, dict)}


def place_of(table: Mapping[str, object]) -> tuple[str, int] | None:
    """Return bus and node of a controller's or motor's table; None: not given."""
    bus, number = table.get("bus"), table.get("node_id", table.get("unit"))
    return (bus, number) if isinstance(bus, str) and isinstance(number, int) else None


def controllers_in(files: Iterable[Attachment]) -> dict[tuple[str, int], Mapping[str, object]]:
    """Return the tables of the controllers in an attached rig, by bus and node."""
    tables = facts_of(files).settings.values()
    return {place: table for table in tables if (place := place_of(table)) is not None}
