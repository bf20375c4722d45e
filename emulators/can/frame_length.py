"""Length, bit rates and arbitration keys of CAN frames.

From start of frame to the end of the CRC sequence, the sender inserts one inverse bit after five
equal bits. The stuff bit begins a new run. A run that ends with the last CRC bit counts as well.
CRC delimiter, ACK slot, ACK delimiter, end of frame (7) and intermission (3) are never stuffed.

The stuffing state machine has eight states (last bit, run length 1..4). One table look-up advances
it by a whole byte, another advances the CRC. The header (identifier, flags, length) is cached with
the state it leads to, because a node sends few different headers.

CAN FD is stuffed this way up to its last data bit only, and no dynamic stuff bit follows that bit.
A fixed stuff bit precedes the stuff count and follows every fourth bit from there. The stuff count
(4), CRC-17 (up to 16 bytes) or CRC-21 and their fixed stuff bits (6 or 7) have therefore a constant
length.

With a bit rate switch, the rate changes at the sample point of BRS, and back at the sample point of
the CRC delimiter. Here BRS counts as a nominal bit and the CRC delimiter as a bit at the data rate.
The two errors cancel wherever the sample points are, so the sum is exact (BRS lasts s Tn + (1 - t)
Td and the delimiter t Td + (1 - s) Tn). BRS never ends a run, because FDF and res before it differ:
no stuff bit lies on the border.

Source: ISO 11898-1:2015, bit stuffing, frame formats, bit rate switching; CRC-15 polynomial 4599h.
Bounds: Davis, Burns, Bril & Lukkien, Controller Area Network schedulability analysis (2007); for
CAN FD Linux include/linux/can/length.h.
"""

from typing import Final

from motorhil.emulators.can.frame import (
    BRS,
    EFF_FLAG,
    EFF_MASK,
    ERR_FLAG,
    ESI,
    FD_FRAME_BYTES,
    FD_LENGTHS,
    FRAME_BYTES,
    RTR_FLAG,
    SFF_MASK,
    can_id_of,
)

INTERMISSION_BITS: Final = 3
KEY_SHIFT: Final = 30  # `measure` returns key << KEY_SHIFT | lengths

# Lengths are (bits of an FD frame from ESI to CRC delimiter) << DATA_SHIFT | other bits. The former
# are at the data rate unless NO_SWITCH is set in the latter. Classical frames have none of the
# former.
LENGTHS_MASK: Final = 0x3FFFF
CLASSICAL_MAX: Final = 0xFF  # greater lengths are those of an FD frame
DATA_SHIFT: Final = 8
NO_SWITCH: Final = 0x80
_FD_NOMINAL_MASK: Final = 0x7F

_POLYNOMIAL: Final = 0x4599
_TAIL_BITS: Final = 13  # CRC delimiter, ACK slot and delimiter, end of frame, intermission
_FD_TAIL_BITS: Final = 12  # the same without the CRC delimiter
_FD_SHORT_BYTES: Final = 16
_FD_SHORT_BITS: Final = 28  # stuff count, CRC-17, fixed stuff bits, CRC delimiter
_FD_LONG_BITS: Final = 33  # with CRC-21
_FD_CONTROL_BITS: Final = 5  # ESI, DLC
_HEADERS_KEPT: Final = 4096  # then the cache is cleared; bounds memory to 1 MB
_FRAMES_KEPT: Final = 8192  # likewise; bounds memory to 2 MB

# A stuffing state is last bit * 4 + (run - 1), kept shifted by 8 so that a byte fits below it.
# Table entries: stuff bits inserted << 16 | next state << 8. Up to 20 entries can be added before
# the states overflow into the counts.
_STATE: Final = 0x700

# The first five bytes of a frame -> (key << KEY_SHIFT | bits without stuffing, end of the data in
# the frame, CRC register, stuffing state, stuff bits << 16).
_headers: Final[dict[bytes, tuple[int, int, int, int, int]]] = {}
# The first six bytes of an FD frame -> (key << KEY_SHIFT | lengths without stuff bits of the data,
# end of the data, stuffing state).
_fd_headers: Final[dict[bytes, tuple[int, int, int]]] = {}
# Results of `measure` by whole frame: heartbeats, requests and unchanged status repeat.
_frames: Final[dict[bytes, int]] = {}


