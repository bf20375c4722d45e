"""Rig file: buses, controllers, motors, faults and stimuli.

A rig is TOML. This module checks its structure, and every name that refers to another one. The
settings of a controller or motor are checked by its builder; errors in them still report their line
(`RigDescription.source`). `motorhil.harness.rig.config.schema` describes the same for editors.

    [rig]                       name, seed
    [bus.NAME]                  kind = "can", bitrate_bit_s; or a line (see BusDescription)
    [bus.NAME.node.NAME]        the CAN controller of one node (see read_nodes)
    [[bus.NAME.message]]        a message of others: identifier, length, period_s, jitter_s
    [controller.NAME]           kind, bus, node_id, and the kind's own settings
    [motor.NAME]                adaptation, model, and its own settings; its place: controller, or
                                bus and node_id, or nothing if its adaptation needs no bus
    [group.NAME]                motors
    [[fault]]                   bus, kind, conditions
    [[stimulus]]                controller, name, value, at_s
    [program.NAME]              command, and whether it shares the rig's time
    [conformance]               facts declared about the motors under test
    [world]                     what one world of a swarm changes
    [swarm]                     how the worlds of a swarm are drawn and judged
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar, Final, final

from motorhil.frozen import frozen
from motorhil.harness.plugins import is_target
from motorhil.harness.rig.config.buses import (
    AddressTable,
    BusDescription,
    address_key,
    address_max,
    read_address,
    read_bus,
    refuse_shared_addresses,
    refuse_strangers,
)
from motorhil.harness.rig.config.conformance import NOTHING_DECLARED, Facts, read_facts
from motorhil.harness.rig.config.faults import HOST, FaultDescription, read_faults
from motorhil.harness.rig.config.programs import ProgramDescription, read_program
from motorhil.harness.rig.config.stimuli import StimulusDescription, read_stimuli
from motorhil.harness.rig.config.toml import (
    SEED_MAX,
    RigError,
    Source,
    Table,
    one_line,
    read_source,
    replaced,
)
from motorhil.harness.rig.config.worlds import (
    UNDISTURBED,
    WorldDescription,
    changed,
    read_world,
)
from motorhil.motorapi.model import MotorModel
from motorhil.settings import (
    REQUIRED,
    Items,
    KeyPath,
    Schema,
    Text,
    declaration,
    flag,
    listed,
    nearest,
    parse_toml,
    setting,
    text,
    whole,
)

_PLANT_REMEDY: Final = "make it with motorhil identify -o plant.toml"
TOP_KEYS: Final = (
    *("rig", "bus", "controller", "motor", "group", "fault", "stimulus", "program"),
    *("conformance", "world", "swarm"),
)


@final
@frozen(kw_only=True, slots=False)
class RigTable:
    """The rig as a whole."""

    name: str | None = setting(
        None, Text(shown='"my rig"', is_printable=True), "Its name; absent: the file's."
    )
    seed: int = whole(0, 0, SEED_MAX, "", "Seed of all random numbers of a run.", example="1")


@final
@frozen(kw_only=True, slots=False)
class FromElsewhereTable:
    """Keys that the harness adds to the table of a plant."""

    file: str | None = text(
        None,
        "A plant of `motorhil identify`, for values that this table does not give.",
        example='"plant.toml"',
    )

    from_motor_model: bool = flag(
        False,
        "Take missing values from the motor's model. A mistake there is then on both sides, and"
        " hides itself.",
    )


@final
@frozen(kw_only=True, slots=False)
class ControllerTable(AddressTable):
    """An emulated controller; further keys are those of its kind."""

    kind: str = text(REQUIRED, "Its kind: see `motorhil list controllers`.", example='"cia402"')
    bus: str = text(REQUIRED, "The bus or line that it is on.", example='"can0"')


@final
class _Model:
    """A file's name, or a table."""

    def read(self, value: object, path: KeyPath) -> object:
        if isinstance(value, Mapping):
            return MappingProxyType(dict(value))
        return Text(shown='"motor.toml"').read(value, path)

    def schema(self) -> Schema:
        return {"oneOf": [Text().schema(), {"$ref": declaration(MotorModel)}]}

    def example(self) -> str:
        return '"motor.toml"'


