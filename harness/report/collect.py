"""Collection of a recording's contents in one pass, in bounded memory.

Only values that the page draws are kept. Their number is limited: beyond it, quantities are reduced
to the extremes of stretches of time, and frames to sums over cells of time. Both grow with the
recording. States, locks and incidents are limited in number.
"""

import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.report.buses import CanBus, ModbusLine, Nodes, SerialLine, Traffic
from motorhil.harness.report.incidents import Incidents, Severity
from motorhil.harness.report.series import (
    FRAMES_MAX,
    KEPT_MAX,
    STRETCH_NS,
    TIME_MAX_NS,
    Track,
    reduce_held,
    reduce_rows,
)
from motorhil.traces.decoding.attached_rig import RecordedNames, RigFacts, facts_of, names_of
from motorhil.traces.decoding.narrative import Describe
from motorhil.traces.mcap.reader import Trace, TraceMessage
from motorhil.traces.mcap.records import Attachment, Channel
from motorhil.traces.protobuf import decode
from motorhil.traces.schema import (
    CAN_FRAME,
    GROUP_SYNC,
    JOINT_STATE,
    LOG,
    MODBUS_ADU,
    MOTOR_LOCK,
    SERIAL_DATA,
    DoublesDecoder,
    DoublesLayout,
    Level,
    LockAction,
    TruthDecoder,
    truth_message_of,
)
from motorhil.traces.semantics.ownership import LockEvent, lock_event

_Handler = Callable[[int, bytes], None]
DRAWN: Final = (
    *("position_rad", "velocity_rad_s", "torque_n_m"),
    *("position_inc", "demand_inc", "following_error_inc", "state"),
)
"""The quantities of a truth that are drawn, for each of its channels."""
BOUND: Final = 1 << 16
"""Messages between two calls of `Collector.bound`."""
LOCKS_MAX: Final = 100_000
GROUPS_MAX: Final = 20_000
_CHANNEL: Final = re.compile(r"channel_\d+_")
_ROWS: Final = 4_096  # messages of one channel decoded at once
_COMPARED: Final = (0x6062, 0x6064)  # demand and actual position: their difference is drawn
_BAD_ACTIONS: Final = {
    LockAction.REFUSED: "lock refused",
    LockAction.BROKEN: "lock of a dead owner",
    LockAction.TAKEN_OVER: "lock taken over",
    LockAction.LOST: "lock lost",
}


@final
@frozen
class GroupMoment:
    """One message of `/group/<name>/sync`, with its time from the recording's beginning [ns]."""

    time_ns: int
    group: str
    is_start: bool
    motors: tuple[str, ...]
    offsets_s: tuple[float, ...]
    skew_s: float | None
    predicted_s: float | None
    method: str


