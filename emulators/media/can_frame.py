"""The frames that cross every CAN seam: Linux `can_frame`, 16 bytes, and `canfd_frame`, 72 bytes.

Layout, little endian: can_id (32 bits), length (8 bits), 3 bytes of padding, data (8 bytes, the
unused ones zero). The identifier is in the low 29 bits of can_id, the flags above it. A remote
frame keeps its DLC in length and carries no data.

CAN FD (`struct canfd_frame`) is told apart by its size alone: the first byte of what is padding
above holds its flags, the data are up to 64 bytes, and only the lengths of `FD_LENGTHS` exist.

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

FD_FRAME_BYTES: Final = 72
BRS: Final = 0x01  # flags of an FD frame: bit rate switch
ESI: Final = 0x02  # its sender is error passive
FDF: Final = 0x04  # set in every FD frame by those who set it at all
FD_LENGTHS: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)  # by DLC

_FRAME: Final = Struct("<IB3x8s")
_FD_FRAME: Final = Struct("<IBB2x64s")


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


def pack_fd(can_id: int, data: bytes = b"", flags: int = BRS) -> bytes:
    """The CAN FD frame with this can_id, data of one of the FD_LENGTHS, and BRS or ESI or none.

    Raises:
        ValueError: no such length, an identifier that its format has no room for, or a remote
            frame: CAN FD has none.
    """
    if len(data) not in FD_LENGTHS:
        raise ValueError(f"{len(data)} bytes of data: a CAN FD frame has 0..8, 12, 16, ... or 64")
    if not can_id & EFF_FLAG and can_id & EFF_MASK & ~SFF_MASK:
        raise ValueError(f"identifier {can_id & EFF_MASK:X}h has more than 11 bits; set EFF_FLAG")
    if can_id & RTR_FLAG:
        raise ValueError("there is no remote frame in CAN FD")
    return _FD_FRAME.pack(can_id, len(data), flags | FDF, data)


def padded_fd(frame: bytes) -> bytes:
    """A canfd_frame as the driver of a CAN controller sends it.

    FDF is set, unknown flags are not, and the data are filled up with 0 to one of the FD_LENGTHS.

    Raises:
        ValueError: no such frame can be sent, as of `pack_fd`.
    """
    length = min((one for one in FD_LENGTHS if one >= frame[4]), default=frame[4])
    data = frame[8 : 8 + frame[4]]
    return pack_fd(can_id_of(frame), data.ljust(length, b"\0"), frame[5] & (BRS | ESI))


def can_id_of(frame: bytes) -> int:
    """Identifier and flags, as in the frame's first four bytes."""
    return frame[0] | frame[1] << 8 | frame[2] << 16 | frame[3] << 24


def data_of(frame: bytes) -> bytes:
    """The data bytes; empty for a remote frame."""
    if frame[3] & 0x40:
        return b""
    return frame[8 : 8 + frame[4]]
