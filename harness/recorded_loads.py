"""Traffic of a recording's CAN buses, prepared for the response-time analysis."""

from collections.abc import Mapping
from pathlib import Path

from harness.analysis.subject import Queues, Subject
from harness.recorded_bus import RecordedBus
from harness.report.rig_facts import RigFacts, facts_of
from traces.errors import TraceError
from traces.formats import Source, open_source
from traces.reader import read_trace
from traces.recorded_names import RecordedNames, names_of
from traces.traffic import Findings


def subjects_of_recording(
    path: Path,
    bitrates: Mapping[str, int],
    data_bitrates: Mapping[str, int],
    fifo: bool | None = None,
) -> list[Subject]:
    """Return every CAN bus of the recording, ordered by name.

    Args:
        path: a recording of any readable format.
        bitrates: bit rates of buses [bit/s]; they take precedence over the recording's.
        data_bitrates: the same for the data bit rate of CAN FD [bit/s].
        fifo: True if every known sender has a first-in-first-out queue; None: as in its rig.

    Raises:
        TraceError: the recording cannot be read, or a bit rate is unknown.
    """
    source = open_source(path)
    names, facts = _told(source)
    told = facts.bitrates
    found = Findings()
    buses: dict[str, RecordedBus] = {}
    for time_ns, bus, frame, _, sender in source.frames(found):
        known = buses.get(bus)
        if known is None:
            known = buses[bus] = RecordedBus(bus)
        known.take(time_ns, frame, sender)
    subjects: list[Subject] = []
    if found.unstamped:
        raise TraceError(
            str(path),
            f"has {found.unstamped} frames without a time stamp: periods cannot be determined",
            remedy="record with time stamps (candump -L, candump -t a)",
        )
    for name in (*bitrates, *data_bitrates):
        if name not in buses:
            remedy = f"its buses: {', '.join(sorted(buses)) or 'none'}"
            raise TraceError(str(path), f"has no CAN bus {name}", remedy=remedy)
    for name in sorted(buses):
        rate = bitrates.get(name, told.get(name))
        if rate is None:
            raise TraceError(
                str(path),
                f"does not contain the bit rate of {name}",
                remedy=f"say --bitrate {name}=500k",
            )
        notes = [f"{count} {what}" for count, what in _doubts(found) if count]
        nodes = {number: node for (bus, number), node in names.nodes.items() if bus == name}
        one = buses[name]
        data_rate = data_bitrates.get(name, facts.data_bitrates.get(name))
        queues = Queues(fifo, facts.by_priority.get(name, frozenset()))
        subjects.append(one.subject(rate, data_rate, nodes, queues, notes))
    return subjects


def _told(source: Source) -> tuple[RecordedNames, RigFacts]:
    """Return the names of nodes and the bit rates that the recording contains."""
    if source.format != "mcap":
        return RecordedNames(), RigFacts()
    with read_trace(source.path) as trace:
        return names_of(trace.attachments), facts_of(trace.attachments)


def _doubts(found: Findings) -> tuple[tuple[int, str], ...]:
    return (
        (len(found.problems), "rows of the file cannot be read, and are not counted"),
        (
            found.backward,
            "frames have an earlier time stamp than the one before: sorted by time stamp",
        ),
    )
