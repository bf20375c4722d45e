"""Recorded CAN buses, prepared for the response-time analysis."""

import struct
from collections.abc import Iterable, Mapping
from dataclasses import replace
from math import gcd
from pathlib import Path
from typing import Final, final

from motorhil.emulators.can.frame import FD_FRAME_BYTES, FD_LENGTHS
from motorhil.emulators.can.frame_length import CLASSICAL_MAX, LENGTHS_MASK, measure, phases_of
from motorhil.harness.analysis.measured import Heard, Measured, clock_of, measured
from motorhil.harness.analysis.subject import (
    Queues,
    Subject,
    Sync,
    is_canopen_reserved,
    reserves_nothing,
)
from motorhil.motorapi.synchronization.can_frame_length import Bits
from motorhil.motorapi.synchronization.can_response_time import Arrival, BusLoad, Message
from motorhil.traces.can_frame import BRS, EFF, EFF_MASK, ERR, RTR
from motorhil.traces.decoding.attached_rig import RecordedNames, RigFacts, facts_of, names_of
from motorhil.traces.decoding.canopen import is_sdo, usual_name
from motorhil.traces.errors import TraceError
from motorhil.traces.files import MEMORY_MAX
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.registry import Source, open_source
from motorhil.traces.mcap.reader import read_trace

_HEAD: Final = struct.Struct("<IBB")
_NMT: Final = 0x000
_SYNC: Final = 0x080
_BASE_MASK: Final = 0x7FF
_COB_ID_EXTENDED: Final = 1 << 29
_WHOLE_TOLD: Final = (0x23, 0x43)
"""SDO commands that write or answer four bytes at once (CiA 301)."""
_SYNC_COB_ID: Final = b"\x05\x10\x00"
_CYCLE_PERIOD: Final = b"\x06\x10\x00"  # [us]
_LSS: Final = (0x7E4, 0x7E5)
_COARSE_NS: Final = 1_000_000  # time stamps this coarse hide the jitter of most buses
_HEARTBEATS: Final = range(0x701, 0x780)
_PENDING: Final = 1 << 14  # time stamps examined at once
_STREAMS_KEPT: Final = 1 << 14  # then the cache is cleared; bounds memory to some MB


@final
class _Stream:
    """Frames of one sender that begin alike: identifier, flags and length.

    Attributes:
        heard: all frames of the identifier.
        append: adds the time of a frame to them.
        length: the number of data bytes on the bus, if the frame has another one; otherwise None.
        nominal, data: the least bits at either rate so far.
        is_rare: True if its frames are counted or read one by one.
    """

    __slots__ = ("append", "data", "heard", "is_rare", "length", "nominal")

    def __init__(self, heard: Heard, length: int | None, is_rare: bool) -> None:
        self.heard = heard
        self.append = heard.times_ns.append
        self.length = length
        self.nominal = self.data = 1 << 30
        self.is_rare = is_rare


