"""Contents of the page: one JSON document and packed arrays."""

from collections.abc import Iterable
from math import isfinite
from typing import TYPE_CHECKING, Final

from motorhil.harness.report.buses import Traffic
from motorhil.harness.report.collect import Findings, GroupMoment
from motorhil.harness.report.incidents import Incident, Incidents, Severity
from motorhil.harness.report.motors import Line, Motor, Plot, motors_of
from motorhil.harness.report.responses import responses_of
from motorhil.harness.report.series import (
    FRAMES_MAX,
    POINTS_MAX,
    STRETCH_NS,
    Packed,
    Packer,
    cell_width_ns,
    cells,
    extremes,
    share,
)
from motorhil.harness.report.timelines import (
    Timeline,
    lock_timeline,
    mode_timeline,
    nmt_timeline,
    pds_timeline,
)
from motorhil.traces.mcap.reader import Trace

if TYPE_CHECKING:
    from numpy import int64
    from numpy.typing import NDArray

Json = dict[str, object]
FORMAT: Final = 1
WALL_NS: Final = 10**15
"""Log times from here on (11 days and more) are wall times, not times of a rig that began at 0."""


def document_of(
    trace: Trace,
    found: Findings,
    title: str,
    points_max: int = POINTS_MAX,
    frames_max: int = FRAMES_MAX,
) -> tuple[Json, str]:
    """Return the document and the packed arrays as text.

    Args:
        trace: the recording.
        found: its contents.
        title: title of the page.
        points_max: limit of all quantities together.
        frames_max: limit of all buses together.
    """
    span_ns = max(1, found.end_ns - found.begin_ns)
    packer = Packer(span_ns)
    motors = motors_of(found)
    notes = notes_of(trace, found)
    lines = [line for m in motors for p in m.plots for line in p.lines]
    points = sum(len(line.times_ns) for line in lines)
    omitted = sum(line.omitted for line in lines)
    if points > points_max or omitted:
        notes.append(
            f"{points + omitted:,} points of quantities are reduced to about "
            f"{min(points, points_max):,}: the first, the last, the lowest and the highest of each "
            "stretch of time"
        )
    frames = sum(len(one.times_ns) for one in found.traffics())
    if frames > frames_max or any(one.width_ns for one in found.traffics()):
        frames_all = sum(one.frames for one in found.traffics())
        notes.append(
            f"{frames_all:,} frames are drawn as sums over short stretches of time; see the panels"
        )
    traffic = [
        traffic_table(one, packer, _width_ns(one, share(len(one.times_ns), frames, frames_max)))
        for one in found.traffics()
    ]
    document: Json = {
        **head_of(trace, found, title, packer),
        "motors": [motor_table(m, packer, points, points_max) for m in motors],
        "timelines": [timeline_table(one, packer) for one in timelines_of(found, motors, span_ns)],
        "groups": groups_table(found.rig.groups, found.groups, packer),
        "traffic": traffic,
        "responses": responses_of(found),
        "incidents": incidents_table(found.incidents, found.incidents.kept(), packer),
        "notes": notes,
    }
    return document, packer.text()


def head_of(trace: Trace, found: Findings, title: str, packer: Packer) -> Json:
    """Return the part of the document that tells of the whole recording."""
    return {
        "format": FORMAT,
        "title": title,
        "file": trace.path.rpartition("/")[2],
        "time": time_table(found, packer),
        "facts": _facts(trace, found),
    }


def timelines_of(found: Findings, motors: list[Motor], span_ns: int) -> list[Timeline]:
    """Return the timelines of PDS states, locks, NMT states and modes, up to `span_ns`."""
    return [
        pds_timeline(found, motors, span_ns),
        lock_timeline(found, span_ns),
        nmt_timeline(found, motors, span_ns),
        mode_timeline(motors, span_ns),
    ]


def time_table(found: Findings, packer: Packer) -> Json:
    """Return the time axis: its kind, its length so far, and the duration of a tick."""
    span_ns = max(1, found.end_ns - found.begin_ns)
    kind = "rig"
    if found.in_order:
        kind = "order"
    elif found.begin_ns >= WALL_NS:
        kind = "wall"
    told: Json = {
        "kind": kind,
        "span": packer.ticks(span_ns),
        "tick_s": 1.0 if found.in_order else packer.tick_ns / 1e9,
        "begin_s": found.begin_ns / 1e9 if kind == "rig" else 0.0,
        "begin_ns": str(found.begin_ns),
    }
    return told


