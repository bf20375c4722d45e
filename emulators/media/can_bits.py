"""How many bits a classical CAN frame is on the wire, and who wins arbitration with it.

From start of frame to the end of the CRC sequence, after five equal bits the sender inserts one of
the other value, which itself begins a new run; the run that ends with the CRC's last bit counts.
CRC delimiter, ACK slot, ACK delimiter, end of frame (7) and intermission (3) are never stuffed.

Stuffing is a machine of eight states (last bit, length of the run 1..4), so one table look-up
advances it by a whole byte, and another one the CRC. The header (identifier, flags, length) is
remembered with the state it leads to: a node sends few different ones.

Source: ISO 11898-1, bit stuffing and frame formats; CRC-15 polynomial 4599h. Bounds: Davis, Burns,
Bril & Lukkien, Controller Area Network schedulability analysis (2007).
"""

from typing import Final

from emulators.media.can_frame import (
    EFF_FLAG,
    EFF_MASK,
    ERR_FLAG,
    FRAME_BYTES,
    RTR_FLAG,
    SFF_MASK,
    can_id_of,
)

INTERMISSION_BITS: Final = 3
KEY_SHIFT: Final = 30  # `measure` answers key << KEY_SHIFT | lengths (`can_port`)

_BITS: Final = (1 << KEY_SHIFT) - 1
_POLYNOMIAL: Final = 0x4599
_TAIL_BITS: Final = 13  # CRC delimiter, ACK slot and delimiter, end of frame, intermission
_HEADERS_KEPT: Final = 4096  # then all are forgotten; a bound on memory, 1 MB at most
_FRAMES_KEPT: Final = 8192  # as well, 2 MB at most

# A stuffing state is last bit * 4 + (run - 1), kept shifted by 8 so that a byte fits below it.
# Table entries: stuff bits inserted << 16 | next state << 8. Up to 20 of them can be added up
# before the states reach the counts.
_STATE: Final = 0x700


def _stuff_table(width: int) -> list[int]:
    """For state << width | value: what the `width` bits of value, most significant first, do."""
    table: list[int] = []
    for state in range(8):
        for value in range(1 << width):
            entry = state << 8
            for shift in range(width - 1, -1, -1):
                entry = (entry & ~_STATE) + _stuff(entry & _STATE, value >> shift & 1)
            table.append(entry)
    return table


def _stuff(state: int, bit: int) -> int:
    """What one bit does, as a table entry."""
    last = state >> 10
    run = (state >> 8 & 3) + 2 if bit == last else 1
    if run == 5:
        return 1 << 16 | (1 - bit) << 10
    return bit << 10 | (run - 1) << 8


def _crc_table() -> list[int]:
    """For a byte: the CRC register after it, from an empty register."""
    table: list[int] = []
    for value in range(256):
        register = value << 7
        for _ in range(8):
            register = register << 1 ^ (_POLYNOMIAL if register & 0x4000 else 0)
        table.append(register & 0x7FFF)
    return table


_STUFF: Final = _stuff_table(8)
_STUFF_7: Final = _stuff_table(7)
_CRC: Final = _crc_table()

# The first five bytes of a frame -> (key << KEY_SHIFT | bits without stuffing, where the data end
# in the frame, CRC register, stuffing state, stuff bits << 16).
_headers: Final[dict[bytes, tuple[int, int, int, int, int]]] = {}
# What `measure` answered to whole frames: heartbeats, questions and a status at rest come again.
_frames: Final[dict[bytes, int]] = {}


def length_bits(frame: bytes) -> int:
    """Exact bits of a classical frame from its first to its last, without the intermission.

    Raises:
        ValueError: as of `measure`.
    """
    return (measure(frame) & _BITS) - INTERMISSION_BITS