@final
class RecordedBus:
    """The frames of one bus.

    Attributes:
        left_out: number of frames after the first `frames_max`, which were measured but not kept.
    """

    def __init__(self, name: str, frames_max: int | None = None) -> None:
        """Start without frames; `frames_max` bounds the memory, None does not."""
        self.left_out: int = 0
        self._name = name
        self._room = -1 if frames_max is None else frames_max
        self._heard: dict[int, Heard] = {}
        self._streams: dict[tuple[bytes, int, str], _Stream] = {}
        self._bits = 0
        self._data_bits = 0
        self._errors = 0
        self._odd = 0
        self._too_late = 0
        self._switched = 0
        self._remote = 0
        self._cycles_ns: list[int] = []
        self._syncs = [_SYNC]
        self._first_ns: int | None = None
        self._last_ns = 0
        self._step_ns = 0
        self._at_once = 0
        self._pending_ns: list[int] = []

    def take(self, time_ns: int, frame: bytes, sender: str) -> tuple[int, int] | None:
        """Add a frame; return its bits at nominal and data rate, or None if it is impossible."""
        stream = self._streams.get((frame[:8], len(frame), sender))
        if stream is None:
            stream = self._opened(frame, sender)
            if stream is None:
                return None
        if stream.length is not None:
            frame = frame[:4] + bytes([stream.length]) + frame[5:]
        lengths = measure(frame) & LENGTHS_MASK
        nominal, data = (lengths, 0) if lengths <= CLASSICAL_MAX else phases_of(lengths)
        if not self._room:
            self.left_out += 1
            return nominal, data
        try:
            stream.append(time_ns)
        except OverflowError:  # of an array of 64-bit numbers with a sign
            self._too_late += 1
            return nominal, data
        self._room -= 1
        self._bits += nominal
        self._data_bits += data
        pending_ns = self._pending_ns
        pending_ns.append(time_ns)
        if len(pending_ns) >= _PENDING:
            self._settle()
        if nominal < stream.nominal or data < stream.data:
            self._shorten(stream, nominal, data)
        if stream.is_rare:
            self._count(frame)
        return nominal, data

    def _opened(self, frame: bytes, sender: str) -> _Stream | None:
        """Return the stream that begins with this frame; None: it is not one of a bus."""
        can_id, length, flags = _HEAD.unpack_from(frame)
        if can_id & ERR:
            self._errors += 1
            return None
        fd = len(frame) == FD_FRAME_BYTES
        padded = None
        if fd and length not in FD_LENGTHS:  # as some tools write it; on the wire it was padded
            padded = next((one for one in FD_LENGTHS if one > length), FD_LENGTHS[-1])
        try:
            measure(frame if padded is None else frame[:4] + bytes([padded]) + frame[5:])
        except ValueError:  # recorded, but impossible on a bus
            self._odd += 1
            return None
        switched = fd and bool(flags & BRS)
        key = can_id & (EFF | EFF_MASK)
        heard = self._heard.get(key)
        if heard is None:
            heard = Heard(can_id & EFF_MASK, bool(can_id & EFF), switched=switched)
            if self._room:
                self._heard[key] = heard
        if self._room:
            heard.add_kind(0 if can_id & RTR else padded or length, sender, fd, switched)
        if len(self._streams) >= _STREAMS_KEPT:
            self._streams.clear()
        is_rare = switched or bool(can_id & RTR) or is_sdo(can_id)
        stream = _Stream(heard, padded, is_rare)
        self._streams[frame[:8], len(frame), sender] = stream
        return stream

    def _shorten(self, stream: _Stream, nominal: int, data: int) -> None:
        least = stream.heard.shortest or Bits(nominal, data)
        least = Bits(min(nominal, least.nominal), min(data, least.data))
        stream.heard.shortest = least
        stream.nominal, stream.data = least.nominal, least.data

    def _count(self, frame: bytes) -> None:
        """Count or read a frame with a bit rate switch, a remote frame, or an SDO."""
        can_id, _, flags = _HEAD.unpack_from(frame)
        if len(frame) == FD_FRAME_BYTES and flags & BRS:
            self._switched += 1
        elif can_id & RTR:
            self._remote += 1
        else:
            self._learn(frame)

    def _settle(self) -> None:
        """Update span and resolution of the time stamps by those that came since the last call."""
        import numpy as np

        if not self._pending_ns:
            return
        times = np.array(self._pending_ns, dtype=np.int64)
        first = self._first_ns is None
        before = int(times[0]) if first else self._last_ns
        latest = np.maximum.accumulate(np.maximum(times, before))
        steps = times - np.concatenate(([before], latest[:-1]))
        self._at_once += int(np.count_nonzero(steps == 0)) - first
        self._step_ns = gcd(self._step_ns, int(np.gcd.reduce(np.abs(steps))))
        lowest = int(times.min())
        self._first_ns = lowest if self._first_ns is None else min(self._first_ns, lowest)
        self._last_ns = int(latest[-1])
        self._pending_ns.clear()

    def _learn(self, frame: bytes) -> None:
        """Learn the COB-ID or the cycle period of SYNC from an SDO."""
        if frame[8] not in _WHOLE_TOLD:
            return
        value = int.from_bytes(frame[12:16], "little")
        if frame[9:12] == _CYCLE_PERIOD:
            self._cycles_ns.append(value * 1000)
        elif frame[9:12] == _SYNC_COB_ID:
            extended = bool(value & _COB_ID_EXTENDED)
            identifier = value & (EFF_MASK if extended else _BASE_MASK)
            self._syncs.append(identifier | (EFF if extended else 0))

    def subject(
        self,
        rate: int,
        data_rate: int | None,
        nodes: Mapping[int, str],
        queues: Queues,
        doubts: Iterable[str] = (),
    ) -> Subject:
        """Return the bus with all its periodic and sporadic messages.

        Args:
            rate: nominal bit rate [bit/s].
            data_rate: data bit rate of CAN FD [bit/s]; None if unknown.
            nodes: node names by node-ID.
            queues: queues of known senders.
            doubts: notes about the file.
        """
        self._settle()
        span_ns = max(1, self._last_ns - (self._first_ns or 0))
        is_canopen = any(
            key in _HEARTBEATS and heard.length == 1 for key, heard in self._heard.items()
        )
        known: list[tuple[Message, Measured]] = []
        left_out: list[str] = []
        notes = list(doubts)
        for key in sorted(self._heard):
            heard = self._heard[key]
            if not heard.times_ns:
                continue
            found = measured(heard, span_ns, self._name_of(key, nodes) if is_canopen else "")
            if is_canopen and _is_not_counted(found.message):
                left_out.append(f"{found.message.label} ({found.frames})")
                continue
            is_sync = is_canopen and key in self._syncs
            known.append((_at_home(found.message, is_canopen, is_sync), found))
        if left_out:
            notes.append(
                f"not counted because sporadic, SDO and NMT (frames): {', '.join(left_out)}"
            )
        notes += self._notes(known)
        if self._switched and data_rate is None:
            notes.append(
                f"the data bit rate of {self._switched} CAN FD frames is not known"
                f" (--data-bitrate {self._name}=2M): counted as if all were at the nominal one"
            )
        senders = frozenset(one.sender for one, _ in known if one.sender)
        busy_s = self._bits / rate + self._data_bits / (data_rate or rate)
        load = BusLoad(
            self._name,
            rate,
            tuple(sorted((one for one, _ in known), key=lambda one: one.rank)),
            data_rate,
            queues.one_each(senders),
        )
        return Subject(
            load,
            is_canopen_reserved if is_canopen else reserves_nothing,
            tuple(found for _, found in known),
            busy_s * 1e9 / span_ns if span_ns > 1 else None,
            tuple(notes),
            self._sync(known) if is_canopen else None,
        )

    def _name_of(self, key: int, nodes: Mapping[int, str]) -> str:
        if key in self._syncs:
            return "SYNC"
        return "" if key & EFF else usual_name(key, nodes)

    def _sync(self, known: list[tuple[Message, Measured]]) -> Sync | None:
        """Return the findings about the most frequent SYNC, or None if there is none."""
        periodic = {
            message.identifier | (EFF if message.extended else 0): message
            for message, _ in known
            if message.arrival is Arrival.PERIODIC
        }
        syncs = [key for key in dict.fromkeys(self._syncs) if key in periodic]
        if not syncs:
            return None
        key = max(syncs, key=lambda one: len(self._heard[one].times_ns))
        clock = clock_of(sorted(self._heard[key].times_ns), self._cycles_ns)
        return Sync(periodic[key].label, clock)

    def _notes(self, known: list[tuple[Message, Measured]]) -> list[str]:
        notes = []
        if self._at_once and self._step_ns >= _COARSE_NS:
            step_ms = self._step_ns / 1e6
            notes.append(f"time stamps have a resolution of {step_ms:g} ms")
        once = [found.message.label for _, found in known if found.frames == 1]
        if once:
            notes.append(f"seen once, so that their period is unknown: {', '.join(once)}")
        irregular = [
            f"{found.message.label} ({found.irregular} of {found.frames - 1})"
            for _, found in known
            if found.irregular
        ]
        if irregular:
            notes.append(f"periodic with some irregular intervals: {', '.join(irregular)}")
        several = [heard for heard in self._heard.values() if len(heard.senders) > 1]
        if several:
            labels = ", ".join(f"{one.identifier:03X}h" for one in several)
            notes.append(f"sent by more than one node, counted as one separate node: {labels}")
        if self._remote:
            notes.append(f"{self._remote} remote frames, counted as frames without data")
        if self._too_late:
            notes.append(
                f"{self._too_late} frames have time stamps beyond the year 2262, and are not"
                " counted; check the clock of the recorder"
            )
        if self.left_out:
            notes.append(
                f"measured in the first {sum(len(h.times_ns) for h in self._heard.values())} frames"
                f" of the bus; {self.left_out} later ones are left out"
            )
        if self._odd:
            notes.append(f"{self._odd} frames are impossible on a bus, and not counted")
        if self._errors:
            notes.append(
                f"{self._errors} error messages were recorded; motorhil analyse --errors N shows"
                " how late errors can make a message"
            )
        return notes