@final
@frozen(kw_only=True, slots=False)
class MotorTable(AddressTable):
    """A motor as the application sees it; further keys are those of its adaptation."""

    adaptation: str = text(
        REQUIRED, "What drives it: see `motorhil list adaptations`.", example='"cia402"'
    )
    controller: str | None = text(
        None, "The emulated controller behind it, on whose bus it is.", example='"left"'
    )
    bus: str | None = text(None, "Instead of a controller: its bus or line.", example='"can0"')
    model: str | Mapping[str, object] = setting(
        REQUIRED, _Model(), "Its motor model: a file, from the rig's folder on, or a table."
    )

    SCHEMA: ClassVar[Mapping[str, object]] = {
        "if": {"required": ["controller"]},
        "then": {"properties": {"bus": False, "node_id": False, "unit": False}},
        "properties": {"name": False},
    }


@final
@frozen(kw_only=True, slots=False)
class GroupTable:
    """Motors that move together."""

    motors: tuple[str, ...] = setting(
        REQUIRED, Items(Text(), least=1, shown='["left", "right"]'), "Their names."
    )


RESERVED: Final = HOST
"""The name of the application's ports on every bus; controllers cannot have it."""
_NEW_REMEDY: Final = "check the path, or write a new rig: motorhil new DIR"


@final
@frozen
class ControllerDescription:
    """An emulated controller.

    Attributes:
        name: name in the rig.
        kind: the plugin that builds it.
        bus: its bus.
        node_id: its node-ID, or its unit on a line; None if its kind has none.
        settings: its table without `kind`, `bus`, `plant.from_motor_model` and `plant.file`.
        plants_from_model: paths of the plant tables in it (`plant`, `channel.2.plant`) that take
            missing values from their motor's model.
    """

    name: str
    kind: str
    bus: str
    node_id: int | None
    settings: Mapping[str, object]
    plants_from_model: tuple[KeyPath, ...]


@final
@frozen
class MotorDescription:
    """A motor as the application sees it.

    Attributes:
        name: name in the rig.
        adaptation: the plugin that builds it.
        bus, node_id: bus and node-ID (on a line: unit) of its controller; None if the adaptation
            needs no bus.
        controller: its emulated controller; None if the table names bus and node_id itself.
        model: a motor model file, or the model itself.
        settings: its table without the keys above.
    """

    name: str
    adaptation: str
    bus: str | None
    node_id: int | None
    controller: str | None
    model: Path | Mapping[str, object]
    settings: Mapping[str, object]


@final
@frozen
class GroupDescription:
    """Names of motors that move together."""

    name: str
    motors: tuple[str, ...]


@final
@frozen
class RigDescription:
    """A checked rig file, in which every name refers to something.

    `attached`, for a rig out of a recording: (name, media type, contents) of the recording's files.
    """

    name: str
    seed: int
    buses: Mapping[str, BusDescription]
    controllers: Mapping[str, ControllerDescription]
    motors: Mapping[str, MotorDescription]
    groups: Mapping[str, GroupDescription]
    faults: tuple[FaultDescription, ...]
    stimuli: tuple[StimulusDescription, ...]
    source: Source
    attached: tuple[tuple[str, str, bytes], ...] = ()
    programs: Mapping[str, ProgramDescription] = field(default_factory=dict)
    conformance: Facts = NOTHING_DECLARED
    world: WorldDescription = UNDISTURBED

    @property
    def folder(self) -> Path:
        """The folder in which relative paths of the rig start."""
        return self.source.path.parent

    def error(
        self, path: KeyPath, message: str, remedy: str = "", kind: type[RigError] = RigError
    ) -> RigError:
        """Return the error for a value of this rig, with its line."""
        return self.source.error(path, message, remedy, kind)


def _all_need_one(adaptation: str) -> bool | None:
    return True


@final
@frozen
class Known:
    """The plugins that a rig may name.

    Attributes:
        controllers, adaptations: names of the plugins.
        needs_bus: returns True if motors of this adaptation are on a bus, or None if the adaptation
            cannot be loaded; the error is then reported when the motor is built.
        takes_targets: True if the rig may also name code, "package.module:function"; not if the
            rig comes from elsewhere, in a recording.
    """

    controllers: tuple[str, ...]
    adaptations: tuple[str, ...]
    needs_bus: Callable[[str], bool | None] = _all_need_one
    takes_targets: bool = True


def read_rig(path: Path, known: Known, world: Source | None = None) -> RigDescription:
    """Read the rig in a file, with the fragment of a world appended if one is given.

    Raises:
        RigError: a file does not exist, or the first error in them.
    """
    source = read_source(path, _NEW_REMEDY)
    if world is not None:
        source = source.with_fragment(world)
    return parse_rig(source, known)


