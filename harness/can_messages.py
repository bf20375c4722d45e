"""python-can's messages as frames of an emulated bus, and the other way round."""

import struct
from typing import Final

from can import CanOperationError, Message

_FRAME: Final = struct.Struct("<IB3x8s")
_EFF: Final = 0x8000_0000
_RTR: Final = 0x4000_0000
_ERR: Final = 0x2000_0000
_ID_MAX: Final = 0x1FFF_FFFF


def to_frame(message: Message) -> bytes:
    """The Linux can_frame (16 bytes) of a python-can message.

    Raises:
        CanOperationError: a CAN FD message, or one that is no valid classical frame.
    """
    if message.is_fd:
        raise CanOperationError(
            f"CAN FD frame {message.arbitration_id:X}h on an emulated bus: it is classical CAN"
        )
    can_id = message.arbitration_id
    if message.is_error_frame:
        raise CanOperationError(
            "an error frame cannot be sent: a CAN controller makes them, of what it noticed on the "
            "bus; make the error itself, by a [[fault]] of the rig or rig.faults.inject"
        )
    if not 0 <= can_id <= _ID_MAX:
        raise CanOperationError(f"identifier {can_id:X}h does not fit 29 bits")
    if message.is_extended_id:
        can_id |= _EFF
    elif can_id > 0x7FF:
        raise CanOperationError(
            f"identifier {can_id:X}h does not fit 11 bits: set is_extended_id=True"
        )
    if message.is_remote_frame:
        if message.dlc > 8:
            raise CanOperationError(f"a remote frame asks for 8 bytes at most, not {message.dlc}")
        return _FRAME.pack(can_id | _RTR, message.dlc, b"")
    if len(message.data) > 8:
        raise CanOperationError(f"{len(message.data)} data bytes: a classical frame holds 8")
    return _FRAME.pack(can_id, len(message.data), bytes(message.data))


def to_message(frame: bytes, time_ns: int, channel: str, received: bool) -> Message:
    """The python-can message of a Linux can_frame."""
    can_id, length, data = _FRAME.unpack(frame)
    extended = bool(can_id & _EFF)
    remote = bool(can_id & _RTR)
    return Message(
        timestamp=time_ns / 1e9,
        arbitration_id=can_id & (0x1FFF_FFFF if extended else 0x7FF),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=bool(can_id & _ERR),
        dlc=length,
        data=None if remote else data[:length],
        channel=channel,
        is_rx=received,
    )
