"""Frames that a recorded host sent, and the events that each waited for.

A host sends because time has passed or because of a report: an answer to its SDO request, or a new
state of a node. A replay waits for the reports since the host's previous frame, however late they
are. It keeps the time that passed after the last of them.

States of a node are its boot-up, NMT state, emergencies, and the statusword bits that a host waits
for. Measured quantities are not states: they differ from run to run.

The direction of a frame separates host and devices, if the recorder was the host or a device. A
monitor marks every frame as received, and a recorder beside both programs every frame as sent.
Then the purpose of a frame decides.

Source: CiA 301; CiA 402-2, statusword (bits 0 to 3, 5, 6: state; 10: target reached; 12, 13:
mode-specific).
"""

from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final, NamedTuple, final

from motorhil.frozen import frozen
from motorhil.traces.can_frame import EFF, ERR, RTR
from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.decoding.dynamixel import unit_of
from motorhil.traces.decoding.events import DecodedEvent, Kind
from motorhil.traces.decoding.modbus import ModbusDecoder
from motorhil.traces.decoding.objects import axis_of
from motorhil.traces.formats.modbus import Adu, recorded_adu
from motorhil.traces.mcap.reader import Trace
from motorhil.traces.protobuf import Value, decode
from motorhil.traces.schema import (
    CAN_FRAME,
    MODBUS_ADU,
    SERIAL_DATA,
    Direction,
    FrameDecoder,
    direction_of,
)

Subject = tuple[str, int, str]
"""Bus, node, and object or state."""

ANSWER: Final = "answer"
"""The subject of answers to requests (SDO, lines), each of which counts as a report."""
_RTU_REST: Final = 2  # bytes of a check sum
_OBJECTS_AT: Final = 8  # in a read device identification answer
STATUSWORD_MASK: Final = 0x346F
_STATUSWORD: Final = 0x6041
_NMT: Final = 0  # function codes of the pre-defined connection set
_SDO_REQUEST: Final = 12
_ERROR_CONTROL: Final = 14
_TPDOS: Final = (3, 5, 7, 9)
_FUNCTIONS_OF_NODES: Final = (1, *_TPDOS, 11, _ERROR_CONTROL)
_OPERATIONAL: Final = 5  # an NMT state
_RESETS: Final = (0x81, 0x82)
_FROM_HOST: Final = (Kind.NMT, Kind.SYNC, Kind.TIME, Kind.RPDO, Kind.SDO_REQUEST)
_FROM_NODE: Final = (Kind.TPDO, Kind.SDO_RESPONSE, Kind.EMERGENCY, Kind.HEARTBEAT, Kind.BOOT)


@final
class Told(NamedTuple):
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
@frozen
class HostSide:
    """The criterion for frames of the host in one recording.

    Attributes:
        by_direction: True if the recorded direction separates host and devices.
        nodes: the host's own node-IDs; their heartbeats are the host's.
    """

    by_direction: bool = True
    nodes: frozenset[int] = frozenset()

    def sent(self, said: DecodedEvent, direction: Direction, is_remote: bool = False) -> bool:
        """Return True if the frame is the host's. Devices do not send remote frames."""
        if self.by_direction and direction is not Direction.UNKNOWN:
            return direction is Direction.TRANSMITTED
        if said.kind in (Kind.HEARTBEAT, Kind.BOOT):
            return said.node in self.nodes
        return is_remote or said.kind in _FROM_HOST


@final
@dataclass(slots=True)
class _Sign:
    """The first frame of one node-ID, and the purposes of its frames."""

    boots_first: bool = False
    runs_first: bool = False  # operational before any NMT command to it
    beats: bool = False
    is_commanded: bool = False  # by NMT
    is_reset: bool = False
    talks: bool = False
    is_addressed: bool = False
    beats_sent: int = 0


