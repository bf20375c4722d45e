"""CAN frames at every seam: Linux `can_frame` (16 bytes), `canfd_frame` (72 bytes).

Layout, little endian: can_id (32 bits), length (8 bits), 3 bytes of padding, data (8 bytes, the
unused ones zero). The identifier is in the low 29 bits of can_id, the flags above it. A remote
frame keeps its DLC in length and carries no data.

A CAN FD frame (`struct canfd_frame`) is recognised by its size alone. The first padding byte holds
its flags, the data have up to 64 bytes, and only the lengths of `FD_LENGTHS` exist.

Source: Linux include/uapi/linux/can.h.
"""

from struct import Struct
from typing import Final

FRAME_BYTES: Final = 16
EFF_FLAG: Final = 0x8000_0000
"""Flag of a can_id: extended frame format, an identifier of 29 bits."""
RTR_FLAG: Final = 0x4000_0000
"""Flag of a can_id: remote transmission request."""
ERR_FLAG: Final = 0x2000_0000
"""Flag of a can_id: error message of the controller, never on a bus."""
SFF_MASK: Final = 0x7FF
EFF_MASK: Final = 0x1FFF_FFFF

FD_FRAME_BYTES: Final = 72
"""The size of a canfd_frame [bytes]."""
BRS: Final = 0x01
"""Flag of an FD frame: bit rate switch."""
ESI: Final = 0x02  # the sender is error passive
FDF: Final = 0x04  # marks an FD frame; not every program sets it
FD_LENGTHS: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""The lengths that the data of an FD frame can have, by DLC [bytes]."""

_FRAME: Final = Struct("<IB3x8s")
_FD_FRAME: Final = Struct("<IBB2x64s")


def pack(can_id: int, data: bytes = b"") -> bytes:
    """Return the frame with this can_id (identifier and flags) and 0..8 bytes of data.

    Raises:
        ValueError: more than 8 bytes, or an identifier that does not fit its format.
    """
    if len(data) > 8:
        raise ValueError(
            f"classical CAN frame: {len(data)} bytes of data do not fit; the limit is 8"
        )
    if not can_id & EFF_FLAG and can_id & EFF_MASK & ~SFF_MASK:
        raise ValueError(f"identifier {can_id & EFF_MASK:X}h has more than 11 bits; set EFF_FLAG")
    return _FRAME.pack(can_id, len(data), data)


def pack_remote(can_id: int, length: int = 0) -> bytes:
    """Return the remote frame that requests `length` (0..8) bytes of data of this identifier.

    Raises:
        ValueError: length is not 0..8.
    """
    if not 0 <= length <= 8:
        raise ValueError(f"remote frame: invalid length {length} bytes; expected 0..8")
    return _FRAME.pack(can_id | RTR_FLAG, length, b"")


def pack_fd(can_id: int, data: bytes = b"", flags: int = BRS) -> bytes:
    """Return the CAN FD frame with this can_id, data (a length of FD_LENGTHS) and flags.

    Raises:
        ValueError: invalid length, an identifier that does not fit its format, or a remote frame,
            which CAN FD does not have.
    """
    if len(data) not in FD_LENGTHS:
        raise ValueError(f"{len(data)} bytes of data: a CAN FD frame has 0..8, 12, 16, ... or 64")
    if not can_id & EFF_FLAG and can_id & EFF_MASK & ~SFF_MASK:
        raise ValueError(f"identifier {can_id & EFF_MASK:X}h has more than 11 bits; set EFF_FLAG")
    if can_id & RTR_FLAG:
        raise ValueError("there is no remote frame in CAN FD")
    return _FD_FRAME.pack(can_id, len(data), flags | FDF, data)


def as_driven(frame: bytes) -> bytes:
    """Return a can_frame or canfd_frame from outside as the driver of a CAN controller sends it.

    Padding and unknown flags are cleared: python-can leaves the DLC in `len8_dlc`. In CAN FD, FDF
    is set, and the data are padded with 0 to one of the FD_LENGTHS.

    Raises:
        ValueError: the frame cannot be sent, as for `pack` and `pack_fd`.
    """
    if len(frame) == FRAME_BYTES:
        length = frame[4]
        if frame[3] & 0x40:
            return pack_remote(can_id_of(frame) & ~RTR_FLAG, length)
        return pack(can_id_of(frame), frame[8 : 8 + length].ljust(length, b"\0"))
    length = min((one for one in FD_LENGTHS if one >= frame[4]), default=frame[4])
    data = frame[8 : 8 + frame[4]]
    return pack_fd(can_id_of(frame), data.ljust(length, b"\0"), frame[5] & (BRS | ESI))


def can_id_of(frame: bytes) -> int:
    """Return identifier and flags, from the frame's first four bytes."""
    return frame[0] | frame[1] << 8 | frame[2] << 16 | frame[3] << 24


def data_of(frame: bytes) -> bytes:
    """Return the data bytes; empty for a remote frame."""
    if frame[3] & 0x40:
        return b""
    return frame[8 : 8 + frame[4]]
