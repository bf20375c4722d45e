"""What a recorded host sent on buses and lines, and what each frame of it waited for.

A host sends because time has passed, or because something was told: an answer to its SDO request,
another state of a node. What had been told since its last frame comes first when it is played
again, as late as that may be; the time that passed behind the last of it is kept.

States of a node are its boot-up, NMT state, emergencies, and of the statusword those bits that a
host waits for. Measured quantities are none: they differ from run to run.

Source: CiA 301; CiA 402-2, statusword (bits 0 to 3, 5, 6: state; 10: target reached; 12, 13: of
the mode).
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
"""Bus, node, what of it."""

ANSWER: Final = "answer"
"""The subject of answers to requests (SDO, Modbus), each of which is told: there is one."""
STATUSWORD_MASK: Final = 0x346F
_STATUSWORD: Final = 0x6041
_FROM_HOST: Final = (Kind.NMT, Kind.SYNC, Kind.TIME, Kind.RPDO, Kind.SDO_REQUEST)
_FROM_NODE: Final = (Kind.TPDO, Kind.SDO_RESPONSE, Kind.EMERGENCY, Kind.HEARTBEAT, Kind.BOOT)


@final
@dataclass(frozen=True, slots=True)
class Told:
    """A node tells something a host may wait for: when, what, which value, as a sentence."""

    time_ns: int
    subject: Subject
    value: object
    text: str


@final
@dataclass(slots=True)
class HostStep:
    """A frame of the host.

    Attributes:
        start_ns, end_ns: of its first and last bit in the recording.
        bus: where.
        frame: the frame, or the ADU with check sum or header.
        text: as a sentence.
        waits: what had been told since the start of the host's frame before.
        is_free: it waits for nothing and nobody waits for it: the host's own heartbeat.
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
    """Hears the frames of all buses, and says what of it a host may wait for."""

    def __init__(self, decoders: Mapping[str, CanopenDecoder]) -> None:
        """With a decoder for each bus that has been prepared; others are made."""
        self._decoders = dict(decoders)
        self._states: dict[Subject, object] = {}

    def decode(self, bus: str, frame: bytes) -> Said:
        """What a frame says."""
        decoder = self._decoders.get(bus)
        if decoder is None:
            decoder = self._decoders[bus] = CanopenDecoder()
        return decoder.decode(frame)

    def told(self, time_ns: int, bus: str, said: Said) -> Iterator[Told]:
        """What is told by it for the first time, or anew."""
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
    """Cuts a recording into what its host sent; shown everything in order.

    Whose a frame is tells its direction; where that is not known, what it is for.

    Args:
        listener: that hears the recording.
        length_ns: how long a frame is on a CAN bus [ns]; ValueError: it cannot be on one.

    Attributes:
        unsent: how many frames of the host cannot be sent again.
    """

    def __init__(self, listener: Listener, length_ns: Callable[[str, bytes], int]) -> None:
        self._listener = listener
        self._length_ns = length_ns
        self.unsent = 0
        self._sent: list[HostStep] = []
        self._told: list[Told] = []

    def take_frame(self, time_ns: int, bus: str, frame: bytes, direction: Direction) -> None:
        """A frame was complete on a CAN bus."""
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
            except ValueError:  # CAN FD, or no frame that a node could send
                self.unsent += 1
                return
            free = said.kind in (Kind.HEARTBEAT, Kind.BOOT)
            self._sent.append(HostStep(start_ns, time_ns, bus, frame, said.text, is_free=free))

    def take_adu(self, start_ns: int, line: str, data: bytes, adu: Adu, text: str) -> None:
        """An ADU was on a line; `data` is all of it, as it was there."""
        if adu.to_server:
            self._sent.append(HostStep(start_ns, adu.time_ns, line, data, text))
        else:
            self._told.append(Told(adu.time_ns, (line, adu.unit, ANSWER), True, text))

    def steps(self) -> list[HostStep]:
        """What the host sent, in the order in which it began to."""
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
