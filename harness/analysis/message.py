"""What is sent on a bus, as the analysis takes it: whole nanoseconds, identifiers, senders."""

from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from harness.analysis.frame_length import Bits, longest, shortest

_SHIFT_EFF: Final = 18


class Arrival(Enum):
    """How a message comes."""

    PERIODIC = "periodic"  # once a period, each up to its jitter later
    SPORADIC = "sporadic"  # at most so often; nothing says when


@final
@dataclass(frozen=True, slots=True)
class Message:
    """Frames with one identifier, of one sender.

    Attributes:
        identifier, extended: 29 bits if extended.
        length: data bytes, at most.
        period_ns: between two of them, but for the jitter.
        jitter_ns: how much later than it was due one may be queued; of a sporadic message how far
            a burst runs ahead of the period.
        irregular_ns: how much closer than period and jitter allow they came now and then: for all
            others more jitter; it is not itself late by it.
        distance_ns: never closer than this, whatever the jitter; 0: nothing is known of that.
        deadline_ns: how long it may take, from when it was due (of a sporadic one: was queued);
            None: nobody says.
        name: what it is, in words; "": nothing is known.
        sender: whose; "": nobody else's, as if its node sent nothing else.
        fd, switched: a CAN FD frame; with a bit rate switch.
        arrival: how it comes.
        movable: another identifier can be given to it.
        source: where this was learnt, in words.
        bits: the length that none exceeds, where payloads are known; None: the longest there is.
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
        """Its identifier, as everywhere here."""
        return f"{self.identifier:08X}h" if self.extended else f"{self.identifier:03X}h"

    @property
    def rank(self) -> int:
        """The lower wins arbitration (ISO 11898-1: of equal base identifiers the 11-bit one)."""
        return rank_of(self.identifier, extended=self.extended)

    @property
    def longest(self) -> Bits:
        """The length that it has at most."""
        if self.bits is not None:
            return self.bits
        return longest(self.length, extended=self.extended, fd=self.fd, switched=self.switched)

    @property
    def shortest(self) -> Bits:
        """The length that it has at least, with all of its data."""
        return shortest(self.length, extended=self.extended, fd=self.fd, switched=self.switched)


def rank_of(identifier: int, *, extended: bool) -> int:
    """Orders identifiers by priority: the lower wins arbitration."""
    if not extended:
        return identifier << _SHIFT_EFF + 1
    rest = identifier & (1 << _SHIFT_EFF) - 1
    return (identifier >> _SHIFT_EFF) << _SHIFT_EFF + 1 | 1 << _SHIFT_EFF | rest


@final
@dataclass(frozen=True, slots=True)
class BusLoad:
    """All that is sent on one bus.

    Attributes:
        name: of the bus.
        bitrate_bit_s: the nominal bit rate; data_bitrate_bit_s: of CAN FD, None: as the nominal.
        messages: of no two of them the identifier is the same.
        fifo: senders whose messages wait in one queue, first in, first out; all others send their
            most urgent one first.
    """

    name: str
    bitrate_bit_s: int
    messages: tuple[Message, ...]
    data_bitrate_bit_s: int | None = None
    fifo: frozenset[str] = frozenset()

    def takes_ns(self, message: Message) -> int:
        """How long one takes at most [ns]."""
        return message.longest.time_ns(self.bitrate_bit_s, self.data_bitrate_bit_s)

    def utilisation(self) -> float:
        """The share of the bus that the messages take, all with the most stuff bits."""
        return sum(self.takes_ns(one) / one.period_ns for one in self.messages)

    def utilisation_unstuffed(self) -> float:
        """The same with no stuff bits."""
        rates = self.bitrate_bit_s, self.data_bitrate_bit_s
        return sum(one.shortest.time_ns(*rates) / one.period_ns for one in self.messages)
