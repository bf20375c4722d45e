"""Timelines of states and owners: bars in rows, one row per motor or node."""

from dataclasses import dataclass, field
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.report.buses import nmt_text
from motorhil.harness.report.collect import Findings
from motorhil.harness.report.motors import Motor
from motorhil.harness.report.series import STEPS_MAX, Steps
from motorhil.traces.decoding.cia402 import STATES, UNKNOWN_STATE, mode_text
from motorhil.traces.schema import LockAction
from motorhil.traces.semantics.ownership import Ended, LockEvent, ownership_of


@final
@frozen
class Bar:
    """One bar: begin and end [ns from the recording's beginning], number of its word, details."""

    from_ns: int
    to_ns: int
    word: int
    text: str = ""
    waits: bool = False


@final
@dataclass(slots=True)
class Row:
    """The row of one motor or node."""

    name: str
    bars: list[Bar] = field(default_factory=list)
    left_out: int = 0


@final
@dataclass(slots=True)
class Timeline:
    """Rows of bars.

    Attributes:
        title: the title.
        about: the origin of the data.
        words: the meaning of a bar's number.
        tones: how each word is drawn: "off", "idle", "ready", "on", "stop", "fault", "boot", or ""
            for one of many.
        rows: the rows.
    """

    title: str
    about: str
    words: list[str]
    tones: list[str]
    rows: list[Row] = field(default_factory=list)


_PDS_TONES: Final = ("off", "off", "idle", "ready", "on", "stop", "fault", "fault", "off")
_NMT_TONES: Final = {0x00: "boot", 0x04: "stop", 0x05: "on", 0x7F: "idle"}


def pds_timeline(found: Findings, motors: list[Motor], end_ns: int) -> Timeline:
    """Return the PDS FSA states, from statuswords, else from the truth of an emulated drive."""
    words = [name for _, _, name in STATES] + ["no state"]
    line = Timeline(
        "PDS FSA",
        "CiA 402 states, from statuswords 6041h on the bus; otherwise from the drive's own truth",
        words,
        list(_PDS_TONES),
    )
    for motor in motors:
        steps = motor.told.pds if motor.told is not None else Steps()
        text = ""
        if not len(steps) and motor.truth_states is not None:
            text = "from its truth"
            for time_ns, code in zip(
                motor.truth_states.times_ns, motor.truth_states.values, strict=True
            ):
                known = code.is_integer() and 0 <= code < UNKNOWN_STATE
                steps.add(time_ns, int(code) if known else UNKNOWN_STATE)
        if len(steps):
            line.rows.append(_row(motor.name, steps, end_ns, text))
    return line


def nmt_timeline(found: Findings, motors: list[Motor], end_ns: int) -> Timeline:
    """Return the NMT states from the nodes' own messages, in order of buses and node-IDs."""
    codes = sorted({c for told in found.nodes.told.values() for c in told.nmt.codes})
    line = Timeline(
        "NMT",
        "CiA 301 states, from heartbeats and boot-ups",
        [nmt_text(code) for code in codes],
        [_NMT_TONES.get(code, "off") for code in codes],
    )
    named = {motor.place: motor.name for motor in motors if motor.place is not None}
    for place, told in sorted(found.nodes.told.items()):
        if len(told.nmt):
            bus, node, _ = place
            name = named.get(place) or found.names.nodes.get((bus, node)) or f"{bus} node {node}"
            steps = Steps()
            steps.left_out = told.nmt.left_out
            for time_ns, code in zip(told.nmt.times_ns, told.nmt.codes, strict=True):
                steps.add(time_ns, codes.index(code))
            line.rows.append(_row(name, steps, end_ns, f"{bus} node {node}"))
    return line


def mode_timeline(motors: list[Motor], end_ns: int) -> Timeline:
    """Return the displayed modes of operation of the drives."""
    told = [(motor.name, motor.told.mode) for motor in motors if motor.told is not None]
    told = [(name, modes) for name, modes in told if len(modes)]
    codes = sorted({code for _, modes in told for code in modes.codes})
    line = Timeline(
        "Modes of operation",
        "CiA 402, by 6061h",
        [mode_text(code) for code in codes],
        ["off" if not code else "" for code in codes],
    )
    for name, modes in told:
        steps = Steps()
        steps.left_out = modes.left_out
        for time_ns, code in zip(modes.times_ns, modes.codes, strict=True):
            steps.add(time_ns, codes.index(code))
        line.rows.append(_row(name, steps, end_ns, ""))
    return line