@final
@dataclass(slots=True)
class Findings:
    """The collected contents of a recording.

    Attributes:
        begin_ns, end_ns: the first and the last log time [ns]; other times count from `begin_ns`.
        in_order: True if all messages have the same time; message numbers then replace times [1
            "ns" each].
        states: tracks by motor and quantity ("position", "velocity", "effort").
        truths: tracks by controller and the controller's own key.
        locks: the first `LOCKS_MAX` lock events, with times from `begin_ns`.
        groups: the first `GROUPS_MAX` messages about groups.
        left_out: number of lock events and messages about groups beyond these limits, by kind.
        stretch_ns: duration of the stretches to which tracks are reduced [ns]; 0: they are not.
    """

    rig: RigFacts
    names: RecordedNames
    begin_ns: int = 0
    end_ns: int = 0
    in_order: bool = False
    messages: Counter[str] = field(default_factory=Counter)
    backward: int = 0
    unread: Counter[str] = field(default_factory=Counter)
    not_drawn: Counter[str] = field(default_factory=Counter)
    incidents: Incidents = field(default_factory=Incidents)
    nodes: Nodes = field(default_factory=Nodes)
    states: dict[str, dict[str, Track]] = field(default_factory=dict)
    truths: dict[str, dict[str, Track]] = field(default_factory=dict)
    locks: list[LockEvent] = field(default_factory=list)
    groups: list[GroupMoment] = field(default_factory=list)
    buses: dict[str, CanBus] = field(default_factory=dict)
    lines: dict[str, ModbusLine | SerialLine] = field(default_factory=dict)
    left_out: Counter[str] = field(default_factory=Counter)
    stretch_ns: int = 0

    def traffics(self) -> list[Traffic]:
        """Return the traffic of all buses and lines, by name."""
        found = [bus.traffic for bus in self.buses.values()]
        return sorted(found + [line.traffic for line in self.lines.values()], key=lambda t: t.name)

    def bound(self, kept_max: int = KEPT_MAX, frames_max: int = FRAMES_MAX) -> None:
        """Reduce tracks and traffic to half of these limits if they exceed them."""
        frames = sum(len(one.times_ns) for one in self.traffics())
        if frames > frames_max:
            for one in self.traffics():
                one.sum_up(max(400, frames_max // 2 * len(one.times_ns) // frames))
        if self._kept() <= kept_max:
            return
        tracks = [track for track in self._tracks() if len(track)]
        span_ns = max(max(track.times_ns) for track in tracks)
        self.stretch_ns = max(self.stretch_ns, STRETCH_NS)
        while 4 * len(tracks) * span_ns > kept_max * self.stretch_ns:
            self.stretch_ns *= 2
        self._reduce()
        while self._kept() > kept_max // 2:
            self.stretch_ns *= 2
            self._reduce()

    def _tracks(self) -> Iterator[Track]:
        for tracks in (*self.states.values(), *self.truths.values()):
            yield from tracks.values()
        for told in self.nodes.told.values():
            yield from told.tracks.values()

    def _kept(self) -> int:
        return sum(len(track) for track in self._tracks())

    def _reduce(self) -> None:
        for tracks in self.states.values():
            reduce_rows(tracks.values(), (), self.stretch_ns)
        for tracks in self.truths.values():
            demands = [track for key, track in tracks.items() if key.endswith("demand_inc")]
            reduce_rows(tracks.values(), demands, self.stretch_ns)
        for told in self.nodes.told.values():
            pair = [told.tracks[index] for index in _COMPARED if len(told.tracks.get(index, ()))]
            if len(pair) == len(_COMPARED):
                reduce_held(pair, self.stretch_ns)
            others = [track for track in told.tracks.values() if len(pair) < 2 or track not in pair]
            reduce_rows(others, (), self.stretch_ns)


def collect(
    trace: Trace,
    bitrates: Mapping[str, int] | None = None,
    data_bitrates: Mapping[str, int] | None = None,
    describe: Describe | None = None,
) -> Findings:
    """Collect the contents of a recording; of a truncated one, as far as it is readable.

    Args:
        trace: the open recording.
        bitrates: bit rates of CAN buses [bit/s]; they override the recording.
        data_bitrates: the same for the data phase of CAN FD.
        describe: returns the message in a frame, if it knows that; None: nothing does.

    Raises:
        TraceError: the recording is damaged.
    """
    span = trace.span_ns()
    begin_ns, in_order = (0, False) if span is None else (span[0], span[0] == span[1])
    collector = Collector(trace.attachments, begin_ns, in_order, describe)
    collector.found.rig.bitrates.update(bitrates or {})
    collector.found.rig.data_bitrates.update(data_bitrates or {})
    messages = iter(trace.messages())
    while collector.feed(islice(messages, BOUND)):
        collector.bound()
    return collector.end()


@final
class Collector:
    """Collector of messages as they come: a recording's, or those of one that still grows.

    Attributes:
        found: the contents so far; complete up to the last message after `settle`.
        count: number of messages so far.
    """

    def __init__(
        self,
        attachments: Sequence[Attachment],
        begin_ns: int,
        in_order: bool = False,
        describe: Describe | None = None,
    ) -> None:
        """Collect nothing yet.

        Args:
            attachments: the files in the recording.
            begin_ns: log time from which other times count [ns].
            in_order: True if message numbers replace times.
            describe: returns the message in a frame, if it knows that; None: nothing does.
        """
        self.found: Findings = Findings(facts_of(attachments), names_of(attachments))
        self.found.begin_ns = self.found.end_ns = begin_ns
        self.found.in_order = in_order
        self.count: int = 0
        self._last_ns = begin_ns
        self._pass = _Pass(self.found, describe)

    def feed(self, messages: Iterable[TraceMessage]) -> int:
        """Collect these messages; return their number."""
        found, pass_ = self.found, self._pass
        handlers, tallies = pass_.handlers, pass_.tallies
        begin_ns, in_order = found.begin_ns, found.in_order
        last_ns, end_ns = self._last_ns, found.end_ns
        count = before = self.count
        for channel, time_ns, payload in messages:
            count += 1
            if time_ns > end_ns:
                end_ns = time_ns
            elif time_ns < last_ns:
                found.backward += 1
            last_ns = time_ns
            at_ns = count if in_order else time_ns - begin_ns
            if at_ns > TIME_MAX_NS:
                at_ns = TIME_MAX_NS
            number = channel.number
            handler = handlers.get(number) or pass_.open(channel)
            tallies[number] += 1
            try:
                handler(at_ns, payload)
            except ValueError:
                found.unread[channel.topic] += 1
        self.count, self._last_ns, found.end_ns = count, last_ns, end_ns
        return count - before

    def settle(self) -> None:
        """Decode what was only collected so far."""
        self._pass.settle()

    def bound(self) -> None:
        """Reduce tracks and traffic if they exceed their limits."""
        self.settle()
        self.found.bound()

    def end(self) -> Findings:
        """Complete the findings at the recording's end, and return them."""
        found = self.found
        if found.in_order:
            found.end_ns = found.begin_ns + self.count
        self._pass.end(found.end_ns - found.begin_ns)
        return found


@final
class _Columns:
    """Decoder of a channel's doubles into tracks, in bulk.

    Args:
        decoder: the decoder of messages whose layout changes, or is not one of `DoublesLayout`.
        slow: returns the values of any payload by name.
        is_drawn: returns True if a quantity is drawn.
        tracks: filled with the tracks by quantity.
    """

    def __init__(
        self,
        decoder: DoublesDecoder,
        slow: Callable[[bytes], dict[str, float]],
        is_drawn: Callable[[str], bool],
        tracks: dict[str, Track],
    ) -> None:
        self._decoder = decoder
        self._slow = slow
        self._is_drawn = is_drawn
        self._tracks = tracks
        self._layout: DoublesLayout | None = None
        self._times: array[int] = array("q")
        self._rows = bytearray()

    def take(self, time_ns: int, payload: bytes) -> None:
        """Take a message; raise ValueError if it cannot be decoded."""
        layout = self._layout
        if layout is not None and layout.fits(payload):
            self._times.append(time_ns)
            self._rows += payload
            if len(self._times) >= _ROWS:
                self.settle()
            return
        self.settle()
        values = self._slow(payload)
        for name, value in values.items():
            if self._is_drawn(name):
                self._track(name).add(time_ns, value)
        layout = self._decoder.layout(payload)
        is_whole = layout is not None and len(layout.names) == len(values)
        self._layout = layout if is_whole else None

    def settle(self) -> None:
        """Decode the messages that were taken since the last call."""
        layout = self._layout
        if layout is None or not self._times:
            return
        import numpy as np

        times = np.array(self._times)
        rows = np.frombuffer(bytes(self._rows), dtype=np.uint8).reshape(len(times), layout.size)
        begin = len(layout.prefix)
        for place, name in enumerate(layout.names):
            if self._is_drawn(name):
                at = begin + 9 * place + 1
                values = np.ascontiguousarray(rows[:, at : at + 8]).view("<f8")[:, 0]
                self._track(name).extend(times, values)
        self._times = array("q")
        self._rows.clear()

    def _track(self, name: str) -> Track:
        track = self._tracks.get(name)
        if track is None:
            track = self._tracks[name] = Track()
        return track


@final
class _Pass:
    """Dispatcher of messages to the handlers of their channels.

    Attributes:
        handlers: the handler of each channel, by its number.
        tallies: the number of messages of each channel.
    """

    def __init__(self, found: Findings, describe: Describe | None) -> None:
        self.handlers: dict[int, _Handler] = {}
        self.tallies: dict[int, int] = {}
        self._found = found
        self._describe = describe
        self._channels: list[tuple[Channel, bool]] = []
        self._columns: list[_Columns] = []

    def open(self, channel: Channel) -> _Handler:
        """Return the handler of a channel's messages, which may ignore them."""
        handler = self._handler(channel)
        self._channels.append((channel, handler is not None))
        self.tallies[channel.number] = 0
        self.handlers[channel.number] = handler or _ignore
        return self.handlers[channel.number]

    def settle(self) -> None:
        """Decode what was only collected so far."""
        for columns in self._columns:
            columns.settle()

    def end(self, end_ns: int) -> None:
        """Complete the findings at the recording's end [ns from its beginning]."""
        self.settle()
        for bus in self._found.buses.values():
            bus.end(end_ns)
        for channel, is_drawn in self._channels:
            count = self.tallies[channel.number]
            self._found.messages[channel.topic] += count
            if not is_drawn:
                self._found.not_drawn[channel.topic] += count

    def _handler(self, channel: Channel) -> _Handler | None:
        found = self._found
        schema = channel.schema
        if schema is None or channel.encoding != "protobuf":
            return None
        name = _name_in(channel.topic)
        if schema.name == CAN_FRAME.name:
            bus = found.buses.get(name)
            if bus is None:
                rate, data_rate = (
                    rates.get(name) for rates in (found.rig.bitrates, found.rig.data_bitrates)
                )
                nodes, incidents = found.nodes, found.incidents
                bus = CanBus(
                    *(name, rate, found.names, nodes, incidents, data_rate, self._describe)
                )
                bus.is_timed = not found.in_order
                found.buses[name] = bus
            return bus.take
        if schema.name == MODBUS_ADU.name:
            return lambda time_ns, payload: self._adu(name, time_ns, payload)
        if schema.name == SERIAL_DATA.name:
            serial = SerialLine(name, found.incidents, self._describe)
            found.lines[name] = serial
            return lambda time_ns, payload: serial.take(
                time_ns, decode(SERIAL_DATA, payload), found.begin_ns
            )
        if schema.name == JOINT_STATE.name:
            return self._state_handler(name)
        if schema.name == MOTOR_LOCK.name:
            return lambda time_ns, payload: self._lock(name, time_ns, payload)
        if schema.name == GROUP_SYNC.name:
            return lambda time_ns, payload: self._group(name, time_ns, payload)
        if schema.name == LOG.name:
            return self._event
        message = truth_message_of(schema)
        return None if message is None else self._truth_handler(name, TruthDecoder(message))

    def _adu(self, name: str, time_ns: int, payload: bytes) -> None:
        fields = decode(MODBUS_ADU, payload)
        line = self._found.lines.get(name)
        if line is None:
            tcp = bool(fields.get("tcp"))
            line = ModbusLine(name, tcp, self._found.names, self._found.incidents)
            self._found.lines[name] = line
        line.take(time_ns, fields, self._found.begin_ns)

    def _state_handler(self, motor: str) -> _Handler:
        decoder = DoublesDecoder(JOINT_STATE)
        tracks = self._found.states.setdefault(motor, {})
        columns = _Columns(decoder, decoder.decode, lambda name: True, tracks)
        self._columns.append(columns)
        return columns.take

    def _truth_handler(self, controller: str, reader: TruthDecoder) -> _Handler:
        tracks = self._found.truths.setdefault(controller, {})

        def is_drawn(name: str) -> bool:
            head = _CHANNEL.match(name)
            return name[head.end() if head else 0 :] in DRAWN

        columns = _Columns(reader.doubles, reader.decode, is_drawn, tracks)
        self._columns.append(columns)
        return columns.take

    def _lock(self, motor: str, time_ns: int, payload: bytes) -> None:
        event = lock_event(motor, time_ns, payload)
        if len(self._found.locks) < LOCKS_MAX:
            self._found.locks.append(event)
        else:
            self._found.left_out["lock events"] += 1
        kind = _BAD_ACTIONS.get(event.action)
        if kind is not None:
            who = event.owner or "unknown owner"
            whose = f", held by {event.holder}" if event.holder else ""
            text = f"{who}: {kind.removeprefix('lock ')}, {motor}{whose}"
            self._found.incidents.add(time_ns, Severity.WARNING, kind, motor, text)

    def _group(self, group: str, time_ns: int, payload: bytes) -> None:
        fields = decode(GROUP_SYNC, payload)
        if len(self._found.groups) >= GROUPS_MAX:
            self._found.left_out["messages about groups"] += 1
            return
        self._found.groups.append(
            GroupMoment(
                time_ns,
                group,
                fields.get("phase") == 1,
                tuple(str(name) for name in _list(fields.get("motor"))),
                tuple(
                    float(one) for one in _list(fields.get("offset_s")) if isinstance(one, float)
                ),
                _number(fields.get("skew_s")),
                _number(fields.get("predicted_skew_s")),
                str(fields.get("method", "")),
            )
        )

    def _event(self, time_ns: int, payload: bytes) -> None:
        fields = decode(LOG, payload)
        level = fields.get("level", 0)
        assert isinstance(level, int)
        severity = Severity.INFO
        if level >= Level.ERROR:
            severity = Severity.ERROR
        elif level == Level.WARNING:
            severity = Severity.WARNING
        who = str(fields.get("name", "")) or "events"
        text = str(fields.get("message", ""))
        self._found.incidents.add(time_ns, severity, "event", who, text)


def _ignore(time_ns: int, payload: bytes) -> None:
    """Ignore a message that is not drawn."""


def _name_in(topic: str) -> str:
    """Return the topic between its first and last part, if it has three parts or more."""
    parts = topic.strip("/").split("/")
    return "/".join(parts[1:-1] if len(parts) > 2 else parts[1:]) or topic


def _list(value: object) -> list[object]:
    return list(value) if isinstance(value, list | tuple) else []


def _number(value: object) -> float | None:
    return value if isinstance(value, float) else None