@final
class HostSurvey:
    """A first look at a recording: directions, and the services of each node-ID.

    Attributes:
        directions: the directions of frames on CAN buses, and of bytes on serial lines.
    """

    def __init__(self) -> None:
        self.directions: set[Direction] = set()
        self._signs: dict[tuple[str, int], _Sign] = {}
        # Buses with an NMT command to all nodes; True: a reset.
        self._commanded: dict[str, bool] = {}

    def take(self, bus: str, frame: bytes, direction: Direction) -> None:
        """Take a frame of a CAN bus."""
        can_id = int.from_bytes(frame[:4], "little")
        if can_id & ERR:
            return
        self.directions.add(direction)
        if can_id & (EFF | RTR):
            return
        function, node = can_id >> 7, can_id & 0x7F
        if function == _NMT and not node and frame[4] > 1:
            self._command(bus, frame[9], frame[8] in _RESETS)
        elif node and function == _SDO_REQUEST:
            self._sign(bus, node).is_addressed = True
        elif node and function in _FUNCTIONS_OF_NODES:
            self._sent(self._sign(bus, node), function, frame, direction)

    def _command(self, bus: str, node: int, resets: bool) -> None:
        if node:
            signs = [self._sign(bus, node)]
            signs[0].is_addressed = True
        else:
            self._commanded[bus] = self._commanded.get(bus, False) or resets
            signs = [sign for (where, _), sign in self._signs.items() if where == bus]
        for sign in signs:
            sign.is_commanded = True
            sign.is_reset = sign.is_reset or resets

    @staticmethod
    def _sent(sign: _Sign, function: int, frame: bytes, direction: Direction) -> None:
        is_first = not (sign.beats or sign.talks)
        if function == _ERROR_CONTROL:
            runs = frame[8] & 0x7F == _OPERATIONAL
            boots = is_first and not frame[8] and not sign.is_reset
            sign.boots_first = sign.boots_first or boots
            sign.beats = True
            sign.beats_sent += direction is Direction.TRANSMITTED
        else:
            runs = function in _TPDOS
            sign.talks = True
        sign.runs_first = sign.runs_first or (runs and not sign.is_commanded)

    def _sign(self, bus: str, node: int) -> _Sign:
        found = self._signs.get((bus, node))
        if found is None:
            told = self._commanded.get(bus)
            found = _Sign(is_commanded=told is not None, is_reset=bool(told))
            self._signs[bus, node] = found
        return found

    def by_direction(self) -> bool:
        """Return True if the recorded directions separate host and devices."""
        both = {Direction.TRANSMITTED, Direction.RECEIVED} <= self.directions
        devices = any(sign.talks for sign in self._signs.values())
        return both or (Direction.TRANSMITTED in self.directions and not devices)

    def nodes(self) -> list[tuple[str, int]]:
        """Return the buses and node-IDs of all that sent a frame of a device, in order."""
        return sorted(key for key, sign in self._signs.items() if sign.beats or sign.talks)

    def running(self) -> list[tuple[str, int]]:
        """Return those that can have been running when the recording began.

        Their first frame is not a boot-up, or it follows a reset by the host. A node-ID that was
        only addressed is one of them.
        """
        return sorted(key for key, sign in self._signs.items() if not sign.boots_first)

    def operational(self) -> list[tuple[str, int]]:
        """Return those that were operational before any recorded NMT command."""
        return sorted(key for key, sign in self._signs.items() if sign.runs_first)

    def hosts_own(self, present: Collection[tuple[str, int]] | None) -> list[tuple[str, int]]:
        """Return the node-IDs that belong to the host.

        Their heartbeats are sent, not received. If directions are unknown, these node-IDs send
        heartbeats alone, nothing is sent to them, and no device has them.

        Args:
            present: buses and node-IDs of the devices; None: unknown.
        """
        known = self.by_direction()
        return sorted(
            key
            for key, sign in self._signs.items()
            if sign.beats
            and not sign.talks
            and (
                sign.beats_sent > 0
                if known
                else present is not None and key not in present and not sign.is_addressed
            )
        )


