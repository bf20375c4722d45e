"""JSON Schema of rig files, from the declarations of all tables and of installed plugins.

A plugin declares its table by an entry point: in `motorhil.controller_settings` or
`motorhil.adaptation_settings`, under the plugin's own name. A plugin without one takes any keys.
"""

import json
import sys
from collections.abc import Mapping
from typing import Any, Final

from motorhil.emulators.settings.tables import PLANT
from motorhil.harness.plugins import ADAPTATIONS, CONTROLLERS, SETTINGS, installed
from motorhil.harness.rig.config.buses import AddressTable, BusTable
from motorhil.harness.rig.config.conformance import ConformanceTable
from motorhil.harness.rig.config.derived import TimingTable
from motorhil.harness.rig.config.faults import FaultTable
from motorhil.harness.rig.config.programs import ProgramTable
from motorhil.harness.rig.config.rig_file import (
    RESERVED,
    ControllerTable,
    FromElsewhereTable,
    GroupTable,
    MotorTable,
    RigTable,
)
from motorhil.harness.rig.config.stimuli import StimulusTable
from motorhil.harness.rig.config.toml import NAME
from motorhil.harness.rig.config.worlds import SwarmTable, WorldTable
from motorhil.settings import Declaration, Schema, declaration, schema, with_definitions

_PLACE: Final = ("controller", "bus", *declaration(AddressTable).keys)


def rig_schema() -> Schema:
    """Return the JSON Schema of rig files, with the tables of installed plugins."""
    name = f"^{NAME.pattern}$"
    root = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "motorhil rig",
        "description": "A rig: buses, emulated controllers with their plants, motors, groups and"
        " faults. `motorhil check` also checks the names that refer to one another.",
        "type": "object",
        "additionalProperties": False,
        "properties": {
            "rig": {"$ref": declaration(RigTable)},
            "bus": {**_named(name, BusTable, "Buses by name."), "minProperties": 1},
            "controller": _named(
                f"^(?!{RESERVED}$|{RESERVED}-){NAME.pattern}$",
                "controller",
                "Emulated controllers by name.",
            ),
            "motor": _named(name, "motor", "Motors by name, as the application sees them."),
            "group": _named(name, GroupTable, "Motors that move together."),
            "fault": _listed(FaultTable, "Faults of buses and lines."),
            "stimulus": _listed(StimulusTable, "Changes of physical inputs of controllers."),
            "program": _named(name, ProgramTable, "Programs that `motorhil run RIG` starts."),
            "conformance": {"$ref": declaration(ConformanceTable)},
            "world": {"$ref": declaration(WorldTable)},
            "swarm": {"$ref": declaration(SwarmTable)},
        },
        "anyOf": [{"required": ["bus"]}, _without_bus()],
    }
    whole = with_definitions({"root": root, **_plugin_tables()})
    definitions = whole.pop("$defs")
    root = whole.pop("root")
    # The harness reads these keys itself, and removes them from what it hands to a plugin.
    from_model = schema(FromElsewhereTable)["properties"]
    definitions[PLANT.name]["properties"] |= from_model
    whole["controller"]["properties"]["plant"] = {"type": "object", "properties": from_model}
    return {**root, "$defs": {**whole, **definitions}}


def schema_text() -> str:
    """Return the JSON Schema of rig files as a text."""
    return json.dumps(rig_schema(), indent=1, ensure_ascii=False) + "\n"


def _named(pattern: str, of: "type | str", doc: str) -> Schema:
    item = {"$ref": f"#/$defs/{of}" if isinstance(of, str) else declaration(of)}
    return {
        "type": "object",
        "description": doc,
        "propertyNames": {"pattern": pattern},
        "additionalProperties": item,
    }


def _listed(of: type, doc: str) -> Schema:
    return {"type": "array", "description": doc, "items": {"$ref": declaration(of)}}


def _declared(group: str) -> dict[str, Declaration]:
    """Return the tables that installed plugins of a group declare, by plugin."""
    loaded = {name: plugin.load() for name, plugin in installed(SETTINGS[group]).items()}
    return {name: declaration(of) for name, of in loaded.items()}  # type: ignore[arg-type]


def _needs_bus(of: Declaration) -> bool:
    return any(key in of.keys for key in declaration(AddressTable).keys)


def _without_bus() -> Schema:
    """Return the schema of a rig without a bus: all its motors do without."""
    on_bus = [name for name, of in _declared(ADAPTATIONS).items() if _needs_bus(of)]
    motor = {"properties": {"adaptation": {"not": {"enum": on_bus}}}}
    return {
        "required": ["motor"],
        "properties": {
            "controller": {"maxProperties": 0},
            "motor": {"minProperties": 1, "additionalProperties": motor},
        },
    }


def _plugin_tables() -> dict[str, Schema]:
    """Return the tables of controllers and motors, with those of plugins."""
    tables: dict[str, Schema] = {}
    for name, group, key, base in (
        ("controller", CONTROLLERS, "kind", schema(ControllerTable)),
        ("motor", ADAPTATIONS, "adaptation", schema(MotorTable)),
    ):
        declared = _declared(group)
        conditions = list(base.get("allOf", []))
        base["properties"][key]["examples"] = list(declared)
        for plugin, of in declared.items():
            place = f"{plugin}_{name}"
            only = {"properties": {key: {"const": plugin}}, "required": [key]}
            conditions.append({"if": only, "then": {"$ref": f"#/$defs/{place}"}})
            tables[place] = _of_plugin(of, base["properties"], key)
        tables[name] = {**base, "additionalProperties": True, "allOf": conditions}
    return tables


def _of_plugin(of: Declaration, base: Mapping[str, Any], key: str) -> Schema:
    """Return the table of a plugin, with the keys that the harness reads itself."""
    own = schema(of)
    address = declaration(AddressTable).keys
    read_here = [one for one in base if one not in address and one not in own["properties"]]
    own["properties"] |= {name: {} for name in read_here}
    if key == "kind":
        return own
    own["properties"].pop("name", None)
    own["required"] = [one for one in own.get("required", ()) if one not in _PLACE]
    if _needs_bus(of):
        own["anyOf"] = [{"required": ["controller"]}, {"required": ["bus"]}]
        own["properties"] |= schema(TimingTable)["properties"] if of.name == "cia402" else {}
    else:
        own["properties"] |= dict.fromkeys(_PLACE, False)
    return own


if __name__ == "__main__":
    sys.stdout.write(schema_text())