def _stuff_table(width: int) -> list[int]:
    """Return the stuffing table, by state << width | value with the most significant bit first."""
    table: list[int] = [state << 8 for state in range(8)]
    for _ in range(width):
        table = [
            (entry & ~_STATE) + _stuff(entry & _STATE, bit) for entry in table for bit in (0, 1)
        ]
    return table


def _stuff(state: int, bit: int) -> int:
    """Return the table entry for one bit in a stuffing state."""
    last = state >> 10
    run = (state >> 8 & 3) + 2 if bit == last else 1
    if run == 5:
        return 1 << 16 | (1 - bit) << 10
    return bit << 10 | (run - 1) << 8


def _last_table() -> list[int]:
    """Return the table, by state << 8 | byte: 1 if a stuff bit follows the byte's last bit."""
    table: list[int] = []
    for entry in range(1 << 11):
        before = _STUFF_7[entry >> 1] & _STATE
        table.append(_stuff(before, entry & 1) >> 16)
    return table


def _crc_table() -> list[int]:
    """Return the table of CRC registers after one byte, from an empty register."""
    table: list[int] = []
    for value in range(256):
        register = value << 7
        for _ in range(8):
            register = register << 1 ^ (_POLYNOMIAL if register & 0x4000 else 0)
        table.append(register & 0x7FFF)
    return table


_STUFF: Final = _stuff_table(8)
_STUFF_7: Final = _stuff_table(7)
_LAST: Final = _last_table()
_CRC: Final = _crc_table()


def length_bits(frame: bytes) -> int:
    """Return the exact number of bits of a frame at either rate, without the intermission.

    Raises:
        ValueError: as for `measure`.
    """
    return frame_bits(frame) - INTERMISSION_BITS


def measure(frame: bytes) -> int:
    """Return arbitration key << KEY_SHIFT | lengths, exact and including intermission.

    Raises:
        ValueError: the frame is neither a 16-byte can_frame nor a 72-byte canfd_frame, is an error
            message, has an identifier or length that its format does not allow, or is a remote
            frame of CAN FD.
    """
    known = _frames.get(frame)
    if known is not None:
        return known
    if len(frame) != FRAME_BYTES:
        return _measure_fd(frame)
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
    """Return the exact length on the wire, including stuff bits and the 3 bits of intermission.

    Raises:
        ValueError: as for `measure`.
    """
    return bits_of(measure(frame) & LENGTHS_MASK)


def bits_of(lengths: int) -> int:
    """Return the total number of bits of these lengths, at either rate."""
    if lengths > CLASSICAL_MAX:
        return (lengths >> DATA_SHIFT) + (lengths & _FD_NOMINAL_MASK)
    return lengths


def phases_of(lengths: int) -> tuple[int, int]:
    """Return (bits at the nominal rate, bits at the data rate)."""
    if lengths > CLASSICAL_MAX and not lengths & NO_SWITCH:
        return lengths & _FD_NOMINAL_MASK, lengths >> DATA_SHIFT
    return bits_of(lengths), 0


def arbitration_key(frame: bytes) -> int:
    """Return the arbitration field as a 32-bit number; the lower number wins the bus.

    With equal 11 bits a base data frame beats a base remote frame, which beats any extended frame.
    No two kinds of frame share a key.

    Raises:
        ValueError: as for `measure`.
    """
    return measure(frame) >> KEY_SHIFT


def can_id_of_key(key: int) -> int:
    """Return the can_id (identifier and flags) that has this arbitration key."""
    if key & 1 << 19:  # IDE
        can_id = key >> 21 << 18 | key >> 1 & 0x3FFFF | EFF_FLAG
        return can_id | RTR_FLAG if key & 1 else can_id
    return key >> 21 | (RTR_FLAG if key & 1 << 20 else 0)


def _measure_fd(frame: bytes) -> int:
    """Measure a frame that is not classical and not cached, as `measure` does."""
    if len(frame) != FD_FRAME_BYTES:
        raise ValueError(
            f"a CAN frame has {FRAME_BYTES} bytes here, or {FD_FRAME_BYTES} in CAN FD, not "
            f"{len(frame)}"
        )
    header = _fd_headers.get(frame[:6])
    if header is None:
        header = _measure_fd_header(frame)
    measured, end, state = header
    stuff_bits = 0
    entry = 0
    for byte in frame[8:end]:
        entry = state | byte
        found = _STUFF[entry]
        stuff_bits += found >> 16
        state = found & _STATE
    if end > 8:
        stuff_bits -= _LAST[entry]
    if len(_frames) >= _FRAMES_KEPT:
        _frames.clear()
    known = _frames[frame] = measured + (stuff_bits << DATA_SHIFT)
    return known


