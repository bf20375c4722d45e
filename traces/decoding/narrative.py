"""A recording in words: frames, ADUs, locks, groups and events in order.

To describe a later part, the decoders first learn from the recording's beginning. Most traffic is
PDOs, and only the last PDO of each identifier counts, unless a message that affects their decoding
follows. So only a few messages need to be decoded.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.traces.decoding.attached_rig import RecordedNames, names_of
from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.decoding.events import DecodedEvent, Kind
from motorhil.traces.decoding.modbus import ModbusDecoder
from motorhil.traces.formats.modbus import Malformed, recorded_adu
from motorhil.traces.layout import Signal
from motorhil.traces.mcap.reader import Trace, TraceMessage
from motorhil.traces.mcap.records import Channel
from motorhil.traces.protobuf import Message, Value, decode
from motorhil.traces.schema import (
    CAN_FRAME,
    GROUP_SYNC,
    LOG,
    MODBUS_ADU,
    MOTOR_LOCK,
    SERIAL_DATA,
    Direction,
    FrameDecoder,
    Level,
    LockAction,
    direction_of,
)

PREAMBLE_NS: Final = 5_000_000_000
PREAMBLE_MAX: Final = 50_000
_ID_MASK: Final = 0x1FFF_FFFF
_ID_TAG: Final = b"\x0d"  # the first byte of our CanFrame; the identifier follows
_NMT: Final = bytes(4)
_ERROR_CONTROL: Final = b"\x07"
_BOOTED: Final = b"\x7a\x01\x00"  # the end of a CanFrame with one data byte, 0
_SERVICES: Final = frozenset(
    number.to_bytes(4, "little") for number in (0, *range(0x580, 0x680), *range(0x701, 0x780))
)
"""Identifiers of NMT, SDO and error control, as encoded in a CanFrame."""
_SHAPING: Final = frozenset(
    index.to_bytes(2, "little")
    for index in (
        *(0x1000, *range(0x1400, 0x1C00)),
        *(first + 0x800 * axis for first in (0x6040, 0x6060, 0x6061) for axis in range(8)),
    )
)
"""Objects that affect the contents of PDOs or their decoding."""
_LOCK_WORDS: Final = {
    LockAction.TAKEN: "takes {motor}",
    LockAction.RELEASED: "releases {motor}",
    LockAction.WAITING: "waits for {motor}",
    LockAction.REFUSED: "is refused {motor}",
    LockAction.BROKEN: "takes {motor} from a dead owner",
    LockAction.TAKEN_OVER: "takes {motor} over",
    LockAction.LOST: "has lost {motor}",
}


@final
@frozen
class BusMessage:
    """A CAN message by another description than CANopen.

    Attributes:
        name: its name.
        signals: its signals, in the order of the description.
        problem: why its data cannot be decoded; "" if it was.
        node: the node that it comes from or goes to; None: as in CANopen.
    """

    name: str
    signals: tuple[Signal, ...] = ()
    problem: str = ""
    node: int | None = None

    def as_table(self) -> dict[str, object]:
        """Return the name and the signals as JSON values."""
        signals = {name: {"value": value, "unit": unit} for name, value, unit in self.signals}
        return {"name": self.name, "signals": signals}

    def __str__(self) -> str:
        if self.problem:
            return f"{self.name}: not decodable: {self.problem}"
        told = (f"{name} = {_shown(value)} {unit}".rstrip() for name, value, unit in self.signals)
        return f"{self.name}: {', '.join(told)}".rstrip(": ")


Describe = Callable[[str, bytes], BusMessage | None]
"""Returns the message in a frame (bus, frame), if it knows that."""


def _shown(value: int | float | str) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)


@final
@dataclass(slots=True)  # not frozen: making a frozen one takes four times as long
class Line:
    """One message of a recording in words. Nobody changes it.

    Attributes:
        time_ns: log time.
        topic: of the message.
        place: the name in the topic: the bus, line, motor or group; "events".
        told: a sentence, or what gives it.
        said: the decoded content; None: not traffic.
        identifier: of a CAN frame; else None.
        direction: of a CAN frame, or of bytes on a serial line, if recorded.
        names: names of the motors and controllers concerned.
        values: the message's own fields; none for a CAN frame.
        message: the message by another description, which then gives the sentence.
    """

    time_ns: int
    topic: str
    place: str
    told: str | DecodedEvent | BusMessage
    said: DecodedEvent | None = None
    identifier: int | None = None
    names: tuple[str, ...] = ()
    values: tuple[tuple[str, Value], ...] = ()
    direction: Direction = Direction.UNKNOWN
    message: BusMessage | None = None

    @property
    def text(self) -> str:
        """The message as a sentence."""
        return str(self.told)

    @property
    def node(self) -> int | None:
        """The node or unit of traffic, if it has one."""
        if self.message is not None and self.message.node is not None:
            return self.message.node
        return None if self.said is None else self.said.node


@final
class Story:
    """Describes an open recording in words; read it from front to back (decoders have state)."""

    def __init__(
        self,
        trace: Trace,
        names: RecordedNames | None = None,
        describe: Describe | None = None,
    ) -> None:
        """Start before the first message.

        Args:
            trace: the recording.
            names: names of nodes and objects; None: those in the recording.
            describe: returns the message in a frame, if it knows that; None: nothing does.
        """
        self._describe = describe
        self.names: RecordedNames = names_of(trace.attachments) if names is None else names
        self._trace = trace
        self._has_learned = False
        self._buses: dict[str, CanopenDecoder] = {}
        self._lines: dict[str, ModbusDecoder] = {}
        self._decode_frame = FrameDecoder().decode
        self._motors = {place: name for name, place in self.names.motors.items()}
        self._channels: dict[int, tuple[Channel, _Tell | None]] = {}

    def lines(self, from_ns: int | None = None, to_ns: int | None = None) -> Iterator[Line]:
        """Yield the messages of a span in words, without motion and plants (which need plots).

        If the span begins later, the contents of PDOs are first learned from the recording's
        beginning: its first `PREAMBLE_NS`, at most `PREAMBLE_MAX` frames.

        Raises:
            TraceError: the recording is damaged.
        """
        if from_ns is not None:
            self._learn(from_ns)
        yield from self._told(self._trace.messages(None, from_ns, to_ns))

    def more_lines(self, from_ns: int | None = None, to_ns: int | None = None) -> Iterator[Line]:
        """Yield the lines written since the last call (`Trace.grow`), like `lines`."""
        if from_ns is not None and not self._has_learned:
            self._learn(from_ns)
        self._has_learned = True
        for line in self._told(self._trace.more_messages(from_ns)):
            if (from_ns is None or line.time_ns >= from_ns) and (
                to_ns is None or line.time_ns < to_ns
            ):
                yield line

    def _told(self, messages: Iterable[TraceMessage]) -> Iterator[Line]:
        for message in messages:
            line = self.line(message)
            if line is not None:
                yield line

    def line(self, message: TraceMessage) -> Line | None:
        """Return one message in words; None for a kind that is not described."""
        channel, time_ns, payload = message
        known = self._channels.get(channel.number)
        if known is None or known[0] is not channel:
            known = self._channels[channel.number] = channel, self._teller(channel)
        tell = known[1]
        if tell is None:
            return None
        try:
            return tell(time_ns, payload)
        except ValueError as error:
            text = f"unreadable message: {error}"
            return Line(time_ns, channel.topic, _place(channel.topic), text)

    def _teller(self, channel: Channel) -> "_Tell | None":
        """Return the function that describes messages of a channel; None: nothing does."""
        topic, place = channel.topic, _place(channel.topic)
        schema = channel.schema.name if channel.schema is not None else ""
        if schema == CAN_FRAME.name:
            if place not in self._buses:
                nodes = {n: name for (b, n), name in self.names.nodes.items() if b == place}
                self._buses[place] = CanopenDecoder(nodes, self.names.objects_on(place))
            return partial(self._can, topic, place, self._buses[place])
        if schema == MODBUS_ADU.name:
            if place not in self._lines:
                units = {n: name for (b, n), name in self.names.nodes.items() if b == place}
                self._lines[place] = ModbusDecoder(units)
            return partial(self._modbus, topic, place, self._lines[place])
        if schema == SERIAL_DATA.name:
            return partial(self._serial, topic, place)
        return partial(_plain, topic, place, *_PLAIN[schema]) if schema in _PLAIN else None

    def _learn(self, from_ns: int) -> None:
        begins_ns, _ = self._trace.span_ns() or (0, 0)
        until_ns = min(from_ns, begins_ns + PREAMBLE_NS)
        for message in telling(self._trace.messages(None, None, until_ns), PREAMBLE_MAX):
            self.line(message)
        for bus in self._buses.values():
            bus.forget_transfers()
        for line in self._lines.values():
            line.forget_requests()

    def _can(
        self, topic: str, bus: str, decoder: CanopenDecoder, time_ns: int, payload: bytes
    ) -> Line:
        frame, direction, sender = self._decode_frame(payload)
        said = decoder.decode(frame, sender)
        identifier = None  # None for an error message: its bits are not an identifier
        if said.kind is not Kind.BUS_ERROR:
            identifier = int.from_bytes(frame[:4], "little") & _ID_MASK
        message = None if self._describe is None else self._describe(bus, frame)
        node = said.node if message is None or message.node is None else message.node
        about, told = self._about(bus, node), said if message is None else message
        return Line(time_ns, topic, bus, told, said, identifier, about, (), direction, message)

    def _modbus(
        self, topic: str, name: str, decoder: ModbusDecoder, time_ns: int, payload: bytes
    ) -> Line:
        fields = decode(MODBUS_ADU, payload)
        sender = str(fields.get("sender", ""))
        adu = recorded_adu(fields, time_ns)
        if isinstance(adu, Malformed):
            text = f"Modbus, not an ADU ({adu.problem}): {adu.data.hex(' ').upper()}"
            return Line(time_ns, topic, name, text)
        if not adu.to_server and sender:
            decoder.call(adu.unit, sender)
            self.names.nodes.setdefault((name, adu.unit), sender)
        said = decoder.decode(adu)
        return Line(time_ns, topic, name, said, said, None, self._about(name, said.node))

    def _serial(self, topic: str, name: str, time_ns: int, payload: bytes) -> Line:
        fields = decode(SERIAL_DATA, payload)
        data = fields.get("data", b"")
        assert isinstance(data, bytes)
        message = None if self._describe is None else self._describe(name, data)
        text = data.hex(" ").upper() if message is None else str(message)
        text = f"a collision: {text}" if fields.get("spoiled") else text
        node = None if message is None else message.node
        about, way = self._about(name, node), direction_of(fields)
        return Line(time_ns, topic, name, text, names=about, direction=way, message=message)

    def _about(self, bus: str, node: int | None) -> tuple[str, ...]:
        """Return the motor and the controller of a node."""
        if node is None:
            return ()
        controller = self.names.nodes.get((bus, node))
        motor = self._motors.get((bus, node))
        if motor is None:
            return () if controller is None else (controller,)
        return (motor,) if controller in (None, motor) else (motor, controller)


def _place(topic: str) -> str:
    """Return the name in a topic: the bus, line, motor or group; "events"."""
    parts = topic.strip("/").split("/")
    return parts[1] if len(parts) > 1 else parts[0]


def _plain(
    topic: str, place: str, table: Message, words: "_Words", time_ns: int, payload: bytes
) -> Line:
    fields = decode(table, payload)
    text, names = words(place, fields)
    return Line(time_ns, topic, place, text, names=names, values=tuple(fields.items()))


def _lock(motor: str, fields: dict[str, Value]) -> tuple[str, tuple[str, ...]]:
    number = fields.get("action", 0)
    action = next((one for one in LockAction if one == number), LockAction.UNKNOWN)
    words = _LOCK_WORDS.get(action, "takes an unknown action on {motor}").format(motor=motor)
    text = f"{_text(fields, 'owner') or 'unknown owner'} {words}"
    if fields.get("holder"):
        text += f", held by {_text(fields, 'holder')}"
    waited, held = fields.get("waited_s", 0.0), fields.get("held_s", 0.0)
    if isinstance(waited, float) and waited:
        text += f", after waiting {waited:.3f} s"
    if isinstance(held, float) and held and action is LockAction.RELEASED:
        text += f", after {held:.3f} s"
    return text, (motor,)


def _sync(group: str, fields: dict[str, Value]) -> tuple[str, tuple[str, ...]]:
    motors = fields.get("motor", [])
    assert isinstance(motors, list)
    skew = fields.get("skew_s")
    word = "begins together" if fields.get("phase") == 1 else "has ended"
    told = f", {float(skew) * 1e3:.3f} ms apart" if isinstance(skew, float) else ""
    method = f" ({_text(fields, 'method')})" if fields.get("method") else ""
    return f"group {group} {word}{told}{method}: {', '.join(motors)}", tuple(motors)


def _log(_: str, fields: dict[str, Value]) -> tuple[str, tuple[str, ...]]:
    number = fields.get("level", 0)
    level = next((one.name.lower() for one in Level if one == number), "unknown")
    who = _text(fields, "name")
    told = f"{level}, {who}: " if who else f"{level}: "
    return told + _text(fields, "message"), (who,) if who else ()


def _text(fields: dict[str, Value], name: str) -> str:
    """Return a text field; empty if it is absent."""
    value = fields.get(name)
    return value if isinstance(value, str) else ""


_Tell = Callable[[int, bytes], Line]
"""Returns a message in words: log time [ns], payload."""
_Words = Callable[[str, dict[str, Value]], tuple[str, tuple[str, ...]]]
"""Returns a sentence and the names in it: the name in the topic, the fields."""
_PLAIN: Final[dict[str, tuple[Message, _Words]]] = {
    MOTOR_LOCK.name: (MOTOR_LOCK, _lock),
    GROUP_SYNC.name: (GROUP_SYNC, _sync),
    LOG.name: (LOG, _log),
}


def telling(messages: Iterable[TraceMessage], most: int) -> Iterator[TraceMessage]:
    """Yield those of the first `most` messages of traffic that affect a decoder.

    These are all Modbus messages; of CAN, NMT, boot-ups and SDO in order, and of other frames the
    last of each identifier before a message that affects decoding; and all CAN frames of other
    writers.
    """
    last: dict[tuple[int, bytes], TraceMessage] = {}
    kinds: dict[int, str] = {}  # schemas by channel; "": not traffic
    for message in messages:
        channel, _, payload = message
        kind = kinds.get(channel.number)
        if kind is None:
            schema = channel.schema if channel.topic.startswith(("/can/", "/modbus/")) else None
            kind = kinds[channel.number] = schema.name if schema is not None else ""
        if not kind:
            continue
        if kind != CAN_FRAME.name or payload[:1] != _ID_TAG:
            yield message
        elif payload[1:5] not in _SERVICES:
            key = channel.number, payload[:7]
            last.pop(key, None)  # keeps them in the order of their last occurrence
            last[key] = message
        elif payload[2:3] != _ERROR_CONTROL or payload.endswith(_BOOTED):
            is_sdo = payload[1:5] != _NMT and payload[2:3] != _ERROR_CONTROL
            if last and (not is_sdo or payload[-7:-5] in _SHAPING):
                yield from last.values()
                last.clear()
            yield message
        most -= 1
        if not most:
            break
    yield from last.values()
