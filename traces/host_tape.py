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
from typing import Final, final

from traces.decode_canopen import CanopenDecoder
from traces.modbus import Adu
from traces.object_names import axis_of
from traces.said import Kind, Said
from traces.schema import Direction
from traces.traffic import ERR, RTR

Subject = tuple[str, int, str]
"""Bus, node, and object or state."""

ANSWER: Final = "answer"
"""The subject of answers to requests (SDO, Modbus), each of which counts as a report."""
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

    def decode(self, bus: str, frame: bytes) -> Said:
        """Decode a frame."""
        decoder = self._decoders.get(bus)
        if decoder is None:
            decoder = self._decoders[bus] = CanopenDecoder()
        return decoder.decode(frame)

    def told(self, time_ns: int, bus: str, said: Said) -> Iterator[Told]:
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

    def take_frame(self, time_ns: int, bus: str, frame: bytes, direction: Direction) -> None:
        """Take a frame that was complete on a CAN bus."""
        said = self._listener.decode(bus, frame)
        is_remote = bool(int.from_bytes(frame[:4], "little") & RTR)
        is_hosts = direction is Direction.TRANSMITTED or (
            direction is Direction.UNKNOWN and (is_remote or said.kind in _FROM_HOST)
        )
        if not is_hosts:
            self._told += self._listener.told(time_ns, bus, said)
        elif not int.from_bytes(frame[:4], "little") & ERR:
            try:
                start_ns = time_ns - self._length_ns(bus, frame)
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