def _is_not_counted(message: Message) -> bool:
    """Return True for on-demand messages, which the analysis of a rig omits as well."""
    if message.extended or message.arrival is Arrival.PERIODIC:
        return False
    identifier = message.identifier
    return identifier == _NMT or identifier in _LSS or is_sdo(identifier)


def _at_home(message: Message, is_canopen: bool, is_sync: bool) -> Message:
    """Return the message with CANopen rules: no deadline for SDO, reserved identifiers fixed."""
    if not is_canopen:
        return message
    reserved = is_canopen_reserved(message.identifier, message.extended)
    movable = not (reserved or is_sync)
    asked = not message.extended and is_sdo(message.identifier)  # periodic, but without a deadline
    deadline_ns = None if asked else message.deadline_ns
    return replace(message, movable=movable, deadline_ns=deadline_ns)


def subjects_of_recording(
    path: Path,
    bitrates: Mapping[str, int],
    data_bitrates: Mapping[str, int],
    fifo: bool | None = None,
    memory_max: int = MEMORY_MAX,
) -> list[Subject]:
    """Return every CAN bus of the recording, ordered by name.

    Args:
        path: a recording of any readable format.
        bitrates: bit rates of buses [bit/s]; they take precedence over the recording's.
        data_bitrates: the same for the data bit rate of CAN FD [bit/s].
        fifo: True if every known sender has a first-in-first-out queue; None: as in its rig.
        memory_max: the most bytes that are made of one compressed piece of it.

    Raises:
        TraceError: the recording cannot be read, or a bit rate is unknown.
    """
    source = open_source(path, memory_max)
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
    with read_trace(source.path, source.memory_max) as trace:
        return names_of(trace.attachments), facts_of(trace.attachments)


def _doubts(found: Findings) -> tuple[tuple[int, str], ...]:
    return (
        (len(found.problems), "rows of the file cannot be read, and are not counted"),
        (
            found.backward,
            "frames have an earlier time stamp than the one before: sorted by time stamp",
        ),
    )