def _key_of(can_id: int) -> int:
    """Check the identifier and return the arbitration field."""
    if can_id & ERR_FLAG:
        raise ValueError("an error message (ERR_FLAG) is for a node, not for the bus")
    remote = 1 if can_id & RTR_FLAG else 0
    identifier = can_id & EFF_MASK
    if can_id & EFF_FLAG:
        # identifier 28..18, SRR, IDE, identifier 17..0, RTR
        return identifier >> 18 << 21 | 0b11 << 19 | (identifier & 0x3FFFF) << 1 | remote
    if identifier > SFF_MASK:
        raise ValueError(f"identifier {identifier:X}h has more than 11 bits; set EFF_FLAG")
    return identifier << 21 | remote << 20  # identifier, RTR, IDE = 0


def _measure_fd_header(frame: bytes) -> tuple[int, int, int]:
    """Check an identifier, length and flags and return the header that `_measure_fd` caches."""
    can_id = can_id_of(frame)
    length = frame[4]
    key = _key_of(can_id)
    if length not in FD_LENGTHS:
        raise ValueError(f"{length} bytes of data: a CAN FD frame has 0..8, 12, 16, ... or 64")
    if can_id & RTR_FLAG:
        raise ValueError("there is no remote frame in CAN FD")
    switch = frame[5] & BRS
    # FDF, res, BRS, and ESI, DLC; SOF is a leading 0
    arbitration, width = (key, 33) if can_id & EFF_FLAG else (key >> 19, 14)
    bits = arbitration << 3 | (0b101 if switch else 0b100)
    bits = bits << 5 | (0b10000 if frame[5] & ESI else 0) | FD_LENGTHS.index(length)
    width += 3
    entry = 0b100 << 8  # preset to a recessive bit: the dominant start of frame begins a run
    stuff_bits = [0, 0]
    for shift in range(width + _FD_CONTROL_BITS - 1, -1, -1):
        entry = _stuff(entry & _STATE, bits >> shift & 1)
        if shift or length:
            stuff_bits[shift < _FD_CONTROL_BITS] += entry >> 16
    checks = _FD_SHORT_BITS if length <= _FD_SHORT_BYTES else _FD_LONG_BITS
    nominal = width + stuff_bits[0] + _FD_TAIL_BITS + (0 if switch else NO_SWITCH)
    data = _FD_CONTROL_BITS + stuff_bits[1] + 8 * length + checks
    header = (key << KEY_SHIFT | data << DATA_SHIFT | nominal, 8 + length, entry & _STATE)
    if len(_fd_headers) >= _HEADERS_KEPT:
        _fd_headers.clear()
    _fd_headers[frame[:6]] = header
    return header


def _measure_header(frame: bytes) -> tuple[int, int, int, int, int]:
    """Check an identifier, flags and length and return the header that `measure` caches."""
    can_id = can_id_of(frame)
    length = frame[4]
    key = _key_of(can_id)
    if length > 8:
        raise ValueError(f"a classical CAN frame has 0..8 bytes of data, not {length}")
    # then r1, r0, DLC, or after IDE = 0: r0, DLC; SOF is a leading 0
    bits, width = (key << 6 | length, 39) if can_id & EFF_FLAG else (key >> 19 << 5 | length, 19)
    crc = 0
    entry = 0b100 << 8  # preset to a recessive bit: the dominant start of frame begins a run
    total = 0
    for shift in range(width - 1, -1, -1):
        bit = bits >> shift & 1
        entry = _stuff(entry & _STATE, bit)
        total += entry
        crc = (crc << 1 ^ (_POLYNOMIAL if crc >> 14 ^ bit else 0)) & 0x7FFF
    data_bytes = 0 if can_id & RTR_FLAG else length
    unstuffed = width + 8 * data_bytes + 15 + _TAIL_BITS
    header = (key << KEY_SHIFT | unstuffed, 8 + data_bytes, crc, entry & _STATE, total & ~0xFFFF)
    if len(_headers) >= _HEADERS_KEPT:
        _headers.clear()
    _headers[frame[:5]] = header
    return header
