"""Collection of a recording's contents in one pass."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final, final

from motorhil.harness.report.buses import CanBus, ModbusLine, Nodes, Traffic
from motorhil.harness.report.incidents import Incidents, Severity
from motorhil.harness.report.series import TIME_MAX_NS, Track
from motorhil.traces.decoding.attached_rig import RecordedNames, RigFacts, facts_of, names_of
from motorhil.traces.mcap.reader import Trace
from motorhil.traces.mcap.records import Channel
from motorhil.traces.protobuf import decode
from motorhil.traces.schema import (
    CAN_FRAME,
    GROUP_SYNC,
    JOINT_STATE,
    LOG,
    MODBUS_ADU,
    MOTOR_LOCK,
    Level,
    LockAction,
    TruthDecoder,
    truth_message_of,
)
from motorhil.traces.semantics.ownership import LockEvent, lock_event

_Handler = Callable[[int, bytes], None]
_BAD_ACTIONS: Final = {
    LockAction.REFUSED: "lock refused",
    LockAction.BROKEN: "lock of a dead owner",
    LockAction.TAKEN_OVER: "lock taken over",
    LockAction.LOST: "lock lost",
}


@final
@dataclass(frozen=True, slots=True)
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
        locks: lock events, with times from `begin_ns`.
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
    lines: dict[str, ModbusLine] = field(default_factory=dict)

    def traffics(self) -> list[Traffic]:
        """Return the traffic of all buses and lines, by name."""
        found = [bus.traffic for bus in self.buses.values()]
        return sorted(found + [line.traffic for line in self.lines.values()], key=lambda t: t.name)


def collect(
    trace: Trace,
    bitrates: Mapping[str, int] | None = None,
    progress: Callable[[int], None] | None = None,
    data_bitrates: Mapping[str, int] | None = None,
) -> Findings:
    """Collect the contents of a recording; of a truncated one, as far as it is readable.

    Args:
        trace: the open recording.
        bitrates: bit rates of CAN buses [bit/s]; they override the recording.
        progress: called from time to time with the number of messages read.
        data_bitrates: the same for the data phase of CAN FD.

    Raises:
        TraceError: the recording is damaged.
    """
    found = Findings(facts_of(trace.attachments), names_of(trace.attachments))
    found.rig.bitrates.update(bitrates or {})
    found.rig.data_bitrates.update(data_bitrates or {})
    span = trace.span_ns()
    if span is None:
        return found
    found.begin_ns = span[0]
    found.in_order = span[0] == span[1]
    pass_ = _Pass(found)
    last_ns = end_ns = span[0]
    count = 0
    for channel, time_ns, payload in trace.messages():
        count += 1
        if time_ns < last_ns:
            found.backward += 1
        last_ns = time_ns
        end_ns = max(end_ns, time_ns)
        at_ns = count if found.in_order else min(time_ns - span[0], TIME_MAX_NS)
        pass_.take(channel, at_ns, payload)
        if progress is not None and not count % 20_000:
            progress(count)
    found.end_ns = span[0] + count if found.in_order else end_ns
    return found


@final
class _Pass:
    """Dispatcher of messages to the handlers of their channels."""

    def __init__(self, found: Findings) -> None:
        self._found = found
        self._handlers: dict[int, tuple[str, _Handler | None]] = {}

    def take(self, channel: Channel, time_ns: int, payload: bytes) -> None:
        known = self._handlers.get(channel.number)
        if known is None:
            known = self._handlers[channel.number] = (channel.topic, self._handler(channel))
        topic, handler = known
        self._found.messages[topic] += 1
        if handler is None:
            self._found.not_drawn[topic] += 1
            return
        try:
            handler(time_ns, payload)
        except ValueError:
            self._found.unread[topic] += 1

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
                bus = CanBus(name, rate, found.names, nodes, incidents, data_rate)
                found.buses[name] = bus
            return bus.take
        if schema.name == MODBUS_ADU.name:
            return lambda time_ns, payload: self._adu(name, time_ns, payload)
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
        tracks = self._found.states.setdefault(motor, {})

        def take(time_ns: int, payload: bytes) -> None:
            for name, value in decode(JOINT_STATE, payload).items():
                if isinstance(value, float):
                    track = tracks.get(name)
                    if track is None:
                        track = tracks[name] = Track()
                    track.add(time_ns, value)

        return take

    def _truth_handler(self, controller: str, reader: TruthDecoder) -> _Handler:
        tracks = self._found.truths.setdefault(controller, {})

        def take(time_ns: int, payload: bytes) -> None:
            for name, value in reader.decode(payload).items():
                track = tracks.get(name)
                if track is None:
                    track = tracks[name] = Track()
                track.add(time_ns, value)

        return take

    def _lock(self, motor: str, time_ns: int, payload: bytes) -> None:
        event = lock_event(motor, time_ns, payload)
        self._found.locks.append(event)
        kind = _BAD_ACTIONS.get(event.action)
        if kind is not None:
            who = event.owner or "unknown owner"
            whose = f", held by {event.holder}" if event.holder else ""
            text = f"{who}: {kind.removeprefix('lock ')}, {motor}{whose}"
            self._found.incidents.add(time_ns, Severity.WARNING, kind, motor, text)

    def _group(self, group: str, time_ns: int, payload: bytes) -> None:
        fields = decode(GROUP_SYNC, payload)
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


def _name_in(topic: str) -> str:
    """Return the topic between its first and last part, if it has three parts or more."""
    parts = topic.strip("/").split("/")
    return "/".join(parts[1:-1] if len(parts) > 2 else parts[1:]) or topic


def _list(value: object) -> list[object]:
    return list(value) if isinstance(value, list | tuple) else []


def _number(value: object) -> float | None:
    return value if isinstance(value, float) else None
