"""Frames that a recorded host sent, and the events that each waited for.

A host sends because time has passed or because of a report: an answer to its SDO request, or a new
state of a node. A replay waits for the reports since the host's previous frame, however late they
are. It keeps the time that passed after the last of them.

States of a node are its boot-up, NMT state, emergencies, and the statusword bits that a host waits
for. Measured quantities are not states: they differ from run to run.

Source: CiA 301; CiA 402-2, statusword (bits 0 to 3, 5, 6: state; 10: target reached; 12, 13:
mode-specific).
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple, final

from motorhil.traces.can_frame import ERR, RTR
from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.decoding.events import DecodedEvent, Kind
from motorhil.traces.decoding.modbus import ModbusDecoder
from motorhil.traces.decoding.objects import axis_of
from motorhil.traces.formats.modbus import Adu, recorded_adu
from motorhil.traces.mcap.reader import Trace
from motorhil.traces.protobuf import decode
from motorhil.traces.schema import CAN_FRAME, MODBUS_ADU, Direction, FrameDecoder

Subject = tuple[str, int, str]
"""Bus, node, and object or state."""

ANSWER: Final = "answer"
"""The subject of answers to requests (SDO, Modbus), each of which counts as a report."""
_RTU_REST: Final = 2  # bytes of a check sum
_OBJECTS_AT: Final = 8  # in a read device identification answer
STATUSWORD_MASK: Final = 0x346F
_STATUSWORD: Final = 0x6041
_FROM_HOST: Final = (Kind.NMT, Kind.SYNC, Kind.TIME, Kind.RPDO, Kind.SDO_REQUEST)
_FROM_NODE: Final = (Kind.TPDO, Kind.SDO_RESPONSE, Kind.EMERGENCY, Kind.HEARTBEAT, Kind.BOOT)


@final
@dataclass(frozen=True, slots=True)
class Told:
    """A report of a node that a host can wait for: time, subject, value, and words."""

    time_ns: int
    subject: Subject
    value: object
    text: str


@final
@dataclass(slots=True)
class HostStep:
    """A frame of the host.

    Attributes:
        start_ns, end_ns: time of its first and last bit in the recording.
        bus: the bus or line.
        frame: the frame, or the ADU with check sum or header.
        text: the frame in words.
        waits: the reports since the start of the host's previous frame.
        is_free: True for the host's own heartbeat, which waits for nothing.
    """

    start_ns: int
    end_ns: int
    bus: str
    frame: bytes
    text: str
    waits: list[Told] = field(default_factory=list)
    is_free: bool = False


@final
class Listener:
    """Extracts reports that a host can wait for from the frames of all buses."""

    def __init__(self, decoders: Mapping[str, CanopenDecoder]) -> None:
        """Start with prepared decoders of some buses; others are created."""
        self._decoders = dict(decoders)
        self._states: dict[Subject, object] = {}

    def decode(self, bus: str, frame: bytes) -> DecodedEvent:
        """Decode a frame."""
        decoder = self._decoders.get(bus)
        if decoder is None:
            decoder = self._decoders[bus] = CanopenDecoder()
        return decoder.decode(frame)

    def told(self, time_ns: int, bus: str, said: DecodedEvent) -> Iterator[Told]:
        """Yield the reports that are new or have changed."""
        if said.node is None or said.kind not in _FROM_NODE:
            return
        if said.kind is Kind.SDO_RESPONSE:
            yield Told(time_ns, (bus, said.node, ANSWER), True, said.text)
            return
        for fact in said.facts:
            value: object = fact.value
            if said.kind is Kind.TPDO:
                index = fact.subject[:4]
                if axis_of(int(index, 16) if _is_hex(index) else 0)[1] != _STATUSWORD:
                    continue
                value = int(fact.value) & STATUSWORD_MASK if isinstance(fact.value, int) else 0
            subject = (bus, said.node, fact.subject)
            is_event = said.kind in (Kind.BOOT, Kind.EMERGENCY)
            if is_event or self._states.get(subject) != value:
                self._states[subject] = value
                yield Told(time_ns, subject, value, said.text)


@final
class HostCutter:
    """Extracts the frames of the host from a recording, in order.

    The direction shows if a frame is the host's; if it is unknown, the purpose decides.

    Args:
        listener: the listener that hears the recording.
        length_ns: duration of a frame on a CAN bus [ns]; ValueError: impossible on that bus.

    Attributes:
        unsent: number of host frames that cannot be sent again.
    """

    def __init__(self, listener: Listener, length_ns: Callable[[str, bytes], int]) -> None:
        self._listener = listener
        self._length_ns = length_ns
        self.unsent = 0
        self._sent: list[HostStep] = []
        self._told: list[Told] = []
        self._free_ns: dict[str, int] = {}  # by bus: the end of its last frame

    def take_frame(self, time_ns: int, bus: str, frame: bytes, direction: Direction) -> None:
        """Take a frame that was complete on a CAN bus."""
        said = self._listener.decode(bus, frame)
        free_ns = self._free_ns.get(bus, 0)
        self._free_ns[bus] = max(free_ns, time_ns)
        is_remote = bool(int.from_bytes(frame[:4], "little") & RTR)
        is_hosts = direction is Direction.TRANSMITTED or (
            direction is Direction.UNKNOWN and (is_remote or said.kind in _FROM_HOST)
        )
        if not is_hosts:
            self._told += self._listener.told(time_ns, bus, said)
        elif not int.from_bytes(frame[:4], "little") & ERR:
            try:
                # A bus carries one frame after the other, also where the stamps are too coarse.
                start_ns = max(time_ns - self._length_ns(bus, frame), free_ns)
            except ValueError:  # CAN FD, or an invalid frame
                self.unsent += 1
                return
            free = said.kind in (Kind.HEARTBEAT, Kind.BOOT)
            self._sent.append(HostStep(start_ns, time_ns, bus, frame, said.text, is_free=free))

    def take_adu(self, start_ns: int, line: str, data: bytes, adu: Adu, text: str) -> None:
        """Take an ADU of a line; `data` is all of it as on the wire."""
        if adu.to_server:
            self._sent.append(HostStep(start_ns, adu.time_ns, line, data, text))
        else:
            self._told.append(Told(adu.time_ns, (line, adu.unit, ANSWER), True, text))

    def steps(self) -> list[HostStep]:
        """Return the frames of the host, in the order in which they began."""
        steps = sorted(self._sent, key=_start_of)
        told = sorted(self._told, key=_time_of)
        first = 0
        for step in steps:
            if step.is_free:
                continue
            behind = bisect_right(told, step.start_ns, first, key=_time_of)
            step.waits = told[first:behind]
            first = behind
        return steps


def _start_of(step: HostStep) -> int:
    return step.start_ns


def _time_of(told: Told) -> int:
    return told.time_ns


def _is_hex(text: str) -> bool:
    return len(text) == 4 and all(c in "0123456789ABCDEFabcdef" for c in text)


@final
class RecordedHost(NamedTuple):
    """Frames of a host in order, and the number of those that no classical bus can carry."""

    steps: list[HostStep]
    unsent: int


def host_of(
    trace: Trace, listener: Listener, length_ns: Callable[[str, bytes], int]
) -> RecordedHost:
    """Return the frames of the host; of a cut recording, as far as it goes.

    Args:
        trace: the recording.
        listener: the listener that hears it.
        length_ns: duration of a frame on a CAN bus [ns]; ValueError: impossible on that bus.

    Raises:
        TraceError: the recording is damaged.
    """
    cutter = HostCutter(listener, length_ns)
    frames = FrameDecoder()
    lines: dict[str, ModbusDecoder] = {}
    for channel, time_ns, payload in trace.messages():
        kind = channel.schema.name if channel.schema is not None else ""
        place = channel.topic.rpartition("/")[2]
        try:
            if kind == CAN_FRAME.name:
                frame, direction, _ = frames.decode(payload)
                cutter.take_frame(time_ns, place, frame, direction)
            elif kind == MODBUS_ADU.name:
                values = decode(MODBUS_ADU, payload)
                data, start_ns = values.get("data", b""), values.get("start_ns", 0)
                end_ns = values.get("end_ns", 0)
                assert isinstance(data, bytes)
                assert isinstance(start_ns, int)
                assert isinstance(end_ns, int)
                adu = recorded_adu(values, end_ns)
                if isinstance(adu, Adu):
                    text = lines.setdefault(place, ModbusDecoder()).decode(adu).text
                    cutter.take_adu(start_ns, place, data, adu, text)
        except ValueError:  # an invalid message
            continue
    return RecordedHost(cutter.steps(), cutter.unsent)


def answer_size(data: bytes, tcp: bool) -> int | None:
    """Return the size of an answer from its first bytes; None if it is not yet known.

    Source: MODBUS Application Protocol Specification V1.1b3, section 6; on TCP, the header.
    """
    if tcp:
        return 6 + int.from_bytes(data[4:6], "big") if len(data) >= 6 else None
    if len(data) < 3:
        return None
    function = data[1]
    if function & 0x80:
        return 3 + _RTU_REST
    if function == 0x2B:
        return _identification_size(data)
    if function == 0x18:
        return 4 + int.from_bytes(data[2:4], "big") + _RTU_REST if len(data) >= 4 else None
    if function in (0x01, 0x02, 0x03, 0x04, 0x0C, 0x11, 0x14, 0x15, 0x17):
        return 3 + data[2] + _RTU_REST
    fixed = {0x05: 6, 0x06: 6, 0x07: 3, 0x08: 6, 0x0B: 6, 0x0F: 6, 0x10: 6, 0x16: 8}
    return fixed[function] + _RTU_REST if function in fixed else None


def _identification_size(data: bytes) -> int | None:
    """Return the size of a read device identification answer (2Bh, 0Eh) from its objects."""
    if len(data) < _OBJECTS_AT:
        return None
    at = _OBJECTS_AT
    for _ in range(data[_OBJECTS_AT - 1]):
        if len(data) < at + 2:
            return None
        at += 2 + data[at + 1]
    return at + _RTU_REST
