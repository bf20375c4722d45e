"""What the rig and the motor models attached to a recording tell of bit rates and units."""

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, final

from traces.recorded_names import is_rig
from traces.structure import Attachment

# A TOML table, hence Any.
Table = dict[str, Any]


@final
@dataclass(frozen=True, slots=True)
class MotorFacts:
    """What is known of a motor beforehand.

    Attributes: name; unit ("rad", "m", or "" if no model tells it); increments_per_unit (of the
    drive's position; None: not known); velocity_unit (what 1 is in the drive's velocities, in units
    a second; None: not known); controller (None: not told); place (bus and node or unit;
    None: not told); channel (of the controller, from 1); model (the file that told the units);
    model_table (all that the model says).
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
    """What is known of a rig.

    Attributes: name; bitrates [bit/s] of CAN buses and serial lines; data_bitrates [bit/s] of
    CAN FD buses; by_priority, of each CAN bus (nodes that send their most urgent frame first);
    motors, in the rig's order; groups (their motors); settings (of controllers, as
    the rig has them).
    """

    name: str = ""
    bitrates: dict[str, int] = field(default_factory=dict)
    data_bitrates: dict[str, int] = field(default_factory=dict)
    by_priority: dict[str, frozenset[str]] = field(default_factory=dict)
    motors: dict[str, MotorFacts] = field(default_factory=dict)
    groups: dict[str, list[str]] = field(default_factory=dict)
    settings: dict[str, Table] = field(default_factory=dict)


def facts_of(attachments: Iterable[Attachment]) -> RigFacts:
    """As far as they tell it; what cannot be read tells nothing."""
    tables: dict[str, Table] = {}
    rig: Table | None = None
    for one in attachments:
        try:
            table = tables[one.name.rpartition("/")[2]] = tomllib.loads(one.data.decode())
        except (tomllib.TOMLDecodeError, UnicodeDecodeError):
            continue
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
    place = _place(controllers.get(controller, {}) if isinstance(controller, str) else motor)
    if controller is None and place is not None:
        controller = next((c for c, table in controllers.items() if _place(table) == place), None)
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
    """Increments as gear and encoder make them, as motor models have it."""
    from math import tau

    encoder = model.get("encoder_increments_rev")
    gear = model.get("motor_turns_per_m" if unit == "m" else "gear_ratio")
    if not isinstance(encoder, int | float) or not isinstance(gear, int | float):
        return None
    return encoder * gear if unit == "m" else encoder * gear / tau


def _tables(rig: Table, kind: str) -> dict[str, Table]:
    found = rig.get(kind)
    if not isinstance(found, dict):
        return {}
    return {name: table for name, table in found.items() if isinstance(table, dict)}


def _place(table: Table) -> tuple[str, int] | None:
    bus, number = table.get("bus"), table.get("node_id", table.get("unit"))
    return (bus, number) if isinstance(bus, str) and isinstance(number, int) else None
