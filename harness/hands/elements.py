"""Elements of a rig that a hand can act on: inputs of controllers, and buses.

A twin of each controller names its inputs, and shows which values they take.
"""

from typing import Any, Final

from motorhil.emulators.controller import Controller
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.harness.rig.acts import Acts
from motorhil.harness.rig.config.buses import MODBUS_TCP, BusDescription
from motorhil.harness.rig.config.derived import plant_in
from motorhil.harness.rig.config.faults import (
    HOST,
    KINDS,
    LINE_FAULT_KINDS,
    ON_TCP,
    FaultTable,
)
from motorhil.harness.rig.config.rig_file import ControllerDescription, RigDescription
from motorhil.settings import declaration

_KNOWN: Final = "known: "  # Controller.stimulate: ValueError names the known ones
_UNITS: Final = (("_n_m", "N·m"), ("_v", "V"), ("_c", "°C"), ("_a", "A"), ("_n", "N"))
_TORQUE_N_M, _SUPPLY_V = 10.0, 48.0  # if the rig's plant does not say
_TEMPERATURE_C: Final = (-20.0, 150.0, 25.0)
NUMBER, SWITCH, TOGGLE, CODE = "number", "switch", "toggle", "code"


def elements_of(description: RigDescription, acts: Acts) -> dict[str, Any]:
    """Return the controllers with their inputs, and the buses with their kinds of faults."""
    motors: dict[str, list[str]] = {}
    for motor in description.motors.values():
        motors.setdefault(motor.controller or "", []).append(motor.name)
    controllers = [
        {
            "name": one.name,
            "motors": motors.get(one.name, []),
            "bus": one.bus,
            "can_be_cut": not description.buses[one.bus].is_line,
            "inputs": _inputs(acts.twin(one.name), one),
        }
        for one in description.controllers.values()
    ]
    return {
        "controllers": controllers,
        "buses": [_bus(description, one) for one in description.buses.values()],
    }


def _inputs(twin: Controller, described: ControllerDescription) -> list[dict[str, Any]]:
    """Return the inputs of a controller: name, kind, unit, usual range and value at rest."""
    plant = plant_in(described)
    found = []
    for name in names_of(twin):
        low, high, rest = _range(name, plant)
        kind = _kind(twin, name)
        if not kind:
            continue
        table: dict[str, Any] = {"name": name, "kind": kind, "unit": ""}
        if kind == NUMBER:
            unit = next((unit for ending, unit in _UNITS if name.endswith(ending)), "")
            table |= {"unit": unit, "low": low, "high": high, "rest": rest}
        elif kind != CODE:
            table["rest"] = -1.0 if kind == SWITCH else float(name in ("power", "encoder"))
        found.append(table)
    return found


def names_of(controller: Controller) -> list[str]:
    """Return the names of a controller's inputs, as its refusal of another one lists them."""
    try:
        controller.stimulate("", 0.0, 0)
    except ValueError as error:
        _, found, names = str(error).partition(_KNOWN)
        return [name.strip() for name in names.split(",") if name.strip()] if found else []
    except Exception:  # of a third party's controller
        return []
    return []


def _kind(twin: Controller, name: str) -> str:
    """Return the kind of an input, by the values that it takes; "": the rig permits none."""
    if _takes(twin, name, 0.5):
        return NUMBER
    if _takes(twin, name, 2.0):
        return CODE
    if _takes(twin, name, -1.0):
        return SWITCH
    if _takes(twin, name, 1.0):
        return TOGGLE if _takes(twin, name, 0.0) else CODE
    return ""


def _takes(twin: Controller, name: str, value: float) -> bool:
    try:
        twin.stimulate(name, value, 0)
    except Exception:  # a ValueError, or a third party's
        return False
    return True


def _range(name: str, plant: MotorPlant | None) -> tuple[float, float, float]:
    """Return the usual range of an input, and its value at rest."""
    if name.endswith("temperature_c"):
        return _TEMPERATURE_C
    if name.endswith("supply_v"):
        supply_v = _SUPPLY_V if plant is None else plant.supply_v
        return 0.0, 2.0 * supply_v, supply_v
    torque = _TORQUE_N_M
    if plant is not None:
        torque = plant.torque_constant_n_m_a * plant.current_max_a * plant.gear_ratio
    return -2.0 * torque, 2.0 * torque, 0.0 if plant is None else plant.load_torque_n_m


def _bus(description: RigDescription, bus: BusDescription) -> dict[str, Any]:
    """Return a bus: its nodes, and its kinds of faults, each with the keys that it needs."""
    controllers = description.controllers.values()
    nodes = [*(one.name for one in controllers if one.bus == bus.name), HOST]
    kinds = KINDS
    if bus.is_line:
        kinds = ON_TCP if bus.kind == MODBUS_TCP else LINE_FAULT_KINDS
    return {
        "name": bus.name,
        "nodes": nodes,
        "kinds": [{"kind": kind, "keys": needed(kind, bus.is_line, nodes[0])} for kind in kinds],
    }


def needed(kind: str, is_line: bool, node: str) -> str:
    """Return the keys that a kind of fault needs, with examples of their values."""
    keys = declaration(FaultTable).keys
    found = []
    for rule in declaration(FaultTable).rules:
        if rule.key != "kind" or rule.otherwise or kind not in rule.values or not rule.required:
            continue
        key = rule.required[-1 if is_line or kind == "error" else 0]
        value = {"nodes": f'["{node}"]', "sender": f'"{node}"', "error": '"crc"'}.get(key)
        example = keys[key].kind.example().partition(" or ")[0]  # the first of several words
        found.append(f"{key} = {value or example}")
    return ", ".join(found)
