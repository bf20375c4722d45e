"""CAN frames in Linux's layout: `struct can_frame` and `struct canfd_frame`.

They have 16 and 72 bytes: can_id with EFF, RTR and ERR bits, length, flags (FD only, FDF set), two
reserved bytes, and data padded to 8 or 64. Source: linux/can.h.
"""

import struct
from typing import Final, NamedTuple

CAN_FRAME_SIZE: Final = 16
CANFD_FRAME_SIZE: Final = 72
EFF: Final = 0x8000_0000
"""Flag of a can_id: extended frame format, an identifier of 29 bits."""
RTR: Final = 0x4000_0000
"""Flag of a can_id: remote transmission request."""
ERR: Final = 0x2000_0000
"""Flag of a can_id: error message of the controller."""
EFF_MASK: Final = 0x1FFF_FFFF
SFF_MASK: Final = 0x7FF
BRS: Final = 1
ESI: Final = 2
FDF: Final = 4
FD_LENGTHS: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)  # by DLC
_CLASSIC: Final = struct.Struct("<IB3x8s")
_FD: Final = struct.Struct("<IBB2x64s")
_HEAD: Final = struct.Struct("<IBB")


class Fields(NamedTuple):
    """The fields of a frame. `length` is that of its data, or the DLC of a remote frame."""

    can_id: int
    length: int
    flags: int
    data: bytes
    fd: bool

    @property
    def identifier(self) -> int:
        """The identifier without its flags; for an error frame, the error class."""
        return self.can_id & (EFF_MASK if self.can_id & (EFF | ERR) else SFF_MASK)


def dlc(length: int) -> int:
    """Return the DLC of a frame with 0 to 64 bytes of data."""
    return next(code for code in range(16) if FD_LENGTHS[code] >= length)


def classic(can_id: int, data: bytes) -> bytes:
    """Return a data or error frame.

    Raises:
        ValueError: the values are not possible.
    """
    if len(data) > 8:
        raise ValueError(f"{len(data)} bytes in a classic frame")
    return _CLASSIC.pack(_checked(can_id), len(data), data)


def remote(can_id: int, length: int) -> bytes:
    """Return a remote frame that requests `length` bytes.

    Raises:
        ValueError: the values are not possible.
    """
    if not 0 <= length <= 15:
        raise ValueError(f"a remote frame with DLC {length}")
    return _CLASSIC.pack(_checked(can_id) | RTR, min(length, 8), b"")


def flexible(can_id: int, flags: int, data: bytes) -> bytes:
    """Return a CAN FD frame; flags are BRS and ESI.

    Raises:
        ValueError: the values are not possible.
    """
    if len(data) > 64:
        raise ValueError(f"{len(data)} bytes in a CAN FD frame")
    return _FD.pack(_checked(can_id), len(data), flags & (BRS | ESI) | FDF, data)


def _checked(can_id: int) -> int:
    if not 0 <= can_id < 1 << 32:
        raise ValueError(f"identifier {can_id:X}h has more than 29 bits")
    limit = EFF_MASK if can_id & (EFF | ERR) else SFF_MASK
    if can_id & EFF_MASK > limit:
        raise ValueError(f"identifier {can_id & EFF_MASK:X}h needs 29 bits")
    return can_id


def fields(frame: bytes) -> Fields:
    """Return the fields of a can_frame or canfd_frame."""
    can_id, length, flags = _HEAD.unpack_from(frame)
    fd = len(frame) > 16
    data = b"" if can_id & RTR else frame[8 : 8 + length]
    return Fields(can_id, length, flags if fd else 0, data, fd)