def parse_rig(source: Source, known: Known) -> RigDescription:
    """Read the rig in a text.

    Raises:
        RigError: the first error in it.
    """
    root = source.root()
    root.refuse_unknown(TOP_KEYS, "table")
    root = changed(root)
    rig = root.table("rig").read(RigTable)
    buses = {name: read_bus(name, table) for name, table in _named(root, "bus")}
    if not buses and _needs_bus(root, known):
        raise source.error((), "the rig has no bus", "add [bus.can0]")
    controllers = {
        name: _controller(name, table, buses, known) for name, table in _named(root, "controller")
    }
    refuse_shared_addresses(source, buses)
    _refuse_shared_nodes(source, controllers, buses)
    for bus, names in _on_each(buses, controllers).items():
        refuse_strangers(source, bus, buses[bus].nodes, buses[bus].silent, (HOST, *names))
    motors = {
        name: _motor(name, table, buses, controllers, known)
        for name, table in _named(root, "motor")
    }
    groups = {name: _group(name, table, motors) for name, table in _named(root, "group")}
    return RigDescription(
        name=one_line(source.path.stem) if rig.name is None else rig.name,
        seed=rig.seed,
        buses=MappingProxyType(buses),
        controllers=MappingProxyType(controllers),
        motors=MappingProxyType(motors),
        groups=MappingProxyType(groups),
        faults=read_faults(root, _on_each(buses, controllers), buses),
        stimuli=read_stimuli(root, list(controllers)),
        source=source,
        programs=MappingProxyType(_programs(root, known)),
        conformance=read_facts(root.table("conformance"), tuple(motors)),
        world=read_world(root),
    )


def _programs(root: Table, known: Known) -> dict[str, ProgramDescription]:
    """Return the programs; none of a rig that comes from elsewhere, which starts nothing."""
    programs = {name: read_program(name, table) for name, table in _named(root, "program")}
    return programs if known.takes_targets else {}


def _needs_bus(root: Table, known: Known) -> bool:
    """Return True if anything in the rig needs a bus, or if the rig is empty."""
    motors = [table for _, table in _named(root, "motor")]
    if root.table("controller").values or not motors:
        return True
    named = [table.values.get("adaptation") for table in motors]
    return any(isinstance(name, str) and known.needs_bus(name) for name in named)


def _named(root: Table, key: str) -> "list[tuple[str, Table]]":
    """Return the tables [key.NAME]."""
    outer = root.table(key)
    tables = []
    for name in outer.values:
        outer.refuse_no_name(name)
        tables.append((name, outer.table(name)))
    return tables


def _controller(
    name: str, table: Table, buses: Mapping[str, BusDescription], known: Known
) -> ControllerDescription:
    own = table.part(ControllerTable)
    _check_plugin(table, "kind", own.kind, known, known.controllers)
    table.require("bus", own.bus, list(buses))
    settings = _without(table, ("kind", "bus"))
    asking: list[KeyPath] = []
    for plant in _plants(table):
        path = plant.path[len(table.path) :]
        elsewhere = plant.part(FromElsewhereTable)
        if elsewhere.from_motor_model:
            asking.append(path)
        if plant.has("from_motor_model") or plant.has("file"):
            values = _in_file(plant, elsewhere.file) | _without(plant, ("from_motor_model", "file"))
            settings = replaced(settings, path, values)
    if name == HOST or name.startswith(f"{HOST}-"):
        raise table.source.error(
            table.path, "is reserved for the application's ports on a bus", "rename it"
        )
    address = read_address(table, buses[own.bus])
    return ControllerDescription(name, own.kind, own.bus, address, settings, tuple(asking))


def _in_file(plant: Table, file: str | None) -> dict[str, object]:
    """Return the plant in a file beside the rig; nothing if no file is named."""
    if file is None:
        return {}
    path = plant.source.path.parent / file
    if not _is_file(path):
        raise plant.error("file", f"no such file: {path}", "paths start at the rig's folder")
    try:
        found = parse_toml(path.read_text("utf-8")).get("plant")
    except (OSError, ValueError, RecursionError) as error:
        raise plant.error("file", f"{path} is not TOML: {error}", _PLANT_REMEDY) from None
    if not isinstance(found, dict):
        raise plant.error("file", f"{path} has no table [plant]", _PLANT_REMEDY)
    return found