def _facts(trace: Trace, found: Findings) -> list[list[str]]:
    """Return the lines of the page's head: what was recorded, when, by which program."""
    facts: list[list[str]] = []
    if found.rig.name:
        facts.append(["rig", found.rig.name])
    run = trace.metadata.get("run", {})
    for key in ("seed", "command_line"):
        if run.get(key):
            facts.append([key.replace("_", " "), run[key]])
    source = trace.metadata.get("convert", {})
    if source:
        facts.append(["converted from", f"{source.get('source', '')} ({source.get('format', '')})"])
    facts.append(["messages", f"{sum(found.messages.values()):,}"])
    version = trace.metadata.get("versions", {}).get("motorhil")
    writer = trace.library or "unknown"
    facts.append(["written by", f"{writer} {version}" if version else writer])
    return facts


def notes_of(trace: Trace, found: Findings) -> list[str]:
    """Return the remarks on missing or reduced data."""
    notes: list[str] = []
    if not sum(found.messages.values()):
        notes.append("the recording holds no messages")
    if trace.cut is not None:
        more = f"; {trace.salvaged} messages of its last chunk were read" if trace.salvaged else ""
        notes.append(f"the file is {trace.cut}{more}")
    if found.in_order and found.messages:
        notes.append(
            "all messages have the same time: the axis counts messages, rates are not drawn"
        )
    if found.backward:
        notes.append(
            f"{found.backward:,} messages have earlier stamps than the previous one; they are "
            "drawn by stamp"
        )
    for topic, count in found.unread.items():
        notes.append(f"{count:,} messages of {topic} cannot be read")
    for topic, count in found.not_drawn.items():
        notes.append(f"{topic} ({count:,} messages) has a type that is not drawn")
    for kind, count in found.left_out.items():
        notes.append(f"the last {count:,} {kind} are not drawn")
    for name, bus in found.buses.items():
        if bus.unmapped:
            notes.append(
                f"{name}: the mapping of {bus.unmapped:,} possible PDOs is not in the "
                "recording, so their objects are not drawn"
            )
        if bus.doubts:
            notes.append(
                f"{name}: {bus.doubts:,} frames have identifiers of emergencies (081h "
                "to 0FFh), but the bus has no certain CANopen frame; they are ignored"
            )
        untyped = sorted({n for b, n, _ in found.nodes.told if b == name} & bus.untyped)
        if any(found.nodes.is_drive(name, node) for node in untyped):
            nodes = ", ".join(str(node) for node in untyped)
            notes.append(
                f"{name}: the device type 1000h of node {nodes} names no profile; its objects "
                "are read as those of CiA 402"
            )
        if bus.switched:
            notes.append(
                f"{name}: the data bit rate of {bus.switched:,} CAN FD frames is not in the "
                "recording; they are counted at the nominal rate; give it with --data-bitrate"
            )
    return notes + found.incidents.left_out()


# -------------------------------------------------------------------------------------- motors


def motor_table(motor: Motor, packer: Packer, points: int, points_max: int) -> Json:
    """Return a motor with packed plots, its share of `points` reduced to one of `points_max`."""
    return {
        "name": motor.name,
        "about": motor.about,
        "scale": motor.scale,
        "summary": _summary(motor, packer),
        "plots": [_plot(plot, packer, points, points_max) for plot in motor.plots],
    }


def _plot(plot: Plot, packer: Packer, points: int, points_max: int) -> Json:
    return {
        "quantity": plot.quantity,
        "unit": plot.unit,
        "missing": plot.missing,
        "lines": [
            line_table(line, packer, share(len(line.times_ns), points, points_max))
            for line in plot.lines
        ],
    }


def line_table(line: Line, packer: Packer, points: int) -> Json:
    """Return a line with about this number of points packed, or all if there are fewer."""
    times, values = extremes(line.times_ns, line.values, points)
    return {
        "name": line.name,
        "role": line.role,
        "source": line.source,
        "held": line.held,
        "points": len(line.times_ns) + line.omitted,
        "t": packer.times(times),
        "v": packer.numbers(values),
    }


def _summary(motor: Motor, packer: Packer) -> Json:
    """Return travel, top speed and largest following error, each from the best source."""
    import numpy as np

    told: Json = {}
    for quantity in ("position", "velocity", "following error"):
        line, unit = _best(motor, quantity)
        if line is None or not np.isfinite(line.values).any():
            continue
        if quantity == "position":
            place = int(np.nanargmax(line.values))
            value = float(line.values[place] - np.nanmin(line.values))
        else:
            place = int(np.nanargmax(abs(line.values)))
            value = float(abs(line.values[place]))
        if not isfinite(value):
            continue
        told[quantity] = {
            "value": value,
            "unit": unit,
            "at": packer.ticks(int(line.times_ns[place])),
            "source": line.source,
        }
    return told


def _best(motor: Motor, quantity: str) -> tuple[Line | None, str]:
    for role in ("truth", "actual"):
        for plot in motor.plots:
            if plot.quantity == quantity:
                for line in plot.lines:
                    if line.role == role:
                        return line, plot.unit
    return None, ""


