"""Messages on a bus, as input of the analysis."""

from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from harness.analysis.frame_length import Bits, longest, shortest

_SHIFT_EFF: Final = 18


class Arrival(Enum):
    """The arrival pattern of a message."""

    PERIODIC = "periodic"  # once a period, delayed by its jitter at most
    SPORADIC = "sporadic"  # limited in frequency only


@final
@dataclass(frozen=True, slots=True)
class Message:
    """Frames with one identifier, from one sender.

    Attributes:
        identifier, extended: 29 bits if extended.
        length: maximum number of data bytes.
        period_ns: distance between two frames, apart from the jitter [ns].
        jitter_ns: maximum delay from the due time to queueing; for a sporadic message, how far a
            burst runs ahead of the period [ns].
        irregular_ns: how much closer than period and jitter allow some frames came [ns]; jitter for
            other messages, but no delay of this one.
        distance_ns: minimum distance between frames [ns]; 0: unknown.
        deadline_ns: maximum response time from the due time (sporadic: from queueing) [ns]; None:
            no deadline.
        name: a description; "": unknown.
        sender: the sending node; "": a node that sends nothing else.
        fd, switched: a CAN FD frame; with a bit rate switch.
        arrival: the arrival pattern.
        movable: True if another identifier can be assigned to it.
        source: the origin of these values, as a text.
        bits: an upper bound of the length if payloads are known; None: the longest possible.
    """

    identifier: int
    length: int
    period_ns: int
    jitter_ns: int = 0
    irregular_ns: int = 0
    distance_ns: int = 0
    deadline_ns: int | None = None
    extended: bool = False
    name: str = ""
    sender: str = ""
    fd: bool = False
    switched: bool = False
    arrival: Arrival = Arrival.PERIODIC
    movable: bool = True
    source: str = ""
    bits: Bits | None = None

    @property
    def label(self) -> str:
        """Its identifier as a text."""
        return f"{self.identifier:08X}h" if self.extended else f"{self.identifier:03X}h"

    @property
    def rank(self) -> int:
        """Its priority; the lower wins (ISO 11898-1: the 11-bit one of equal base identifiers)."""
        return rank_of(self.identifier, extended=self.extended)

    @property
    def longest(self) -> Bits:
        """Its maximum length."""
        if self.bits is not None:
            return self.bits
        return longest(self.length, extended=self.extended, fd=self.fd, switched=self.switched)

    @property
    def shortest(self) -> Bits:
        """Its minimum length with all of its data."""
        return shortest(self.length, extended=self.extended, fd=self.fd, switched=self.switched)


def rank_of(identifier: int, *, extended: bool) -> int:
    """Return the priority of an identifier as a number; the lower wins arbitration."""
    if not extended:
        return identifier << _SHIFT_EFF + 1
    rest = identifier & (1 << _SHIFT_EFF) - 1
    return (identifier >> _SHIFT_EFF) << _SHIFT_EFF + 1 | 1 << _SHIFT_EFF | rest


@final
@dataclass(frozen=True, slots=True)
class BusLoad:
    """All messages on one bus.

    Attributes:
        name: name of the bus.
        bitrate_bit_s: the nominal bit rate [bit/s].
        data_bitrate_bit_s: the bit rate of CAN FD data [bit/s]; None: the nominal one.
        messages: messages with distinct identifiers.
        fifo: senders with one FIFO queue; all others send their most urgent message first.
    """

    name: str
    bitrate_bit_s: int
    messages: tuple[Message, ...]
    data_bitrate_bit_s: int | None = None
    fifo: frozenset[str] = frozenset()

    def takes_ns(self, message: Message) -> int:
        """Return the maximum duration of a frame [ns]."""
        return message.longest.time_ns(self.bitrate_bit_s, self.data_bitrate_bit_s)

    def utilisation(self) -> float:
        """Return the bus utilisation (0 to 1 and more) with the most stuff bits."""
        return sum(self.takes_ns(one) / one.period_ns for one in self.messages)

    def utilisation_unstuffed(self) -> float:
        """Return the bus utilisation without stuff bits."""
        rates = self.bitrate_bit_s, self.data_bitrate_bit_s
        return sum(one.shortest.time_ns(*rates) / one.period_ns for one in self.messages)