def _check_plugin(table: Table, key: str, name: str, known: Known, names: Sequence[str]) -> None:
    """Refuse a name that is neither a plugin's nor "package.module:function" (RigError)."""
    if is_target(name):
        if not known.takes_targets:
            raise table.error(
                key,
                f'"{name}" names code to run, which a recording may not',
                "name a rig file of your own",
            )
    elif name not in names:
        what = "controller kind" if key == "kind" else key
        message = f'unknown {what} "{name}" (known: {listed(names)})'
        raise table.error(key, message, nearest(name, names))


def _plants(table: Table) -> list[Table]:
    """Return the controller's plant tables: its own, and those of its channels."""
    plants = [table.table("plant")]
    if isinstance(table.values.get("channel"), dict):
        channels = table.table("channel")
        plants += [
            channels.table(name).table("plant")
            for name, value in channels.values.items()
            if isinstance(value, dict)
        ]
    return plants


def _motor(
    name: str,
    table: Table,
    buses: Mapping[str, BusDescription],
    controllers: Mapping[str, ControllerDescription],
    known: Known,
) -> MotorDescription:
    if table.has("name"):
        raise table.error("name", f'the motor has the name of its table, "{name}"', "take it out")
    own = table.part(MotorTable)
    adaptation = own.adaptation
    _check_plugin(table, "adaptation", adaptation, known, known.adaptations)
    bus, node_id, controller = _place(table, own, buses, controllers, known)
    settings = _without(table, ("adaptation", "controller", "bus", "node_id", "unit", "model"))
    return MotorDescription(
        name, adaptation, bus, node_id, controller, _model(table, own), settings
    )


def _place(
    table: Table,
    own: MotorTable,
    buses: Mapping[str, BusDescription],
    controllers: Mapping[str, ControllerDescription],
    known: Known,
) -> tuple[str | None, int | None, str | None]:
    """Return (bus, node_id, controller) of a motor."""
    needs_bus = known.needs_bus(own.adaptation)
    if needs_bus is False:
        for key in ("controller", "bus", "node_id", "unit"):
            if table.has(key):
                problem = f'a motor of adaptation "{own.adaptation}" is not on a bus'
                raise table.error(key, problem, f"take out {key}")
        return None, None, None
    if own.controller is not None:
        table.require("controller", own.controller, list(controllers))
        for key in ("bus", "node_id", "unit"):
            if table.has(key):
                raise table.error(key, "follows from the controller", f"take out {key}")
        described = controllers[own.controller]
        return described.bus, described.node_id, own.controller
    if own.bus is not None:
        table.require("bus", own.bus, list(buses))
        return own.bus, read_address(table, buses[own.bus]), None
    if needs_bus is None:
        return None, None, None
    known_names = listed(controllers)
    raise table.missing("controller", f"name one ({known_names}), or write bus and node_id")


def _model(table: Table, own: MotorTable) -> Path | Mapping[str, object]:
    if not isinstance(own.model, str):
        return own.model
    path = table.source.path.parent / own.model
    if not _is_file(path):
        raise table.error("model", f"no such file: {path}", "paths start at the rig's folder")
    return path


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _group(name: str, table: Table, motors: Mapping[str, MotorDescription]) -> GroupDescription:
    members = table.read(GroupTable).motors
    for index, member in enumerate(members):
        table.require("motors", member, list(motors), "motor", index)
    return GroupDescription(name, members)


def _refuse_shared_nodes(
    source: Source,
    controllers: Mapping[str, ControllerDescription],
    buses: Mapping[str, BusDescription],
) -> None:
    taken: dict[tuple[str, int], str] = {}
    for name, controller in controllers.items():
        if controller.node_id is None:
            continue
        place = (controller.bus, controller.node_id)
        if place in taken:
            bus = buses[controller.bus]
            key, last = address_key(bus), address_max(bus)
            first = source.line(("controller", taken[place], key))
            used = [node for name_of_bus, node in taken if name_of_bus == controller.bus]
            free = next((node for node in range(1, last + 1) if node not in used), None)
            raise source.error(
                ("controller", name, key),
                f'{place[1]} on bus "{place[0]}" is already used by controller '
                f'"{taken[place]}" (line {first})',
                f"the first free {key} is {free}" if free else "use another bus",
            )
        taken[place] = name


def _on_each(
    buses: Mapping[str, BusDescription], controllers: Mapping[str, ControllerDescription]
) -> dict[str, list[str]]:
    return {
        bus: [name for name, controller in controllers.items() if controller.bus == bus]
        for bus in buses
    }


def _without(table: Table, keys: tuple[str, ...]) -> dict[str, object]:
    return {key: value for key, value in table.values.items() if key not in keys}