# --------------------------------------------------------------- states, groups, buses, events


def timeline_table(line: Timeline, packer: Packer) -> Json:
    """Return the rows of a timeline, with packed bars."""
    rows: list[Json] = []
    for row in line.rows:
        texts = {text: n for n, text in enumerate(dict.fromkeys(bar.text for bar in row.bars))}
        rows.append(
            {
                "name": row.name,
                "left_out": row.left_out,
                "from": packer.whole([packer.ticks(bar.from_ns) for bar in row.bars]),
                "to": packer.whole([packer.ticks(bar.to_ns) for bar in row.bars]),
                "word": packer.whole([bar.word for bar in row.bars]),
                "waits": packer.whole([int(bar.waits) for bar in row.bars]),
                "text": packer.whole([texts[bar.text] for bar in row.bars]),
                "texts": list(texts),
            }
        )
    return {
        "title": line.title,
        "about": line.about,
        "words": line.words,
        "tones": line.tones,
        "rows": rows,
    }


def groups_table(known: Iterable[str], groups: list[GroupMoment], packer: Packer) -> list[Json]:
    """Return the moments by group: the known groups first, in their order."""
    order = {name: place for place, name in enumerate(known)}
    names = sorted(
        {one.group for one in groups}, key=lambda name: (order.get(name, len(order)), name)
    )
    return [
        {
            "name": name,
            "moments": [
                {
                    "at": packer.ticks(one.time_ns),
                    "start": one.is_start,
                    "motors": one.motors,
                    "offsets_s": [_finite(offset_s) for offset_s in one.offsets_s],
                    "skew_s": _finite(one.skew_s),
                    "predicted_s": _finite(one.predicted_s),
                    "method": one.method,
                }
                for one in groups
                if one.group == name
            ],
        }
        for name in names
    ]


def _finite(value: float | None) -> float | None:
    """Return None for a value that is not finite, since JSON cannot represent it."""
    return value if value is not None and isfinite(value) else None


def _width_ns(traffic: Traffic, budget: int) -> int:
    """Return the duration of cells that makes at most `budget` of them [ns]; 0: no cells."""
    if len(traffic.times_ns) <= budget:
        return traffic.width_ns
    times, keys, _, _ = traffic.arrays()
    return cell_width_ns(times, keys, budget, max(traffic.width_ns, STRETCH_NS))


def traffic_table(traffic: Traffic, packer: Packer, width_ns: int) -> Json:
    """Return the traffic of a bus or line, summed in cells of this duration [ns]; 0: frames."""
    import numpy as np

    times, keys, weights, counts = traffic.arrays()
    keys = _by_rank(traffic, keys)
    if width_ns:
        times, keys, weights, counts = cells(times, keys, weights, counts, width_ns)
        times = times + width_ns
    else:
        order = np.argsort(times, kind="stable")
        times, keys, weights = times[order], keys[order], weights[order]
    ranked = sorted(range(len(traffic.labels)), key=lambda n: (traffic.ranks[n], n))
    packed: dict[str, Packed] = {
        "t": packer.times(times),
        "key": packer.whole(keys),
        "weight": packer.whole(weights),
    }
    if width_ns:
        packed["count"] = packer.whole(counts)
    return {
        "name": traffic.name,
        "kind": traffic.kind,
        "unit": traffic.unit,
        "capacity_s": traffic.capacity_s,
        "why": traffic.why_no_capacity,
        "frames": traffic.frames,
        "cell_s": width_ns / 1e9,
        "labels": [traffic.labels[number] for number in ranked],
        "names": [traffic.names[number] for number in ranked],
        **packed,
    }


def _by_rank(traffic: Traffic, keys: "NDArray[int64]") -> "NDArray[int64]":
    """Return the keys renumbered by the rank of their labels."""
    import numpy as np

    ranked = sorted(range(len(traffic.labels)), key=lambda n: (traffic.ranks[n], n))
    places = np.zeros(max(1, len(ranked)), dtype=np.int64)
    places[ranked] = np.arange(len(ranked))
    return places[keys]


def incidents_table(incidents: Incidents, some: list[Incident], packer: Packer) -> Json:
    """Return some of the incidents by time, and the number of all by kind."""
    ordered = sorted(some, key=lambda one: one.time_ns)
    kinds = sorted(incidents.counts)
    return {
        "kinds": kinds,
        "counts": [incidents.counts[kind] for kind in kinds],
        "list": [
            [packer.ticks(i.time_ns), int(i.severity), kinds.index(i.kind), i.place, i.text]
            for i in ordered
        ],
        "severities": [severity.name.lower() for severity in Severity],
    }