def measure(frame: bytes) -> int:
    """Arbitration key << KEY_SHIFT | exact bits incl. intermission, of a classical frame.

    Raises:
        ValueError: not a 16-byte can_frame, an error message, an identifier that its format has
            no room for, or a length above 8.
    """
    known = _frames.get(frame)
    if known is not None:
        return known
    if len(frame) != FRAME_BYTES:
        raise ValueError(f"a classical CAN frame has {FRAME_BYTES} bytes here, not {len(frame)}")
    header = _headers.get(frame[:5])
    if header is None:
        header = _measure_header(frame)
    measured, end, crc, state, total = header
    for byte in frame[8:end]:
        crc = _CRC[crc >> 7 ^ byte] ^ crc << 8 & 0x7FFF
        entry = _STUFF[state | byte]
        total += entry
        state = entry & _STATE
    entry = _STUFF[state | crc >> 7]
    total += entry + _STUFF_7[(entry & _STATE) >> 1 | crc & 0x7F]
    if len(_frames) >= _FRAMES_KEPT:
        _frames.clear()
    known = _frames[frame] = measured + (total >> 16)
    return known


def frame_bits(frame: bytes) -> int:
    """Exact length on the wire incl. stuff bits and the 3 bits of intermission.

    Raises:
        ValueError: as `measure`.
    """
    return measure(frame) & _BITS


def arbitration_key(frame: bytes) -> int:
    """The arbitration field as a number: the lower one wins the bus. 32 bits.

    At equal 11 bits a base data frame beats a base remote frame beats any extended frame.
    No two kinds of frame share a key.

    Raises:
        ValueError: as `measure`.
    """
    return measure(frame) >> KEY_SHIFT


def can_id_of_key(key: int) -> int:
    """The can_id (identifier and flags) whose arbitration key this is."""
    if key & 1 << 19:  # IDE
        can_id = key >> 21 << 18 | key >> 1 & 0x3FFFF | EFF_FLAG
        return can_id | RTR_FLAG if key & 1 else can_id
    return key >> 21 | (RTR_FLAG if key & 1 << 20 else 0)


def _measure_header(frame: bytes) -> tuple[int, int, int, int, int]:
    """What `measure` remembers of an identifier, its flags and a length; checks them."""
    can_id = can_id_of(frame)
    length = frame[4]
    if can_id & ERR_FLAG:
        raise ValueError("an error message (ERR_FLAG) is for a node, not for the bus")
    if length > 8:
        raise ValueError(f"a classical CAN frame has 0..8 bytes of data, not {length}")
    remote = 1 if can_id & RTR_FLAG else 0
    identifier = can_id & EFF_MASK
    if can_id & EFF_FLAG:
        # identifier 28..18, SRR, IDE, identifier 17..0, RTR; then r1, r0, DLC; SOF is a leading 0
        key = identifier >> 18 << 21 | 0b11 << 19 | (identifier & 0x3FFFF) << 1 | remote
        bits = key << 6 | length
        width = 39
    else:
        if identifier > SFF_MASK:
            raise ValueError(f"identifier {identifier:X}h has more than 11 bits; set EFF_FLAG")
        key = identifier << 21 | remote << 20  # identifier, RTR, IDE = 0; then r0, DLC
        bits = key >> 19 << 5 | length
        width = 19
    crc = 0
    entry = 0b100 << 8  # "a recessive bit before": the dominant start of frame begins a run
    total = 0
    for shift in range(width - 1, -1, -1):
        bit = bits >> shift & 1
        entry = _stuff(entry & _STATE, bit)
        total += entry
        crc = (crc << 1 ^ (_POLYNOMIAL if crc >> 14 ^ bit else 0)) & 0x7FFF
    data_bytes = 0 if remote else length
    unstuffed = width + 8 * data_bytes + 15 + _TAIL_BITS
    header = (key << KEY_SHIFT | unstuffed, 8 + data_bytes, crc, entry & _STATE, total & ~0xFFFF)
    if len(_headers) >= _HEADERS_KEPT:
        _headers.clear()
    _headers[frame[:5]] = header
    return header
