"""`[world]` and `[swarm]` tables of a rig: one disturbed world, and how others are drawn.

A world is a rig with disturbances: faults, stimuli, changed settings of controllers, and the order
of parties that could continue at one instant. It is written as a fragment, TOML that is appended to
the rig's. `motorhil swarm` draws worlds, and keeps those that fail as fragments.
"""

from collections.abc import Mapping
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.rig.config.toml import SEED_MAX, Table, replaced
from motorhil.settings import (
    REQUIRED,
    Items,
    KeyPath,
    Number,
    Schema,
    SettingError,
    TableOf,
    TablesByKey,
    Text,
    listed,
    nearest,
    number,
    setting,
    text,
    whole,
)

WEIGHTS: Final[Mapping[str, float]] = {
    "drop": 4.0,
    "delay": 2.0,
    "duplicate": 1.0,
    "corrupt": 0.0,  # on CAN the CRC leaves one in millions of years; on lines see `lose`
    "error": 1.0,
    "lose": 4.0,
    "truncate": 1.0,
    "cut": 2.0,
    "noise": 1.0,
    "load": 1.0,
    "stall": 1.0,
    "heat": 1.0,
    "supply": 1.0,
    "power": 1.0,
    "fault": 2.0,
    "quirk": 1.0,
    "clock": 1.0,
    "plant": 1.0,
    "interleaving": 1.0,
    "kill": 1.0,
}
"""Kinds of disturbances, and how often each is drawn."""
ALLOWED_ERRORS: Final = (
    *("LinkError", "DeadlineExceeded", "DeviceFault", "MotionInterrupted"),
    "LineProtocolViolation",  # as an answer that was spoilt on its way shows
)


@final
@frozen
class _Value:
    """Any value; the settings that it changes check it."""

    def read(self, value: object, path: KeyPath) -> object:
        return value

    def schema(self) -> Schema:
        return {}

    def example(self) -> str:
        return "0.05"


@final
@frozen(kw_only=True, slots=False)
class ChangeTable:
    """A changed setting of a controller."""

    controller: str = text(REQUIRED, "The controller.", example='"left"')
    key: str = text(
        REQUIRED, "The setting, keys joined by dots.", example='"plant.load_inertia_kg_m2"'
    )
    value: object = setting(REQUIRED, _Value(), "Its value in this world.")


@final
@frozen(kw_only=True, slots=False)
class KillTable:
    """A program that is killed, as by `kill -9`."""

    program: str = text(REQUIRED, "The program, [program.NAME].", example='"driver"')
    at_s: float = number(REQUIRED, 0.0, 1e9, "s", "When, in the rig's time.", example="1.5")


@final
@frozen(kw_only=True, slots=False)
class WorldTable:
    """A world: changed settings, the order of parties, and the death of programs."""

    interleaving: int | None = whole(
        None,
        0,
        SEED_MAX,
        "",
        "Seed of the order of parties that could continue at one instant; absent: the one that"
        " waits longest is first.",
        example="1",
    )
    change: tuple[ChangeTable, ...] = setting(
        (), Items(TableOf(ChangeTable), unique=False), "Changed settings of controllers."
    )
    kill: tuple[KillTable, ...] = setting(
        (), Items(TableOf(KillTable), unique=False), "Programs of the rig that are killed."
    )


@final
@frozen(kw_only=True, slots=False)
class SwarmTable:
    """How `motorhil swarm` draws worlds, and how it judges them."""

    disturbances: int = whole(4, 0, 64, "", "Disturbances of a world, at most.")
    weights: Mapping[str, float] = setting(
        {}, TablesByKey(Number(0.0, 1e6)), "How often each kind of disturbance is drawn; 0: never."
    )
    plant_tolerance: float = number(
        0.1, 0.0, 0.9, "", "Share by which a number of a plant may differ."
    )
    clock_ppm: float = number(100.0, 0.0, 50_000.0, "ppm", "Largest error of a controller's clock.")
    delay_s: float = number(0.2, 1e-6, 3600.0, "s", "Longest delay of a frame.")
    answer_delay_s: float = number(
        1.0,
        1e-6,
        3600.0,
        "s",
        "Longest delay of an answer to a request, beyond usual deadlines.",
    )
    lasting_s: float = number(
        1.0, 1e-6, 3600.0, "s", "Longest duration of a cut, noise, load, supply or heat."
    )
    end_s: float | None = number(
        None,
        1e-3,
        1e9,
        "s",
        "Simulated time after which a run has failed; absent: 60 s, and ten times as long as the"
        " undisturbed run.",
    )
    allowed_errors: tuple[str, ...] = setting(
        ALLOWED_ERRORS,
        Items(Text(), shown='["LinkError"]'),
        "Errors that may end the program in a disturbed world; each other exception is a failure.",
    )
    oracles: tuple[str, ...] = setting(
        (), Items(Text(), shown='["limit-position"]'), "Oracles that judge; absent: a safe choice."
    )

    def __post_init__(self) -> None:
        """Refuse unknown kinds of disturbances (SettingError)."""
        for kind in self.weights:
            if kind not in WEIGHTS:
                message = f"is no kind of disturbance (known: {listed(WEIGHTS)})"
                raise SettingError(("weights", kind), message, nearest(kind, list(WEIGHTS)))

    def weight(self, kind: str) -> float:
        """Return how often a kind is drawn."""
        return self.weights.get(kind, WEIGHTS[kind])


UNDECLARED: Final = SwarmTable()
"""A rig without `[swarm]`."""


@final
@frozen
class WorldDescription:
    """How worlds of a rig are drawn, and which one this is.

    Attributes:
        interleaving: seed of the order of parties at one instant; None: the usual order.
        swarm: how worlds are drawn and judged.
        kills: programs that are killed, and when [ns].
    """

    interleaving: int | None = None
    swarm: SwarmTable = UNDECLARED
    kills: tuple[tuple[str, int], ...] = ()


UNDISTURBED: Final = WorldDescription()
"""A rig without `[world]`."""


def read_world(root: Table) -> WorldDescription:
    """Return the world of a rig; its changes are made by `changed`.

    Raises:
        RigError: the first error in the tables.
    """
    table = root.table("world")
    world = table.read(WorldTable)
    programs = list(root.table("program").values)
    for one in table.listed_tables("kill"):
        one.require("program", one.read(KillTable).program, programs)
    kills = tuple((one.program, round(one.at_s * 1e9)) for one in world.kill)
    return WorldDescription(world.interleaving, root.table("swarm").read(SwarmTable), kills)


def changed(root: Table) -> Table:
    """Return the rig with the changes of its world; errors in a changed value name the change.

    Raises:
        RigError: a change names no controller, or no setting.
    """
    changes = root.table("world").listed_tables("change")
    if not changes:
        return root
    controllers = root.table("controller")
    values = root.values
    for table in changes:
        own = table.read(ChangeTable)
        table.require("controller", own.controller, list(controllers.values))
        path = ("controller", own.controller, *own.key.split("."))
        if not all(path) or path[-1] in ("kind", "bus", "node_id", "unit"):
            raise table.error("key", f'"{own.key}" cannot be changed', "name another setting")
        try:
            values = replaced(values, path, own.value)
        except SettingError as error:
            what = f'"{error.path[-1]}" is not a table'
            raise table.error("key", what, "name a setting") from None
        root.source.redirect(path, (*table.path, "value"))
    return Table(root.source, root.path, values)
