"""What was sent on the CAN buses of a recording, as the analysis of response times takes it."""

import struct
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final, final

from emulators.media.can_bits import measure, phases_of
from emulators.media.can_port import LENGTHS_MASK
from harness.analysis.clocks import Clock, clock_of
from harness.analysis.message import Arrival, BusLoad, Message, rank_of
from harness.analysis.recorded import Heard, Measured, measured
from harness.analysis.subject import Subject, is_canopen_reserved, reserves_nothing
from harness.canopen_names import is_sdo, usual_name
from harness.report.rig_facts import RigFacts, facts_of
from traces.errors import TraceError
from traces.formats import Source, open_source
from traces.reader import read_trace
from traces.recorded_names import RecordedNames, names_of
from traces.traffic import BRS, EFF, EFF_MASK, ERR, RTR, Findings

_HEAD: Final = struct.Struct("<IBB")
_FD_BYTES: Final = 72
_NMT: Final = 0x000
_SYNC: Final = 0x080
_CYCLE_TOLD: Final = (b"\x23\x06\x10\x00", b"\x43\x06\x10\x00")
"""SDO that writes, or answers, communication cycle period 1006h [us] (CiA 301)."""
_LSS: Final = (0x7E4, 0x7E5)
_HEARTBEATS: Final = range(0x701, 0x780)


def subjects_of_recording(
    path: Path,
    bitrates: Mapping[str, int],
    data_bitrates: Mapping[str, int],
    *,
    fifo: bool,
) -> list[Subject]:
    """Every CAN bus of the recording, by name.

    Args:
        path: a recording of any format that is read here.
        bitrates: of buses [bit/s]; they go before what the recording tells.
        data_bitrates: the same of CAN FD.
        fifo: whether every sender that is known has one queue, first in, first out.

    Raises:
        TraceError: it cannot be read, or a bit rate is not known.
    """
    source = open_source(path)
    names, facts = _told(source)
    told = facts.bitrates
    found = Findings()
    buses: dict[str, _RecordedBus] = {}
    for time_ns, bus, frame, _, sender in source.frames(found):
        known = buses.get(bus)
        if known is None:
            known = buses[bus] = _RecordedBus(bus)
        known.take(time_ns, frame, sender)
    subjects: list[Subject] = []
    if found.unstamped:
        raise TraceError(
            str(path),
            f"has {found.unstamped} frames without a time: nothing can be said of periods",
            remedy="record with time stamps (candump -L, candump -t a)",
        )
    for name in sorted(buses):
        rate = bitrates.get(name, told.get(name))
        if rate is None:
            raise TraceError(
                str(path),
                f"does not tell the bit rate of {name}",
                remedy=f"say --bitrate {name}=500k",
            )
        notes = [f"{count} {what}" for count, what in _doubts(found) if count]
        nodes = {number: node for (bus, number), node in names.nodes.items() if bus == name}
        one = buses[name]
        data_rate = data_bitrates.get(name, facts.data_bitrates.get(name))
        subjects.append(one.subject(rate, data_rate, nodes, notes, fifo=fifo))
    return subjects


def _told(source: Source) -> tuple[RecordedNames, RigFacts]:
    """Names of nodes and bit rates that the recording itself tells."""
    if source.format != "mcap":
        return RecordedNames(), RigFacts()
    with read_trace(source.path) as trace:
        return names_of(trace.attachments), facts_of(trace.attachments)


def _doubts(found: Findings) -> tuple[tuple[int, str], ...]:
    return (
        (len(found.problems), "rows of the file cannot be read, and are left out"),
        (found.backward, "frames are stamped earlier than the one before: ordered by stamp"),
    )