def _row(name: str, steps: Steps, end_ns: int, text: str) -> Row:
    told = sorted(zip(steps.times_ns, steps.codes, strict=True), key=lambda one: one[0])
    ends = [time_ns for time_ns, _ in told[1:]] + [end_ns]
    bars = [
        Bar(time_ns, to_ns, code, text) for (time_ns, code), to_ns in zip(told, ends, strict=True)
    ]
    return Row(name, bars[:STEPS_MAX], max(0, len(bars) - STEPS_MAX) + steps.left_out)


# -------------------------------------------------------------------------------------- locks


def lock_timeline(found: Findings, end_ns: int) -> Timeline:
    """Return the owners of each motor, and the waiting processes from request to grant."""
    words: list[str] = []
    line = Timeline("Locks", "owner of each motor; hatched: waiting for it", words, [])
    tenures = ownership_of(found.locks).tenures
    by_motor: dict[str, list[LockEvent]] = {}
    for event in found.locks:
        by_motor.setdefault(event.motor, []).append(event)
    order = {name: place for place, name in enumerate(found.rig.motors)}
    for motor in sorted(by_motor, key=lambda name: (order.get(name, len(order)), name)):
        row = Row(motor)
        for one in tenures.get(motor, ()):
            to_ns = end_ns if one.to_ns is None else one.to_ns
            who = owner_text(one.program, one.pid, one.owner)
            purpose = f" for {one.purpose}" if one.purpose else ""
            own = f", by {one.owner}" if one.program else ""
            ended = "" if one.ended is Ended.RELEASED else f"; it {one.ended.value}"
            if one.ended is Ended.DIED:
                ended = "; it died as the owner"
            elif one.ended is Ended.RELEASED:
                ended = "; it released it"
            text = f"{who} has {motor}{purpose}{own}{ended}"
            row.bars.append(Bar(one.from_ns, max(to_ns, one.from_ns), _word(words, who), text))
        row.bars += _waits(motor, by_motor[motor], words, end_ns)
        row.bars.sort(key=lambda bar: (bar.from_ns, bar.waits))
        row.left_out = max(0, len(row.bars) - STEPS_MAX)
        del row.bars[STEPS_MAX:]
        line.rows.append(row)
    line.tones = [""] * len(words)
    return line


def _waits(motor: str, events: list[LockEvent], words: list[str], end_ns: int) -> list[Bar]:
    """Return the bars from request to grant, refusal, or the end of the recording."""
    bars: list[Bar] = []
    asked: dict[tuple[int, str], LockEvent] = {}
    over = (LockAction.TAKEN, LockAction.BROKEN, LockAction.TAKEN_OVER, LockAction.REFUSED)

    def add(event: LockEvent, from_ns: int, to_ns: int, how: str) -> None:
        who = owner_text(event.program, event.pid, event.owner)
        text = f"{who} waits for {motor}{how}"
        bars.append(Bar(from_ns, to_ns, _word(words, who), text, waits=True))

    for event in events:
        key = (event.pid, event.owner)
        if event.action is LockAction.WAITING:
            asked.setdefault(key, event)
        elif event.action in over:
            first = asked.pop(key, None)
            how = ", and is refused" if event.action is LockAction.REFUSED else ", and gets it"
            if first is not None:
                add(first, first.time_ns, event.time_ns, how)
            elif event.waited_s > 0.001:
                began_ns = max(0, event.time_ns - round(event.waited_s * 1e9))
                add(event, began_ns, event.time_ns, how)
    for first in asked.values():
        add(first, first.time_ns, end_ns, ", to the end of the recording")
    return bars


def owner_text(program: str, pid: int, owner: str) -> str:
    """Return the owner's name: its program if known, else its call."""
    if program:
        return f"{program} [{pid}]" if pid else program
    return owner.partition(" of ")[0] or "unknown owner"


def _word(words: list[str], word: str) -> int:
    if word not in words:
        words.append(word)
    return words.index(word)
