"""The CAN frame that crosses every CAN seam: Linux `struct can_frame`, 16 bytes.

Layout, little endian: can_id (32 bits), length (8 bits), 3 bytes of padding, data (8 bytes, the
unused ones zero). The identifier is in the low 29 bits of can_id, the flags above it. A remote
frame keeps its DLC in length and carries no data.

CAN FD (`struct canfd_frame`, 72 bytes) is told apart by its size alone; nothing here builds it yet.

Source: Linux include/uapi/linux/can.h.
"""

from struct import Struct
from typing import Final

FRAME_BYTES: Final = 16
EFF_FLAG: Final = 0x8000_0000  # extended frame format: 29-bit identifier
RTR_FLAG: Final = 0x4000_0000  # remote transmission request
ERR_FLAG: Final = 0x2000_0000  # error message, never on a bus
SFF_MASK: Final = 0x7FF
EFF_MASK: Final = 0x1FFF_FFFF

_FRAME: Final = Struct("<IB3x8s")


def pack(can_id: int, data: bytes = b"") -> bytes:
    """The frame with this can_id (identifier and flags) and 0..8 bytes of data.

    Raises:
        ValueError: more than 8 bytes, or an identifier that its format has no room for.
    """
    if len(data) > 8:
        raise ValueError(f"{len(data)} bytes of data do not fit a classical CAN frame; 8 do")
    if not can_id & EFF_FLAG and can_id & EFF_MASK & ~SFF_MASK:
        raise ValueError(f"identifier {can_id & EFF_MASK:X}h has more than 11 bits; set EFF_FLAG")
    return _FRAME.pack(can_id, len(data), data)


def pack_remote(can_id: int, length: int = 0) -> bytes:
    """The remote frame that asks for `length` (0..8) bytes of data of this identifier.

    Raises:
        ValueError: length is not 0..8.
    """
    if not 0 <= length <= 8:
        raise ValueError(f"a remote frame asks for 0..8 bytes, not {length}")
    return _FRAME.pack(can_id | RTR_FLAG, length, b"")


def can_id_of(frame: bytes) -> int:
    """Identifier and flags, as in the frame's first four bytes."""
    return frame[0] | frame[1] << 8 | frame[2] << 16 | frame[3] << 24


def data_of(frame: bytes) -> bytes:
    """The data bytes; empty for a remote frame."""
    if frame[3] & 0x40:
        return b""
    return frame[8 : 8 + frame[4]]
