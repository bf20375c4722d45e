"""Conversion between python-can messages and frames of an emulated bus.

A CAN FD message of a length that CAN FD lacks is padded with 0 to the next valid length. The Linux
kernel does the same for python-can's SocketCAN interface.
"""

import struct
from typing import Any, Final

from can import CanOperationError, Message

from motorhil.emulators.can.frame import BRS, ESI, FD_FRAME_BYTES, FD_LENGTHS, pack_fd

_FRAME: Final = struct.Struct("<IB3x8s")
_FD_FRAME: Final = struct.Struct("<IBB2x64s")
_EFF: Final = 0x8000_0000
_RTR: Final = 0x4000_0000
_ERR: Final = 0x2000_0000
_ID_MAX: Final = 0x1FFF_FFFF


def to_frame(message: Message) -> bytes:
    """Return a python-can message as a Linux can_frame (16 bytes) or canfd_frame (72 bytes).

    Raises:
        CanOperationError: the message is not a valid frame.
    """
    can_id = message.arbitration_id
    if message.is_error_frame:
        raise CanOperationError(
            "an error frame cannot be sent: CAN controllers create error frames from errors on "
            "the bus; inject the error itself, with a [[fault]] of the rig or rig.faults.inject"
        )
    if not 0 <= can_id <= _ID_MAX:
        raise CanOperationError(f"identifier {can_id:X}h does not fit 29 bits")
    if message.is_extended_id:
        can_id |= _EFF
    elif can_id > 0x7FF:
        raise CanOperationError(
            f"identifier {can_id:X}h does not fit 11 bits: set is_extended_id=True"
        )
    if message.is_fd:
        return _to_fd_frame(message, can_id)
    if message.is_remote_frame:
        if message.dlc > 8:
            raise CanOperationError(
                f"remote frame: DLC {message.dlc} is too large; a remote "
                "frame requests at most 8 bytes"
            )
        return _FRAME.pack(can_id | _RTR, message.dlc, b"")
    if len(message.data) > 8:
        raise CanOperationError(
            f"{len(message.data)} data bytes: too many; a classical frame holds at most 8"
        )
    return _FRAME.pack(can_id, len(message.data), bytes(message.data))


def _to_fd_frame(message: Message, can_id: int) -> bytes:
    if message.is_remote_frame:
        raise CanOperationError(f"identifier {can_id & _ID_MAX:X}h: CAN FD has no remote frames")
    size = len(message.data)
    if size > FD_LENGTHS[-1]:
        raise CanOperationError(
            f"{size} data bytes: too many; a CAN FD frame holds at most {FD_LENGTHS[-1]}"
        )
    length = next(one for one in FD_LENGTHS if one >= size)
    flags = BRS if message.bitrate_switch else 0
    if message.error_state_indicator:
        flags |= ESI
    return pack_fd(can_id, bytes(message.data).ljust(length, b"\0"), flags)


def to_message(frame: bytes, time_ns: int, channel: Any, received: bool) -> Message:
    """Return a Linux can_frame or canfd_frame as a python-can message.

    Args:
        frame: the frame.
        time_ns: its time stamp [ns].
        channel: the channel that the user gave to `can.Bus`, of any type.
        received: False for a message of the same bus object.
    """
    fd = len(frame) == FD_FRAME_BYTES
    if fd:
        can_id, length, flags, data = _FD_FRAME.unpack(frame)
    else:
        can_id, length, data = _FRAME.unpack(frame)
        flags = 0
    extended = bool(can_id & _EFF)
    remote = bool(can_id & _RTR)
    return Message(
        timestamp=time_ns / 1e9,
        arbitration_id=can_id & (0x1FFF_FFFF if extended else 0x7FF),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=bool(can_id & _ERR),
        is_fd=fd,
        bitrate_switch=bool(flags & BRS),
        error_state_indicator=bool(flags & ESI),
        dlc=length,
        data=None if remote else data[:length],
        channel=channel,
        is_rx=received,
    )
