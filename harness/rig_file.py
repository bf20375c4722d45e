"""The rig file: what hangs on which bus, which motors an application sees, what goes wrong when.

A rig is TOML. The structure is checked here, and every name that refers to another; a controller's
and a motor's own settings are checked by whoever builds them, and told with their line all the same
(`RigDescription.source`). `rig.schema.json` says the same to editors.

    [rig]                       name, seed
    [bus.NAME]                  kind = "can", bitrate_bit_s
    [controller.NAME]           kind, bus, node_id, and the kind's own settings
    [motor.NAME]                adaptation, model, controller (or bus and node_id), and its own
    [group.NAME]                motors
    [[fault]]                   bus, kind, what it hits and when
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final, final

from harness.settings import RigError, Source, Table, read_source
from harness.toml_lines import KeyPath
from harness.wording import listed, nearest

RIG_KEYS: Final = ("name", "seed")
BUS_KEYS: Final = ("kind", "bitrate_bit_s")
BUS_KINDS: Final = ("can",)
GROUP_KEYS: Final = ("motors",)
TOP_KEYS: Final = ("rig", "bus", "controller", "motor", "group", "fault")

FAULT_KINDS: Final = ("drop", "delay", "duplicate", "corrupt", "cut")
FAULT_KEYS: Final = (
    *("name", "bus", "kind", "id", "id_mask", "sender", "from_s", "until_s"),
    *("probability", "count_max", "delay_s", "nodes"),
)

NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
SEED_MAX: Final = 2**32 - 1
NODE_MAX: Final = 127
_SECOND_NS: Final = 1_000_000_000
_NEW_REMEDY: Final = "check the path, or write a new rig: motorhil new DIR"


@final
@dataclass(frozen=True, slots=True)
class BusDescription:
    """A bus; `bitrate_bit_s` divides 1e9, so that a bit takes a whole number of nanoseconds."""

    name: str
    kind: str
    bitrate_bit_s: int


@final
@dataclass(frozen=True, slots=True)
class ControllerDescription:
    """An emulated controller.

    Attributes:
        kind: the plugin that builds it.
        node_id: where on the bus, if its kind has such numbers.
        settings: its table without `kind`, `bus` and `plant.from_motor_model`.
        plant_from_motor_model: what its plant table leaves out is taken from its motor's model.
    """

    name: str
    kind: str
    bus: str
    node_id: int | None
    settings: Mapping[str, object]
    plant_from_motor_model: bool


@final
@dataclass(frozen=True, slots=True)
class MotorDescription:
    """A motor as the application sees it.

    Attributes:
        adaptation: the plugin that builds it.
        bus, node_id: where its controller is.
        controller: the emulated controller behind it; None if it names bus and node_id itself.
        model: a motor model file, or the model itself.
        settings: its table without the keys above.
    """

    name: str
    adaptation: str
    bus: str
    node_id: int | None
    controller: str | None
    model: Path | Mapping[str, object]
    settings: Mapping[str, object]


@final
@dataclass(frozen=True, slots=True)
class GroupDescription:
    """Motors that move together, by name."""

    name: str
    motors: tuple[str, ...]


@final
@dataclass(frozen=True, slots=True)
class FaultDescription:
    """Something that goes wrong on a bus, each time it matches.

    Attributes:
        kind: one of FAULT_KINDS.
        id, id_mask: frames whose identifier agrees with `id` in the bits of `id_mask`; None: all.
        sender: only frames of this controller; None: anybody's.
        from_s, until_s: the time window [s]; None: to the end.
        probability: of each match, 0 to 1.
        count_max: it happens at most so often; None: no limit.
        delay_s: kind "delay": how much later [s].
        nodes: kind "cut": who loses the bus, by controller name.
    """

    name: str
    bus: str
    kind: str
    id: int | None
    id_mask: int
    sender: str | None
    from_s: float
    until_s: float | None
    probability: float
    count_max: int | None
    delay_s: float
    nodes: tuple[str, ...]


@final
@dataclass(frozen=True, slots=True)
class RigDescription:
    """A rig file that was found right in itself; all names in it refer to something."""

    name: str
    seed: int
    buses: Mapping[str, BusDescription]
    controllers: Mapping[str, ControllerDescription]
    motors: Mapping[str, MotorDescription]
    groups: Mapping[str, GroupDescription]
    faults: tuple[FaultDescription, ...]
    source: Source

    @property
    def folder(self) -> Path:
        """Relative paths in the rig start here."""
        return self.source.path.parent

    def error(self, path: KeyPath, message: str, remedy: str = "") -> RigError:
        """The error for a value of this rig, with its line; to be raised."""
        return self.source.error(path, message, remedy)


@final
@dataclass(frozen=True, slots=True)
class Known:
    """The plugins a rig may name."""

    controllers: tuple[str, ...]
    adaptations: tuple[str, ...]


def read_rig(path: Path, known: Known) -> RigDescription:
    """The rig in a file.

    Raises:
        RigError: there is no such file, or the first thing wrong in it.
    """
    return parse_rig(read_source(path, _NEW_REMEDY), known)


def parse_rig(source: Source, known: Known) -> RigDescription:
    """The rig in a text.

    Raises:
        RigError: the first thing wrong in it.
    """
    root = source.root()
    root.refuse_unknown(TOP_KEYS, "table")
    rig = root.table("rig")
    rig.refuse_unknown(RIG_KEYS)
    buses = {name: _bus(name, table) for name, table in _named(root, "bus")}
    if not buses:
        raise source.error((), "the rig has no bus", "add [bus.can0]")
    controllers = {
        name: _controller(name, table, buses, known) for name, table in _named(root, "controller")
    }
    _refuse_shared_nodes(source, controllers)
    motors = {
        name: _motor(name, table, buses, controllers, known)
        for name, table in _named(root, "motor")
    }
    groups = {name: _group(name, table, motors) for name, table in _named(root, "group")}
    return RigDescription(
        name=rig.text("name", source.path.stem, '"my rig"'),
        seed=rig.integer("seed", 0, low=0, high=SEED_MAX, example="1"),
        buses=MappingProxyType(buses),
        controllers=MappingProxyType(controllers),
        motors=MappingProxyType(motors),
        groups=MappingProxyType(groups),
        faults=tuple(
            _fault(number, table, buses, controllers)
            for number, table in enumerate(root.listed_tables("fault"), 1)
        ),
        source=source,
    )


def _named(root: Table, key: str) -> "list[tuple[str, Table]]":
    """The tables [key.NAME]; names go into topics of the record, so they are plain."""
    outer = root.table(key)
    tables = []
    for name in outer.values:
        if not NAME.fullmatch(name):
            raise outer.error(
                name, "is not a name", "use a letter, then letters, digits, - and _ only"
            )
        tables.append((name, outer.table(name)))
    return tables


def _bus(name: str, table: Table) -> BusDescription:
    table.refuse_unknown(BUS_KEYS)
    kind = _one_of(table, "kind", BUS_KINDS, "bus kind", default="can")
    rate = table.integer(
        "bitrate_bit_s", low=1_000, high=1_000_000, unit="bit/s", example="1_000_000"
    )
    if _SECOND_NS % rate:
        raise table.error(
            "bitrate_bit_s",
            f"a bit of {rate} bit/s is not a whole number of nanoseconds",
            "usual: 1_000_000, 800_000, 500_000, 250_000, 125_000, 100_000, 50_000, 20_000, 10_000",
        )
    return BusDescription(name, kind, rate)


def _controller(
    name: str, table: Table, buses: Mapping[str, BusDescription], known: Known
) -> ControllerDescription:
    kind = _one_of(table, "kind", known.controllers, "controller kind")
    bus = _reference(table, "bus", buses, "bus")
    plant = table.table("plant")
    from_model = plant.flag("from_motor_model", False)
    settings = _without(table, ("kind", "bus"))
    if plant.has("from_motor_model"):
        settings["plant"] = _without(plant, ("from_motor_model",))
    return ControllerDescription(name, kind, bus, _node_id(table), settings, from_model)


def _motor(
    name: str,
    table: Table,
    buses: Mapping[str, BusDescription],
    controllers: Mapping[str, ControllerDescription],
    known: Known,
) -> MotorDescription:
    adaptation = _one_of(table, "adaptation", known.adaptations, "adaptation")
    controller: str | None = None
    if table.has("controller"):
        controller = _reference(table, "controller", controllers, "controller")
        for key in ("bus", "node_id"):
            if table.has(key):
                raise table.error(key, "is the controller's to say", f"take out {key}")
        bus = controllers[controller].bus
        node_id = controllers[controller].node_id
    elif table.has("bus"):
        bus = _reference(table, "bus", buses, "bus")
        node_id = _node_id(table)
    else:
        known_names = listed(controllers)
        raise table.missing("controller", f"name one ({known_names}), or write bus and node_id")
    settings = _without(table, ("adaptation", "controller", "bus", "node_id", "model"))
    return MotorDescription(name, adaptation, bus, node_id, controller, _model(table), settings)


def _model(table: Table) -> Path | Mapping[str, object]:
    if isinstance(table.values.get("model"), dict):
        return MappingProxyType(dict(table.table("model").values))
    path = table.source.path.parent / table.text("model", example='"motor.toml"')
    if not _is_file(path):
        raise table.error("model", f"no such file: {path}", "paths start at the rig's folder")
    return path


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _group(name: str, table: Table, motors: Mapping[str, MotorDescription]) -> GroupDescription:
    table.refuse_unknown(GROUP_KEYS)
    members = table.texts("motors", example='["left", "right"]')
    if not members:
        raise table.error("motors", "is empty", f"name motors of this rig: {listed(motors)}")
    for index, member in enumerate(members):
        path = (*table.path, "motors", index)
        if member not in motors:
            raise _no_such(table.source, path, member, motors, "motor")
        if member in members[:index]:
            raise table.source.error(path, f'"{member}" is in the group twice', "take one out")
    return GroupDescription(name, members)


def _fault(
    number: int,
    table: Table,
    buses: Mapping[str, BusDescription],
    controllers: Mapping[str, ControllerDescription],
) -> FaultDescription:
    table.refuse_unknown(FAULT_KEYS)
    bus = _reference(table, "bus", buses, "bus")
    kind = _one_of(table, "kind", FAULT_KINDS, "fault kind")
    for key, owner in (("delay_s", "delay"), ("nodes", "cut")):
        if table.has(key) and kind != owner:
            raise table.error(key, f'belongs to kind "{owner}", not "{kind}"', "take it out")
    sender = _reference(table, "sender", controllers, "controller") if table.has("sender") else None
    nodes = table.texts("nodes") if kind == "cut" else ()
    for index, node in enumerate(nodes):
        if node not in controllers:
            path = (*table.path, "nodes", index)
            raise _no_such(table.source, path, node, controllers, "controller")
    start_s = table.number("from_s", 0.0, low=0.0, high=1e9, unit="s")
    return FaultDescription(
        name=table.text("name", f"fault {number}"),
        bus=bus,
        kind=kind,
        id=table.integer("id", low=0, high=0x1FFFFFFF) if table.has("id") else None,
        id_mask=table.integer("id_mask", 0x1FFFFFFF, low=0, high=0x1FFFFFFF),
        sender=sender,
        from_s=start_s,
        until_s=(
            table.number("until_s", low=start_s, high=1e9, unit="s")
            if table.has("until_s")
            else None
        ),
        probability=table.number("probability", 1.0, low=0.0, high=1.0),
        count_max=(
            table.integer("count_max", low=1, high=2**31) if table.has("count_max") else None
        ),
        delay_s=(
            table.number("delay_s", low=0.0, high=1e6, unit="s", example="0.01")
            if kind == "delay"
            else 0.0
        ),
        nodes=nodes,
    )


def _refuse_shared_nodes(source: Source, controllers: Mapping[str, ControllerDescription]) -> None:
    taken: dict[tuple[str, int], str] = {}
    for name, controller in controllers.items():
        if controller.node_id is None:
            continue
        place = (controller.bus, controller.node_id)
        if place in taken:
            first = source.line(("controller", taken[place], "node_id"))
            used = [node for bus, node in taken if bus == controller.bus]
            free = next((node for node in range(1, NODE_MAX + 1) if node not in used), None)
            raise source.error(
                ("controller", name, "node_id"),
                f'{place[1]} on bus "{place[0]}" is controller "{taken[place]}" already '
                f"(line {first})",
                f"the first free node_id is {free}" if free else "use another bus",
            )
        taken[place] = name


def _node_id(table: Table) -> int | None:
    if not table.has("node_id"):
        return None
    return table.integer("node_id", low=0, high=NODE_MAX, example="1")


def _one_of(
    table: Table, key: str, known: tuple[str, ...], what: str, default: str | None = None
) -> str:
    if default is not None and not table.has(key):
        return default
    value = table.text(key, example=" or ".join(f'"{name}"' for name in known[:4]))
    if value not in known:
        message = f'unknown {what} "{value}" (known: {listed(known)})'
        raise table.error(key, message, nearest(value, known))
    return value


def _reference(table: Table, key: str, known: Mapping[str, object], what: str) -> str:
    value = table.text(key, example=" or ".join(f'"{name}"' for name in list(known)[:4]))
    if value not in known:
        raise _no_such(table.source, (*table.path, key), value, known, what)
    return value


def _no_such(
    source: Source, path: KeyPath, value: str, known: Mapping[str, object], what: str
) -> RigError:
    remedy = nearest(value, list(known))
    if not remedy.startswith("did"):
        remedy = f"name one of these, or add [{what}.{value}]"
    return source.error(path, f'there is no {what} "{value}" (known: {listed(known)})', remedy)


def _without(table: Table, keys: tuple[str, ...]) -> dict[str, object]:
    return {key: value for key, value in table.values.items() if key not in keys}