def survey_of(trace: Trace) -> HostSurvey:
    """Return the survey of a recording; of a cut one, as far as it goes.

    Raises:
        TraceError: the recording is damaged.
    """
    found, frames = HostSurvey(), FrameDecoder()
    for channel, _, payload in trace.messages():
        kind = channel.schema.name if channel.schema is not None else ""
        try:
            if kind == CAN_FRAME.name:
                frame, direction, _ = frames.decode(payload)
                found.take(channel.topic.rpartition("/")[2], frame, direction)
            elif kind == SERIAL_DATA.name:
                found.directions.add(direction_of(decode(SERIAL_DATA, payload)))
        except ValueError:  # an invalid message
            continue
    return found


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
                if not _is_statusword(fact.subject):
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

    Args:
        listener: the listener that hears the recording.
        length_ns: duration of a frame on a CAN bus [ns]; ValueError: impossible on that bus.
        side: the criterion for frames of the host.

    Attributes:
        unsent: number of host frames that cannot be sent again.
    """

    def __init__(
        self,
        listener: Listener,
        length_ns: Callable[[str, bytes], int],
        side: HostSide | None = None,
    ) -> None:
        self._listener = listener
        self._length_ns = length_ns
        self._side = side or HostSide()
        self.unsent: int = 0
        # Each with its place in the recording, because stamps can be equal.
        self._sent: list[tuple[int, HostStep]] = []
        self._told: list[tuple[int, Told]] = []
        self._place = 0
        self._ended_ns: dict[str, int] = {}  # by bus: the time of its last frame

    def take_frame(self, time_ns: int, bus: str, frame: bytes, direction: Direction) -> None:
        """Take a frame that was complete on a CAN bus."""
        said = self._listener.decode(bus, frame)
        ended_ns = self._ended_ns.get(bus, 0)
        self._ended_ns[bus] = time_ns
        self._place += 1
        is_remote = bool(int.from_bytes(frame[:4], "little") & RTR)
        if not self._side.sent(said, direction, is_remote):
            for told in self._listener.told(time_ns, bus, said):
                self._told.append((self._place, told))
        elif not int.from_bytes(frame[:4], "little") & ERR:
            try:
                start_ns = time_ns - self._length_ns(bus, frame)
                # A bus carries one frame after the other, also where the stamps are too coarse.
                # A stamp before the last one says nothing about its end.
                if ended_ns <= time_ns:
                    start_ns = max(start_ns, ended_ns)
            except ValueError:  # CAN FD, or an invalid frame
                self.unsent += 1
                return
            free = said.kind in (Kind.HEARTBEAT, Kind.BOOT)
            step = HostStep(start_ns, time_ns, bus, frame, said.text, is_free=free)
            self._sent.append((self._place, step))

    def take_adu(self, start_ns: int, line: str, data: bytes, adu: Adu, text: str) -> None:
        """Take an ADU of a line; `data` is all of it as on the wire."""
        self._place += 1
        if adu.to_server:
            self._sent.append((self._place, HostStep(start_ns, adu.time_ns, line, data, text)))
        else:
            told = Told(adu.time_ns, (line, adu.unit, ANSWER), True, text)
            self._told.append((self._place, told))

    def take_serial(self, line: str, fields: Mapping[str, Value]) -> None:
        """Take the fields of a message: what one sender sent on a serial line without a pause."""
        data, start_ns = fields.get("data", b""), fields.get("start_ns", 0)
        end_ns, direction = fields.get("end_ns", 0), direction_of(fields)
        assert isinstance(data, bytes)
        assert isinstance(start_ns, int)
        assert isinstance(end_ns, int)
        self._place += 1
        text = data.hex(" ").upper()
        if direction is Direction.TRANSMITTED:
            self._sent.append((self._place, HostStep(start_ns, end_ns, line, data, text)))
        elif direction is Direction.RECEIVED and not fields.get("spoiled"):
            told = Told(end_ns, (line, unit_of(data), ANSWER), True, text)
            self._told.append((self._place, told))

    def steps(self) -> list[HostStep]:
        """Return the frames of the host, in the order in which they began."""
        steps = sorted(self._sent, key=_start_of)
        told = sorted(self._told, key=_time_of)
        first = 0
        for place, step in steps:
            if step.is_free:
                continue
            behind = bisect_right(told, (step.start_ns, place), first, key=_time_of)
            step.waits = [one for _, one in told[first:behind]]
            first = behind
        return [step for _, step in steps]


def _start_of(sent: tuple[int, HostStep]) -> tuple[int, int]:
    return sent[1].start_ns, sent[0]


def _time_of(told: tuple[int, Told]) -> tuple[int, int]:
    return told[1].time_ns, told[0]


@lru_cache(4096)
def _is_statusword(subject: str) -> bool:
    """Return True for the subject of a statusword of any axis."""
    index = subject[:4]
    is_hex = len(index) == 4 and all(c in "0123456789ABCDEFabcdef" for c in index)
    return is_hex and axis_of(int(index, 16))[1] == _STATUSWORD


@final
class RecordedHost(NamedTuple):
    """Frames of a host in order, and the number of those that no classical bus can carry."""

    steps: list[HostStep]
    unsent: int


def host_of(
    trace: Trace,
    listener: Listener,
    length_ns: Callable[[str, bytes], int],
    side: HostSide | None = None,
) -> RecordedHost:
    """Return the frames of the host; of a cut recording, as far as it goes.

    Args:
        trace: the recording.
        listener: the listener that hears it.
        length_ns: duration of a frame on a CAN bus [ns]; ValueError: impossible on that bus.
        side: the criterion for frames of the host; None: directions are reliable.

    Raises:
        TraceError: the recording is damaged.
    """
    cutter = HostCutter(listener, length_ns, side)
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
            elif kind == SERIAL_DATA.name:
                cutter.take_serial(place, decode(SERIAL_DATA, payload))
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
