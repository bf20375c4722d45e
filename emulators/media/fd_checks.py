"""CAN FD frame checks: stuff bits, stuff count, CRC-17 and CRC-21.

From start of frame to the end of the data, an inverse bit follows five equal bits. At the end of
the data a fixed stuff bit follows instead. This bit is not counted, even after five equal bits.
From there one fixed stuff bit precedes every four bits of stuff count and CRC. The CRC covers the
stuff count and all bits before it, dynamic stuff bits included, but no fixed ones.

Source: ISO 11898-1:2015, bit stuffing, CRC sequence.
"""

from collections.abc import Sequence
from typing import Final

STUFF_COUNT_BITS: Final = 4
FIXED_EVERY: Final = 5  # one fixed stuff bit, then four others
FD_SHORT_BYTES: Final = 16  # up to so many data bytes the CRC has 17 bits, above that 21

_SHORT: Final = (17, 0x1685B)
_LONG: Final = (21, 0x102899)
_STUFF_RUN: Final = 5
# stuff bits modulo 8, in Gray code, with an even parity bit
_STUFF_COUNTS: Final = (0b0000, 0b0011, 0b0110, 0b0101, 0b1100, 0b1111, 0b1010, 0b1001)


def fd_crc_bits(length: int) -> int:
    """Return the number of CRC bits for this many data bytes."""
    return _SHORT[0] if length <= FD_SHORT_BYTES else _LONG[0]


def fd_field_bits(length: int) -> int:
    """Return the number of bits from the first fixed stuff bit to the end of the CRC."""
    bits = STUFF_COUNT_BITS + fd_crc_bits(length)
    return bits + (bits + FIXED_EVERY - 2) // (FIXED_EVERY - 1)


def stuff(bits: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return the bits with dynamic stuff bits, none after the last, and a mark for each.

    The mark is 1 for a stuff bit, else 0.
    """
    levels: list[int] = []
    stuffed: list[int] = []
    run = 0
    last = 1
    for bit in bits:
        if run == _STUFF_RUN:
            last = 1 - last
            run = 1
            levels.append(last)
            stuffed.append(1)
        run = run + 1 if bit == last else 1
        last = bit
        levels.append(bit)
        stuffed.append(0)
    return levels, stuffed


def fd_check_bits(levels: Sequence[int], stuff_bits: int, length: int) -> tuple[int, int]:
    """Return stuff count and CRC as one number, and its number of bits.

    Args:
        levels: the frame to the end of its data, with its dynamic stuff bits.
        stuff_bits: how many of the levels are stuff bits.
        length: data bytes.
    """
    width, polynomial = _SHORT if length <= FD_SHORT_BYTES else _LONG
    count = _STUFF_COUNTS[stuff_bits & 7]
    crc = 1 << width - 1
    top = width - 1
    mask = (1 << width) - 1
    for level in levels:
        crc = (crc << 1 ^ (polynomial if crc >> top ^ level else 0)) & mask
    for shift in range(STUFF_COUNT_BITS - 1, -1, -1):
        crc = (crc << 1 ^ (polynomial if crc >> top ^ count >> shift & 1 else 0)) & mask
    return count << width | crc, STUFF_COUNT_BITS + width
