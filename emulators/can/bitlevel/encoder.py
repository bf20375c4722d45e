"""Bit sequence of a CAN frame on the wire.

CAN FD frames have stuff bits, a stuff count, and CRC-17 or CRC-21 as follows. From start of frame
to the end of the data, an inverse bit follows five equal bits. At the end of the data a fixed stuff
bit follows instead. This bit is not counted, even after five equal bits. From there one fixed stuff
bit precedes every four bits of stuff count and CRC. The CRC covers the stuff count and all bits
before it, dynamic stuff bits included, but no fixed ones.

Source: ISO 11898-1:2015, frame formats, bit stuffing, CRC sequence.
"""

from collections.abc import Sequence
from typing import Final, final

from motorhil.emulators.can.error_confinement import (
    ACK_DELIMITER,
    ACK_SLOT,
    CRC_DELIMITER,
    CRC_SEQUENCE,
    DATA,
    DLC,
    END_OF_FRAME,
    ID_4_0,
    ID_12_5,
    ID_17_13,
    ID_20_18,
    ID_28_21,
    IDE,
    RESERVED_0,
    RESERVED_1,
    RTR,
    SRTR,
    START_OF_FRAME,
)
from motorhil.emulators.can.frame import (
    BRS,
    EFF_FLAG,
    EFF_MASK,
    ERR_FLAG,
    ESI,
    FD_FRAME_BYTES,
    FD_LENGTHS,
    RTR_FLAG,
    can_id_of,
    data_of,
    pack_fd,
)
from motorhil.emulators.can.frame_length import measure

STUFF_COUNT_BITS: Final = 4
FIXED_EVERY: Final = 5  # one fixed stuff bit, then four others
FD_SHORT_BYTES: Final = 16  # up to so many data bytes the CRC has 17 bits, above that 21

_SHORT: Final = (17, 0x1685B)
_LONG: Final = (21, 0x102899)
_STUFF_RUN: Final = 5
# stuff bits modulo 8, in Gray code, with an even parity bit
_STUFF_COUNTS: Final = (0b0000, 0b0011, 0b0110, 0b0101, 0b1100, 0b1111, 0b1010, 0b1001)

DOMINANT: Final = 0
RECESSIVE: Final = 1
STUFF_RUN: Final = 5  # so many equal bits, then an inverse stuff bit

# Places of the bits before the data, by their number without stuff bits.
_IDENTIFIER: Final[tuple[int, ...]] = (
    *(START_OF_FRAME,) * 1,
    *(ID_28_21,) * 8,
    *(ID_20_18,) * 3,
    SRTR,
    IDE,
)
_EXTENSION: Final[tuple[int, ...]] = (*(ID_17_13,) * 5, *(ID_12_5,) * 8, *(ID_4_0,) * 5, RTR)
_DLC: Final[tuple[int, ...]] = (DLC,) * 4
_FD_CONTROL: Final[tuple[int, ...]] = (*(RESERVED_0,) * 3, *_DLC)  # res, BRS, ESI
_BASE_PLACES: Final[tuple[int, ...]] = (*_IDENTIFIER, RESERVED_0, *_DLC)
_EXTENDED_PLACES: Final[tuple[int, ...]] = (
    *_IDENTIFIER,
    *_EXTENSION,
    RESERVED_1,
    RESERVED_0,
    *_DLC,
)
_FD_BASE_PLACES: Final[tuple[int, ...]] = (*_IDENTIFIER, RESERVED_0, *_FD_CONTROL)
_FD_EXTENDED_PLACES: Final[tuple[int, ...]] = (*_IDENTIFIER, *_EXTENSION, RESERVED_1, *_FD_CONTROL)
_TAIL_PLACES: Final = (CRC_DELIMITER, ACK_SLOT, ACK_DELIMITER, *(END_OF_FRAME,) * 7)

_RTR: Final = 12
_EXTENDED_RTR: Final = 32
_CRC_BITS: Final = 15
_POLYNOMIAL: Final = 0x4599
_FRAMES_KEPT: Final = 256  # then the cache is cleared; bounds memory to 0.7 MB


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


def place_of(number: int, extended: bool, crc_start: int, fd: bool = False) -> int:
    """Return the place (`error_message`) of the bit with this number, stuff bits not counted.

    Args:
        number: from start of frame = 0 to the end of the CRC sequence.
        extended: the identifier has 29 bits.
        crc_start: the number of the first bit of the CRC sequence, in CAN FD of the stuff count;
            above `number` if not known.
        fd: it is a CAN FD frame.
    """
    if fd:
        places = _FD_EXTENDED_PLACES if extended else _FD_BASE_PLACES
    else:
        places = _EXTENDED_PLACES if extended else _BASE_PLACES
    if number < len(places):
        return places[number]
    return DATA if number < crc_start else CRC_SEQUENCE


def tail_place(number: int) -> int:
    """Return the place of the bit with this number after the CRC sequence."""
    return _TAIL_PLACES[number]


def crc_of(value: int, bits: int) -> int:
    """Return the CRC-15 of so many bits, the first one most significant."""
    crc = 0
    for shift in range(bits - 1, -1, -1):
        crc = (crc << 1 ^ (_POLYNOMIAL if crc >> 14 ^ value >> shift & 1 else 0)) & 0x7FFF
    return crc


def bits_of(value: int, count: int) -> list[int]:
    """Return so many bits of a number, the most significant first."""
    return [value >> shift & 1 for shift in range(count - 1, -1, -1)]


