"""Whole picture of a growing record, and its news since the last event.

Both are documents in the report's form, so that the page draws them with the report's code. News
hold at most a fixed number of points and one cell per message and stretch of time, whatever the
rate of the bus. They are appended to the latest whole picture. A new one is due after a change in
its structure, such as a first message of a motor, and after so much news that the page would grow
without bound.
"""

import base64
import zlib
from dataclasses import replace
from typing import Final, final

from motorhil.harness.report.buses import Nodes, Told, Traffic
from motorhil.harness.report.collect import Findings
from motorhil.harness.report.document import (
    Json,
    groups_table,
    incidents_table,
    line_table,
    motor_table,
    time_table,
    timeline_table,
    timelines_of,
    traffic_table,
)
from motorhil.harness.report.motors import Motor, Scale, motors_of, scales_of
from motorhil.harness.report.series import STRETCH_NS, Packer, Track, cell_width_ns, share
from motorhil.harness.report.timelines import owner_text
from motorhil.traces.semantics.ownership import LockEvent, ownership_of

POINTS_MAX: Final = 150_000
"""Points of quantities in the whole picture, and at most as many in news after it."""
CELLS_MAX: Final = 150_000
"""Cells of traffic in the whole picture, and at most as many in news after it."""
NEWS_POINTS: Final = 4_000
"""Points of quantities in one event with news."""
STRETCH_POINTS: Final = 150_000
"""Points of quantities in the detail of a stretch."""
CELL_NS: Final = STRETCH_NS << 9
"""The shortest stretch over which messages are summed: 64 ms."""


