"""What the sender of a frame puts on the wire, bit after bit, and where in the frame each bit is.

Source: ISO 11898-1, frame formats, CRC sequence, bit stuffing.
"""

from typing import Final, final

from emulators.media.can_bits import measure
from emulators.media.can_frame import EFF_FLAG, EFF_MASK, RTR_FLAG, can_id_of, data_of
from emulators.media.error_message import (
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

DOMINANT: Final = 0
RECESSIVE: Final = 1
STUFF_RUN: Final = 5  # so many equal bits, then one of the other value

# Where the bits before the data are, by their number among those not stuffed.
_BASE_PLACES: Final = (
    *(START_OF_FRAME,) * 1,
    *(ID_28_21,) * 8,
    *(ID_20_18,) * 3,
    *(SRTR, IDE, RESERVED_0),
    *(DLC,) * 4,
)
_EXTENDED_PLACES: Final = (
    *_BASE_PLACES[:14],
    *(ID_17_13,) * 5,
    *(ID_12_5,) * 8,
    *(ID_4_0,) * 5,
    *(RTR, RESERVED_1, RESERVED_0),
    *(DLC,) * 4,
)
_TAIL_PLACES: Final = (CRC_DELIMITER, ACK_SLOT, ACK_DELIMITER, *(END_OF_FRAME,) * 7)
_CRC_BITS: Final = 15
_POLYNOMIAL: Final = 0x4599
_FRAMES_KEPT: Final = 256  # then all are forgotten; a bound on memory, 0.2 MB at most


def place_of(number: int, extended: bool, crc_start: int) -> int:
    """Where (`error_message`) the bit with this number, stuff bits not counted, is.

    Args:
        number: from start of frame = 0 to the end of the CRC sequence.
        extended: the identifier has 29 bits.
        crc_start: the number of the first bit of the CRC sequence; above `number` if not known.
    """
    places = _EXTENDED_PLACES if extended else _BASE_PLACES
    if number < len(places):
        return places[number]
    return DATA if number < crc_start else CRC_SEQUENCE


def tail_place(number: int) -> int:
    """Where the bit with this number after the CRC sequence is."""
    return _TAIL_PLACES[number]


def crc_of(value: int, bits: int) -> int:
    """The CRC-15 of so many bits, the first one most significant."""
    crc = 0
    for shift in range(bits - 1, -1, -1):
        crc = (crc << 1 ^ (_POLYNOMIAL if crc >> 14 ^ value >> shift & 1 else 0)) & 0x7FFF
    return crc


@final
class WireFrame:
    """A frame as its sender sends it, from start of frame to end of frame.

    Attributes (read only; all by the bit's number on the wire, stuff bits counted):
        levels: what is sent.
        expected: what is read back if all is well; they differ in the ACK slot.
        places: where the bit is (`error_message`); a stuff bit is where the bit before it is.
        stuffed: 1 for a stuff bit.
        arbitration_end: the last bit of the arbitration field, RTR.

    Raises:
        ValueError: as of `can_bits.measure`.
    """

    def __init__(self, frame: bytes) -> None:
        measure(frame)
        bits, places, rtr = _unstuffed(frame)
        levels = bytearray()
        where = bytearray()
        stuffed = bytearray()
        run = 0
        last = RECESSIVE
        self.arbitration_end = 0
        for number, bit in enumerate(bits):
            run = run + 1 if bit == last else 1
            last = bit
            if number == rtr:
                self.arbitration_end = len(levels)
            levels.append(bit)
            where.append(places[number])
            stuffed.append(0)
            if run == STUFF_RUN:
                last = 1 - bit
                run = 1
                levels.append(last)
                where.append(places[number])
                stuffed.append(1)
        tail = len(_TAIL_PLACES)
        self.levels = bytes(levels) + bytes([RECESSIVE]) * tail
        self.expected = bytes(levels) + bytes([RECESSIVE, DOMINANT]) + bytes([RECESSIVE]) * 8
        self.places = bytes(where) + bytes(_TAIL_PLACES)
        self.stuffed = bytes(stuffed) + bytes(tail)


_frames: Final[dict[bytes, WireFrame]] = {}


def wire_frame(frame: bytes) -> WireFrame:
    """The frame's bits; remembered.

    Raises:
        ValueError: as of `can_bits.measure`.
    """
    known = _frames.get(frame)
    if known is None:
        if len(_frames) >= _FRAMES_KEPT:
            _frames.clear()
        known = _frames[frame] = WireFrame(frame)
    return known


def _unstuffed(frame: bytes) -> tuple[list[int], list[int], int]:
    """The bits from start of frame to the end of the CRC, where they are, the number of RTR."""
    can_id = can_id_of(frame)
    identifier = can_id & EFF_MASK
    remote = 1 if can_id & RTR_FLAG else 0
    extended = bool(can_id & EFF_FLAG)
    if extended:
        value = identifier >> 18 << 21 | 0b11 << 19 | (identifier & 0x3FFFF) << 1 | remote
        value <<= 2  # r1, r0
        rtr = 32
    else:
        value = (identifier << 1 | remote) << 2  # IDE, r0
        rtr = 12
    value = value << 4 | frame[4]
    data = data_of(frame)
    for byte in data:
        value = value << 8 | byte
    crc_start = (rtr + 7) + 8 * len(data)
    count = crc_start + _CRC_BITS
    value = value << _CRC_BITS | crc_of(value, crc_start)
    bits = [value >> shift & 1 for shift in range(count - 1, -1, -1)]
    return bits, [place_of(number, extended, crc_start) for number in range(count)], rtr
