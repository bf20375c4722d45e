"""Messages on a bus, as input of the analysis.

Longest and shortest frames on the wire for a number of data bytes.

Classical frames: 34 bits (11-bit identifier) or 54 (29-bit) and the data are subject to stuffing,
one bit after five and then one after every four; 13 bits are never stuffed. Source: Davis, Burns,
Bril & Lukkien 2007, section 3; can-utils canframelen.c. No classical frame attains the bound: IDE
and r0 (and r1 in extended frames) break the pattern with the most stuff bits.

CAN FD (ISO 11898-1:2015): header and data are stuffed, the CRC has fixed stuff bits. With a bit
rate switch, the bits from ESI to the CRC are sent at the data rate. As many stuff bits as possible
are counted before the switch, where they cost most. A run of five that ends with FDF, res or BRS
does not exist. Source: Linux include/linux/can/length.h.
"""

from dataclasses import dataclass
from enum import Enum
from typing import Final, final

INTERMISSION_BITS: Final = 3
FD_LENGTHS: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)
_STUFFED: Final = (34, 54)  # SOF to CRC without data
_TAIL_BITS: Final = 13  # CRC delimiter, ACK, its delimiter, end of frame, intermission
_FD_HEAD: Final = (22, 41)  # SOF to DLC
_FD_BEFORE_SWITCH: Final = (17, 36)  # SOF to BRS
_FD_STUFF_BEFORE: Final = (3, 8)  # at most, up to RRS
_FD_SHORT: Final = 16  # data bytes up to which the CRC has 17 bits
_FD_CRC_BITS: Final = (27, 32)  # stuff count, CRC-17 or CRC-21, fixed stuff bits


@final
@dataclass(frozen=True, slots=True)
class Bits:
    """The length of a frame with its intermission, in bits at the nominal and the data rate."""

    nominal: int
    data: int = 0

    def time_ns(self, bitrate_bit_s: int, data_bitrate_bit_s: int | None = None) -> int:
        """Return the duration of the frame [ns], rounded up."""
        return bits_ns(self.nominal, bitrate_bit_s) + bits_ns(
            self.data, data_bitrate_bit_s or bitrate_bit_s
        )


def bits_ns(bits: int, bitrate_bit_s: int) -> int:
    """Return the duration of a number of bits [ns], rounded up."""
    return -(-bits * 1_000_000_000 // bitrate_bit_s)


def longest(length: int, *, extended: bool, fd: bool = False, switched: bool = False) -> Bits:
    """Return the length with the most stuff bits; `switched`: FD with a bit rate switch."""
    return _frame(length, extended, fd, switched, stuffed=True)


def shortest(length: int, *, extended: bool, fd: bool = False, switched: bool = False) -> Bits:
    """Return the length without stuff bits, except the fixed ones of CAN FD."""
    return _frame(length, extended, fd, switched, stuffed=False)


def _frame(length: int, extended: bool, fd: bool, switched: bool, *, stuffed: bool) -> Bits:
    if not fd:
        bits = _STUFFED[extended] + 8 * length
        return Bits(bits + stuffed * ((bits - 1) // 4) + _TAIL_BITS)
    head = _FD_HEAD[extended] + 8 * length
    stuff = stuffed * ((head - 1) // 4)
    crc = _FD_CRC_BITS[length > _FD_SHORT]
    if not switched:
        return Bits(head + stuff + crc + _TAIL_BITS)
    before = _FD_BEFORE_SWITCH[extended]
    stuff_before = min(stuff, _FD_STUFF_BEFORE[extended])
    return Bits(before + stuff_before + _TAIL_BITS, head - before + stuff - stuff_before + crc)


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