@final
class Increments:
    """The picture of one record: what its pages have, and what is new.

    Attributes:
        motors: the motors, as in the latest whole picture or news.
        owners: owner of each locked motor.
    """

    def __init__(self) -> None:
        self.motors: list[Motor] = []
        self.owners: dict[str, str] = {}
        self._until_ns = -1  # time of the latest news, from the record's beginning
        self._structure: object = None
        self._scales: dict[str, Scale] = {}
        self._widths: dict[str, int] = {}
        self._frames: dict[str, int] = {}
        self._incidents = 0
        self._groups = 0
        self._locks = 0
        self._points = 0
        self._cells = 0
        self._news = 0

    def rescale(self, found: Findings) -> None:
        """Measure the scales of the motors again, which are read from the whole record."""
        self._scales = scales_of(found)

    def whole(self, found: Findings) -> tuple[Json, Packer]:
        """Return all contents so far, reduced; `more` continues from here."""
        self.rescale(found)
        self._widths = _widths(found)
        self._points = self._cells = 0
        told = self._whole(found)
        self._note(found)
        self._structure = self._structure_of(found, self.motors, None)
        return told

    def again(self, found: Findings) -> tuple[Json, Packer]:
        """Return all contents for another page, at the time of the latest event."""
        return self._whole(found)

    def more(self, found: Findings) -> tuple[Json, Packer] | None:
        """Return the news since the last call; None: a whole picture is due."""
        part = self._part(found)
        motors = motors_of(part, self._scales)
        structure = self._structure_of(found, motors, self._structure)
        if structure != self._structure or max(self._points, self._cells) > POINTS_MAX:
            return None
        self.motors = motors
        span_ns = max(1, found.end_ns - found.begin_ns)
        packer = Packer(span_ns)
        told: Json = {"time": time_table(found, packer), "lines": self._lines(motors, packer)}
        told["timelines"] = self._timelines(part, found, motors, packer)
        told["groups"] = groups_table((), part.groups, packer)
        told["traffic"] = self._traffic(found, packer)
        fresh = found.incidents.since(self._incidents)
        if fresh or found.incidents.counts.total() != self._incidents:
            told["incidents"] = incidents_table(found.incidents, fresh, packer)
        self._note(found)
        return told, packer

    def stretch(self, found: Findings, from_ns: int, to_ns: int) -> tuple[Json, Packer]:
        """Return the points of all lines between two times [ns from the record's beginning]."""
        packer = Packer(max(1, found.end_ns - found.begin_ns))
        lines = [
            ((m, p, n), line, *line.times_ns.searchsorted((from_ns, to_ns + 1)).tolist())
            for m, motor in enumerate(motors_of(found, self._scales))
            for p, plot in enumerate(motor.plots)
            for n, line in enumerate(plot.lines)
        ]
        limit = STRETCH_POINTS // max(1, len(lines))
        told: list[Json] = []
        for place, line, begin, end in lines:
            part = slice(max(0, begin - 1), end + 1)  # with the points on both sides
            fine = replace(line, times_ns=line.times_ns[part], values=line.values[part])
            if len(fine.times_ns):
                table = line_table(fine, packer, max(4, limit))
                told.append({"at": place, "t": table["t"], "v": table["v"]})
        return {"time": time_table(found, packer), "lines": told}, packer

    def fresh(self, traffic: Traffic) -> Traffic:
        """Return the messages of a bus since the last event."""
        return traffic.latest(traffic.frames - self._frames.get(traffic.name, 0))

    # ----------------------------------------------------------------------------- the whole

    def _whole(self, found: Findings) -> tuple[Json, Packer]:
        span_ns = max(1, found.end_ns - found.begin_ns)
        packer = Packer(span_ns)
        motors = self.motors = motors_of(found, self._scales)
        points = sum(len(line.times_ns) for m in motors for p in m.plots for line in p.lines)
        timelines = timelines_of(found, motors, span_ns)
        self.owners = _owners(found.locks)
        told: Json = {
            "time": time_table(found, packer),
            "motors": [motor_table(one, packer, points, POINTS_MAX) for one in motors],
            "timelines": [timeline_table(one, packer) for one in timelines],
            "groups": groups_table(found.rig.groups, found.groups, packer),
            "traffic": [
                traffic_table(one, packer, self._widths.get(one.name, CELL_NS))
                for one in found.traffics()
            ],
            "responses": [],
            "incidents": incidents_table(found.incidents, found.incidents.kept(), packer),
        }
        return told, packer

    def _note(self, found: Findings) -> None:
        """Note what is in the pages now."""
        self._until_ns = found.end_ns - found.begin_ns
        self._frames = {one.name: one.frames for one in found.traffics()}
        self._incidents = found.incidents.counts.total()
        self._groups = len(found.groups)
        self._locks = len(found.locks)

    def _structure_of(self, found: Findings, motors: list[Motor], known: object) -> object:
        """Return everything that `more` cannot append to."""
        plots = tuple(
            (m.name, p.quantity, p.unit, tuple((line.name, line.role) for line in p.lines))
            for m in motors
            for p in m.plots
        )
        states = tuple(
            (place, len(told.pds) > 0, len(told.nmt) > 0, len(told.mode) > 0)
            for place, told in found.nodes.told.items()
        )
        traffic = tuple((one.name, len(one.labels)) for one in found.traffics())
        locked = len({event.motor for event in found.locks[self._locks :]} - set(self.owners))
        groups = frozenset(one.group for one in found.groups[self._groups :])
        kinds = len(found.incidents.counts)
        if known is None:
            return plots, states, traffic, frozenset(one.group for one in found.groups), kinds, 0
        assert isinstance(known, tuple)
        return plots, states, traffic, groups | known[3], kinds, locked

    # ------------------------------------------------------------------------------ the news

    def _part(self, found: Findings) -> Findings:
        """Return the contents from the latest event on, with the last point before it."""
        since_ns = self._until_ns
        nodes = Nodes()
        for place, told in found.nodes.told.items():
            nodes.told[place] = Told(
                told.pds.since(since_ns),
                told.mode.since(since_ns),
                told.nmt.since(since_ns),
                {index: track.since(since_ns) for index, track in told.tracks.items()},
            )
        return replace(
            found,
            nodes=nodes,
            states={name: _since(tracks, since_ns) for name, tracks in found.states.items()},
            truths={name: _since(tracks, since_ns) for name, tracks in found.truths.items()},
            groups=found.groups[self._groups :],
        )

    def _lines(self, motors: list[Motor], packer: Packer) -> list[Json]:
        """Return the new points of each line, by the numbers of its motor, plot and place."""
        fresh = [
            ((m, p, n), line)
            for m, motor in enumerate(motors)
            for p, plot in enumerate(motor.plots)
            for n, line in enumerate(plot.lines)
            if len(line.times_ns) and int(line.times_ns[-1]) >= self._until_ns
        ]
        told: list[Json] = []
        limit = NEWS_POINTS // max(1, len(fresh))
        for place, line in fresh:
            table = line_table(line, packer, max(4, min(limit, len(line.times_ns))))
            self._points += limit if len(line.times_ns) > limit else len(line.times_ns)
            told.append({"at": place, "t": table["t"], "v": table["v"], "points": table["points"]})
        return told

    def _timelines(
        self, part: Findings, found: Findings, motors: list[Motor], packer: Packer
    ) -> list[Json]:
        """Return the bars that end after the latest event."""
        span_ns = max(1, found.end_ns - found.begin_ns)
        has_locks = len(found.locks) != self._locks
        lines = timelines_of(part if has_locks else replace(part, locks=[]), motors, span_ns)
        if has_locks:
            self.owners = _owners(found.locks)
        told: list[Json] = []
        for line in lines:
            for row in line.rows:
                row.bars = [bar for bar in row.bars if bar.to_ns >= self._until_ns]
            table = timeline_table(line, packer)
            told.append(table)
        return told

    def _traffic(self, found: Findings, packer: Packer) -> list[Json]:
        told: list[Json] = []
        for number, traffic in enumerate(found.traffics()):
            fresh = self.fresh(traffic)
            if len(fresh.times_ns):
                width_ns = self._widths.get(traffic.name, CELL_NS)
                table = traffic_table(fresh, packer, width_ns)
                self._cells += len(set(fresh.keys))
                kept = {key: table[key] for key in ("t", "key", "weight", "count", "frames")}
                told.append({"at": number, **kept})
        return told


def packed(document: Json, packer: Packer) -> str:
    """Return a document and its arrays as one text for an event."""
    import json

    told = json.dumps(document, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()
    size = len(told).to_bytes(4, "little")
    return base64.b64encode(zlib.compress(size + told + packer.data(), 1)).decode("ascii")


def _since(tracks: dict[str, Track], time_ns: int) -> dict[str, Track]:
    return {name: track.since(time_ns) for name, track in tracks.items()}


def _widths(found: Findings) -> dict[str, int]:
    """Return the duration of a cell for each bus, such that all cells stay within the limit."""
    traffics = found.traffics()
    total = sum(len(one.times_ns) for one in traffics)
    widths: dict[str, int] = {}
    for one in traffics:
        widths[one.name] = max(one.width_ns, CELL_NS)
        if len(one.times_ns):
            times, keys, _, _ = one.arrays()
            budget = share(len(times), total, CELLS_MAX)
            widths[one.name] = cell_width_ns(times, keys, budget, widths[one.name])
    return widths


def _owners(events: list[LockEvent]) -> dict[str, str]:
    """Return the present owner of each motor with lock events, "" without one."""
    owners: dict[str, str] = {}
    for motor, tenures in ownership_of(events).tenures.items():
        held = [one for one in tenures if one.to_ns is None]
        owners[motor] = owner_text(held[-1].program, held[-1].pid, held[-1].owner) if held else ""
    return {event.motor: "" for event in events} | owners