@final
class _RecordedBus:
    """The frames of one bus."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._heard: dict[int, Heard] = {}
        self._bits = 0
        self._data_bits = 0
        self._errors = 0
        self._odd = 0
        self._remote: dict[int, int] = {}
        self._cycles_ns: list[int] = []
        self._first_ns: int | None = None
        self._last_ns = 0

    def take(self, time_ns: int, frame: bytes, sender: str) -> None:
        """One more frame."""
        can_id, length, flags = _HEAD.unpack_from(frame)
        if can_id & ERR:
            self._errors += 1
            return
        try:
            nominal, data = phases_of(measure(frame) & LENGTHS_MASK)
        except ValueError:  # recorded by somebody, and sent by nobody
            self._odd += 1
            return
        self._bits += nominal
        self._data_bits += data
        if self._first_ns is None:
            self._first_ns = self._last_ns = time_ns
        self._first_ns = min(self._first_ns, time_ns)
        self._last_ns = max(self._last_ns, time_ns)
        fd = len(frame) == _FD_BYTES
        key = can_id & (EFF | EFF_MASK)
        heard = self._heard.get(key)
        if heard is None:
            heard = self._heard[key] = Heard(can_id & EFF_MASK, bool(can_id & EFF))
        heard.fd = heard.fd or fd
        heard.switched = heard.switched or (fd and bool(flags & BRS))
        heard.add(time_ns, 0 if can_id & RTR else length, sender)
        if frame[8:12] in _CYCLE_TOLD and is_sdo(can_id):
            self._cycles_ns.append(int.from_bytes(frame[12:16], "little") * 1000)
        if can_id & RTR:
            self._remote[key] = self._remote.get(key, 0) + 1

    def subject(
        self,
        rate: int,
        data_rate: int | None,
        nodes: Mapping[int, str],
        notes: list[str],
        *,
        fifo: bool,
    ) -> Subject:
        """The bus with all that was periodic, and what was not."""
        assert self._first_ns is not None or not self._heard
        span_ns = max(1, self._last_ns - (self._first_ns or 0))
        is_canopen = any(one.identifier in _HEARTBEATS for one in self._heard.values())
        known: list[tuple[Message, Measured]] = []
        left_out: list[str] = []
        for key in sorted(self._heard):
            heard = self._heard[key]
            name = "" if heard.extended else usual_name(heard.identifier, nodes)
            found = measured(heard, span_ns, name if is_canopen else "")
            if is_canopen and _is_not_counted(found.message):
                left_out.append(f"{found.message.label} ({found.frames})")
                continue
            known.append((_at_home(found.message, is_canopen), found))
        if left_out:
            notes.append(f"not counted, SDO and NMT are sporadic (frames): {', '.join(left_out)}")
        notes += self._notes(known)
        senders = frozenset(one.sender for one, _ in known if one.sender)
        busy_s = self._bits / rate + self._data_bits / (data_rate or rate)
        load = BusLoad(
            self._name,
            rate,
            tuple(sorted((one for one, _ in known), key=lambda one: one.rank)),
            data_rate,
            senders if fifo else frozenset(),
        )
        return Subject(
            load,
            is_canopen_reserved if is_canopen else reserves_nothing,
            tuple((one.rank, found.frames) for one, found in known),
            busy_s * 1e9 / span_ns if span_ns > 1 else None,
            tuple(notes),
            self._sync(known) if is_canopen else None,
        )

    def _sync(self, known: list[tuple[Message, Measured]]) -> Clock | None:
        """What is known of SYNC; nobody else's message has its place on a CANopen bus."""
        for message, _ in known:
            is_sync = message.rank == rank_of(_SYNC, extended=False)
            if is_sync and message.arrival is Arrival.PERIODIC:
                return clock_of(sorted(self._heard[_SYNC].times_ns), self._cycles_ns)
        return None

    def _notes(self, known: list[tuple[Message, Measured]]) -> list[str]:
        notes = []
        once = [found.message.label for _, found in known if found.frames == 1]
        if once:
            notes.append(f"seen once, nothing is known of how often they come: {', '.join(once)}")
        irregular = [
            f"{found.message.label} ({found.irregular} of {found.frames - 1})"
            for _, found in known
            if found.irregular
        ]
        if irregular:
            notes.append(f"periodic, but for some of their distances: {', '.join(irregular)}")
        several = [heard for heard in self._heard.values() if len(heard.senders) > 1]
        if several:
            labels = ", ".join(f"{one.identifier:03X}h" for one in several)
            notes.append(f"of more than one sender, taken as one of a node of its own: {labels}")
        if self._remote:
            notes.append(f"{sum(self._remote.values())} remote frames, taken as without data")
        if self._odd:
            notes.append(f"{self._odd} frames are none that a bus could carry, and are left out")
        if self._errors:
            notes.append(f"{self._errors} error messages were recorded; --errors counts errors")
        return notes


def _is_not_counted(message: Message) -> bool:
    """What the analysis of a rig leaves out too: it comes when somebody asks."""
    if message.extended or message.arrival is Arrival.PERIODIC:
        return False
    identifier = message.identifier
    return identifier == _NMT or identifier in _LSS or is_sdo(identifier)


def _at_home(message: Message, is_canopen: bool) -> Message:
    """As a CANopen bus has it: what SDO is asked has no deadline, and not all can be moved."""
    if not is_canopen:
        return message
    movable = not is_canopen_reserved(message.identifier, message.extended)
    asked = not message.extended and is_sdo(message.identifier)  # periodically, but nobody waits
    deadline_ns = None if asked else message.deadline_ns
    return replace(message, movable=movable, deadline_ns=deadline_ns)
