"""Motors and nodes: their states, the age of their heartbeats, their latest faults."""

from collections.abc import Iterable, Mapping
from typing import Final

from motorhil.harness.report.buses import NO_HEARTBEAT, RESET, CanBus, Place, nmt_text
from motorhil.harness.report.collect import Findings
from motorhil.harness.report.document import Json
from motorhil.harness.report.incidents import Incident, Severity
from motorhil.harness.report.motors import Motor
from motorhil.traces.decoding.attached_rig import MotorFacts
from motorhil.traces.decoding.cia402 import STATES, UNKNOWN_STATE, mode_text

_ABSENT: Final = (NO_HEARTBEAT, RESET)
_BAD: Final = ("fault", "fault reaction active")


def presence_of(
    found: Findings, motors: Iterable[Motor], owners: Mapping[str, str], now_ns: int
) -> list[Json]:
    """Return a row for each motor, then one for each node without a motor.

    Args:
        found: the contents of the record so far.
        motors: its motors.
        owners: owner of each locked motor, by its name.
        now_ns: the present time from the record's beginning [ns].
    """
    rows: list[Json] = []
    places: set[tuple[str, int]] = set()
    for motor in motors:
        facts = found.rig.motors.get(motor.name, MotorFacts(motor.name))
        place = motor.place or ((*facts.place, facts.channel) if facts.place else None)
        if place is not None:
            places.add(place[:2])
        row = _row(found, motor.name, facts.controller, place, now_ns)
        row["state"] = _state(motor)
        row["owner"] = owners.get(motor.name, "")
        if motor.told is not None and motor.told.mode.last is not None:
            row["mode"] = mode_text(motor.told.mode.last)
        rows.append(row | {"alarm": row["alarm"] or row["state"] in _BAD})
    for bus, node, _ in sorted(found.nodes.told):
        if (bus, node) not in places:
            places.add((bus, node))
            name = found.names.nodes.get((bus, node), f"{bus} node {node}")
            rows.append(_row(found, name, None, (bus, node, 1), now_ns))
    return rows


def latest_faults(
    found: Findings, incidents: Iterable[Incident], rows: list[Json]
) -> dict[str, str]:
    """Return the latest warning or error about each row, by its name.

    Incidents name a motor, a controller, or a node of their bus.
    """
    known = {str(row["name"]): _aliases(found, row) for row in rows}
    faults: dict[str, str] = {}
    for one in incidents:
        if one.severity is not Severity.INFO:
            words = f" {one.place} {one.text} ".replace(":", " ").replace(",", " ")
            for name, (bus, aliases, node) in known.items():
                is_named = any(f" {alias} " in words for alias in aliases)
                if is_named or (one.place == bus and node and f" {node} " in words):
                    faults[name] = f"{one.time_ns / 1e9:.3f} s {one.kind}: {one.text}"
    return faults


def _aliases(found: Findings, row: Json) -> tuple[str, tuple[str, ...], str]:
    """Return the bus, the names of the motor and its controller, and the node's number."""
    name = str(row["name"])
    bus, _, node = str(row["place"]).rpartition(" ")
    facts = found.rig.motors.get(name)
    controller = None if facts is None else facts.controller
    if controller is None and node.isdecimal():
        controller = found.names.nodes.get((bus, int(node)))
    return bus, (name,) if controller is None else (name, controller), f"node {node}"


def _row(
    found: Findings, name: str, controller: str | None, place: Place | None, now_ns: int
) -> Json:
    row: Json = {"name": name, "place": "", "state": "", "mode": "", "owner": "", "nmt": ""}
    row |= {"age_s": None, "late": False, "heard_s": None, "errors": "", "alarm": False}
    if place is None:
        return row
    bus_name, node, _ = place
    row["place"] = f"{bus_name} {node}"
    bus = found.buses.get(bus_name)
    if bus is None:
        return row
    told = found.nodes.told.get((bus_name, node, 1))
    code = None if told is None else told.nmt.last
    row["nmt"] = "" if code is None else nmt_text(code)
    beat = bus.heartbeats().get(node)
    if beat is not None:
        last_ns, period_ns = beat
        row["age_s"] = (now_ns - last_ns) / 1e9
        row["late"] = period_ns is not None and now_ns - last_ns > 3 * period_ns
    row["alarm"] = row["late"] or code in _ABSENT
    _add_sender(row, bus, controller or name, now_ns)
    return row


def _add_sender(row: Json, bus: CanBus, sender: str, now_ns: int) -> None:
    heard_ns = bus.heard.get(sender)
    if heard_ns is not None:
        row["heard_s"] = (now_ns - heard_ns) / 1e9
    error = bus.controllers.get(sender)
    if error is not None:
        state = "" if error.state is None else error.state.value
        tec_rec = "" if error.counters is None else "TEC {} REC {}".format(*error.counters)
        row["errors"] = f"{state} {tec_rec}".strip()


def _state(motor: Motor) -> str:
    """Return the PDS state from statuswords, else from the drive's truth."""
    code: float | None = None
    if motor.told is not None and motor.told.pds.last is not None:
        code = motor.told.pds.last
    elif motor.truth_states is not None:
        code = motor.truth_states.values[-1] if len(motor.truth_states) else None
    if code is None or not float(code).is_integer() or not 0 <= code < UNKNOWN_STATE:
        return ""
    return STATES[int(code)][2]