@final
class WireFrame:
    """A frame as its sender sends it, from start of frame to end of frame.

    Attributes (read only; all by the bit's number on the wire, stuff bits counted):
        levels: the levels sent.
        expected: the levels read back without errors; they differ in the ACK slot.
        places: the place of the bit (`error_message`); a stuff bit has that of the bit before it.
        stuffed: 1 for a stuff bit.
        arbitration_end: the last bit of the arbitration field, RTR.
        is_fd: it is a CAN FD frame.
        fast_from: the first bit that counts as one at the data rate, the one after BRS.
        fast_to: the first bit after those, behind the CRC delimiter; `fast_from` if there are none.

    Raises:
        ValueError: as for `frame_length.measure`, or for `pack_fd`.
    """

    def __init__(self, frame: bytes) -> None:
        fd = len(frame) == FD_FRAME_BYTES
        header, width, rtr = _fd_header(frame) if fd else _classical_header(frame)
        data = data_of(frame)
        crc_start = width + 8 * len(data)
        value = header << 8 * len(data) | int.from_bytes(data, "big")
        if fd:
            levels, stuffed = stuff(bits_of(value, crc_start))
        else:
            value = value << _CRC_BITS | crc_of(value, crc_start)
            levels, stuffed = stuff(bits_of(value, crc_start + _CRC_BITS))
            if len(set(levels[-STUFF_RUN:])) == 1:
                levels.append(1 - levels[-1])
                stuffed.append(1)
        positions = [position for position, is_stuff in enumerate(stuffed) if not is_stuff]
        if fd:
            _append_fd_checks(levels, stuffed, len(data))
        places = bytearray()
        number = -1
        for is_stuff in stuffed:
            number += 1 - is_stuff
            places.append(place_of(number, rtr == _EXTENDED_RTR, crc_start, fd))
        self.is_fd = fd
        self.levels: bytes = bytes(levels) + bytes([RECESSIVE]) * len(_TAIL_PLACES)
        self.expected: bytes = bytes(levels) + bytes([RECESSIVE, DOMINANT]) + bytes([RECESSIVE]) * 8
        self.places: bytes = bytes(places) + bytes(_TAIL_PLACES)
        self.stuffed: bytes = bytes(stuffed) + bytes(len(_TAIL_PLACES))
        self.arbitration_end: int = positions[rtr]
        fast = fd and frame[5] & BRS
        # ESI is the fifth bit after RTR; a stuff bit before it is already sent at the data rate.
        self.fast_from: int = positions[width - 6] + 1 if fast else 0
        self.fast_to: int = len(levels) + 1 if fast else 0


_frames: Final[dict[bytes, WireFrame]] = {}


def wire_frame(frame: bytes) -> WireFrame:
    """Return the frame's bits, cached.

    Raises:
        ValueError: as for `WireFrame`.
    """
    known = _frames.get(frame)
    if known is None:
        if len(_frames) >= _FRAMES_KEPT:
            _frames.clear()
        known = _frames[frame] = WireFrame(frame)
    return known


def _classical_header(frame: bytes) -> tuple[int, int, int]:
    """Return start of frame to DLC as a number, its number of bits, and the number of RTR."""
    measure(frame)
    can_id = can_id_of(frame)
    if can_id & EFF_FLAG:  # r1, r0
        return _extended_identifier(can_id) << 6 | frame[4], _EXTENDED_RTR + 7, _EXTENDED_RTR
    return _base_identifier(can_id) << 6 | frame[4], _RTR + 7, _RTR  # IDE, r0


def _fd_header(frame: bytes) -> tuple[int, int, int]:
    """Return the header of a CAN FD frame as `_classical_header` does."""
    can_id = can_id_of(frame)
    if can_id & ERR_FLAG:
        raise ValueError("an error message (ERR_FLAG) is for a node, not for the bus")
    pack_fd(can_id, data_of(frame))
    # FDF, res, BRS, ESI, DLC; a base frame has IDE before them
    control = 0b1000 | (0b10 if frame[5] & BRS else 0) | (0b01 if frame[5] & ESI else 0)
    control = control << 4 | FD_LENGTHS.index(frame[4])
    if can_id & EFF_FLAG:
        return _extended_identifier(can_id) << 8 | control, _EXTENDED_RTR + 9, _EXTENDED_RTR
    return _base_identifier(can_id) << 9 | control, _RTR + 10, _RTR


def _base_identifier(can_id: int) -> int:
    """Return the bits from start of frame to RTR of a base frame."""
    return (can_id & EFF_MASK) << 1 | (1 if can_id & RTR_FLAG else 0)


def _extended_identifier(can_id: int) -> int:
    """Return the bits from start of frame to RTR of an extended frame."""
    identifier = can_id & EFF_MASK
    base = identifier >> 18 << 2 | 0b11  # SRR, IDE
    return base << 19 | (identifier & 0x3FFFF) << 1 | (1 if can_id & RTR_FLAG else 0)


def _append_fd_checks(levels: list[int], stuffed: list[int], length: int) -> None:
    """Append stuff count and CRC with their fixed stuff bits after the data."""
    checks, count = fd_check_bits(levels, sum(stuffed), length)
    for number, bit in enumerate(bits_of(checks, count)):
        if not number % (FIXED_EVERY - 1):
            levels.append(1 - levels[-1])
            stuffed.append(1)
        levels.append(bit)
        stuffed.append(0)
