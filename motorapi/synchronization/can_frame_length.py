"""Longest and shortest CAN frames on the wire, for a number of data bytes.

Classical frames: 34 bits (11-bit identifier) or 54 (29-bit) and the data are subject to stuffing,
one bit after five and then one after every four; 13 bits are never stuffed. Source: Davis, Burns,
Bril & Lukkien 2007, section 3; can-utils canframelen.c. No classical frame attains the bound: IDE
and r0 (and r1 in extended frames) break the pattern with the most stuff bits.

CAN FD (ISO 11898-1:2015): header and data are stuffed, the CRC has fixed stuff bits. With a bit
rate switch, the bits from ESI to the CRC are sent at the data rate. As many stuff bits as possible
are counted before the switch, where they cost most. A run of five that ends with FDF, res or BRS
does not exist. Source: Linux include/linux/can/length.h.

Durations are integer nanoseconds, rounded up.
"""

from typing import Final, final

from motorhil.frozen import frozen

INTERMISSION_BITS: Final = 3
_STUFFED: Final = (34, 54)  # SOF to CRC without data
_TAIL_BITS: Final = 13  # CRC delimiter, ACK, its delimiter, end of frame, intermission
_FD_HEAD: Final = (22, 41)  # SOF to DLC
_FD_BEFORE_SWITCH: Final = (17, 36)  # SOF to BRS
_FD_STUFF_BEFORE: Final = (3, 8)  # at most, up to RRS
_FD_SHORT: Final = 16  # data bytes up to which the CRC has 17 bits
_FD_CRC_BITS: Final = (27, 32)  # stuff count, CRC-17 or CRC-21, fixed stuff bits


@final
@frozen
class Bits:
    """The length of a frame with its intermission, in bits at the nominal and the data rate."""

    nominal: int
    data: int = 0

    def time_ns(self, bitrate_bit_s: int, data_bitrate_bit_s: int | None = None) -> int:
        """Return the duration of the frame; without a data rate, all bits are nominal [ns]."""
        if data_bitrate_bit_s is None:
            return bits_ns(self.nominal + self.data, bitrate_bit_s)
        return bits_ns(self.nominal, bitrate_bit_s) + bits_ns(self.data, data_bitrate_bit_s)


def bits_ns(bits: int, bitrate_bit_s: int) -> int:
    """Return the duration of a number of bits [ns], rounded up."""
    return -(-bits * 1_000_000_000 // bitrate_bit_s)


def longest(
    length: int, *, extended: bool = False, fd: bool = False, switched: bool = False
) -> Bits:
    """Return the length with the most stuff bits; `switched`: FD with a bit rate switch."""
    return _frame(length, extended, fd, switched, stuffed=True)


def shortest(
    length: int, *, extended: bool = False, fd: bool = False, switched: bool = False
) -> Bits:
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
