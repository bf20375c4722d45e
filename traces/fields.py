"""Hand-written packing of the most frequent messages.

No object is created except for the resulting bytes. A CAN frame has Linux's layout: `struct
can_frame` (16 bytes) or `struct canfd_frame` (72 bytes, with CANFD_FDF set in its flags). It
consists of can_id with EFF, RTR and ERR bits, length, flags (FD only), two reserved bytes, and data
padded to 8 or 64. Source: linux/can.h.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, final

from traces.protobuf import Kind, Message, decode, delimited, tag, varint
from traces.schema import CAN_FRAME, Direction, Level

CAN_FRAME_SIZE: Final = 16
CANFD_FRAME_SIZE: Final = 72
_EFF: Final = 0x8000_0000
_RTR: Final = 0x4000_0000
_ERR: Final = 0x2000_0000
_SFF_MASK: Final = 0x7FF
_EFF_MASK: Final = 0x1FFF_FFFF
_BRS: Final = 0x01
_ESI: Final = 0x02
_FDF: Final = 0x04
_HEADER: Final = struct.Struct("<IBBxx")
_DOUBLE: Final = struct.Struct("<d")
_ID_FIELD: Final = struct.Struct("<BI")

# Tags of CanFrame, field number * 8 + wire type.
_ID: Final = 0x0D
_EXTENDED: Final = b"\x10\x01"  # a tag and the value 1
_REMOTE: Final = b"\x18\x01"
_ERROR: Final = b"\x20\x01"
_FD_SET: Final = b"\x28\x01"
_BRS_SET: Final = b"\x30\x01"
_ESI_SET: Final = b"\x38\x01"
_DIRECTION: Final = b"\x40"
_REMOTE_LENGTH: Final = b"\x50"
_DATA: Final = b"\x7a"


def can_frame_prefix(header: bytes, size: int, sender: bytes, direction: int) -> tuple[bytes, int]:
    """Return a CanFrame up to its data, and the number of data bytes that follow.

    The result depends only on the frame's first 8 bytes and its size. Periodic traffic needs it
    once per identifier.

    Raises:
        ValueError: not a can_frame or canfd_frame: wrong size, length too large, or no CANFD_FDF.
    """
    if size not in (CAN_FRAME_SIZE, CANFD_FRAME_SIZE):
        raise ValueError(f"a CAN frame is 16 or 72 bytes, not {size}")
    can_id, length, flags = _HEADER.unpack(header)
    if length > size - 8:
        raise ValueError(f"length {length} in a CAN frame with room for {size - 8}")
    fd = size == CANFD_FRAME_SIZE
    if fd and not flags & _FDF:
        raise ValueError("a canfd_frame without CANFD_FDF (04h) in its flags")
    out = bytearray(
        _ID_FIELD.pack(_ID, can_id & (_EFF_MASK if can_id & (_EFF | _ERR) else _SFF_MASK))
    )
    if can_id & _EFF:
        out += _EXTENDED
    if can_id & _RTR:
        out += _REMOTE
    if can_id & _ERR:
        out += _ERROR
    if fd:
        out += _FD_SET
        if flags & _BRS:
            out += _BRS_SET
        if flags & _ESI:
            out += _ESI_SET
    if direction:
        out += _DIRECTION + varint(direction)
    if sender:
        out += delimited(9, sender)
    if can_id & _RTR:
        if length:
            out += _REMOTE_LENGTH + varint(length)
        length = 0  # a remote frame requests data and has none
    out += _DATA + bytes((length,))
    return bytes(out), length


def encode_can_frame(
    frame: bytes, sender: str = "", direction: Direction = Direction.UNKNOWN
) -> bytes:
    """Encode a motorhil.CanFrame. For bulk data the writer uses cached prefixes."""
    prefix, length = can_frame_prefix(frame[:8], len(frame), sender.encode(), direction)
    return prefix + frame[8 : 8 + length]


@final
@dataclass(frozen=True, slots=True)
class RecordedFrame:
    """A recorded CAN frame; `frame` is a can_frame or canfd_frame."""

    frame: bytes
    sender: str
    direction: Direction


def decode_can_frame(payload: bytes) -> RecordedFrame:
    """Decode a motorhil.CanFrame of any writer.

    Raises:
        ValueError: the payload is not a CanFrame.
    """
    fields = decode(CAN_FRAME, payload)
    can_id, data = fields.get("id", 0), fields.get("data", b"")
    direction, asked = fields.get("direction", 0), fields.get("remote_length", 0)
    assert isinstance(can_id, int)  # guaranteed by the table and by decode
    assert isinstance(data, bytes)
    assert isinstance(direction, int)
    assert isinstance(asked, int)
    flags = 0
    for bit, name in ((_FDF, "fd"), (_BRS, "brs"), (_ESI, "esi")):
        flags |= bit if fields.get(name) else 0
    for bit, name in ((_EFF, "extended"), (_RTR, "remote"), (_ERR, "error")):
        can_id |= bit if fields.get(name) else 0
    room = 64 if flags & _FDF else 8
    length = asked if can_id & _RTR else len(data)
    if max(length, len(data)) > room:
        raise ValueError(f"a CanFrame of {max(length, len(data))} bytes with room for {room}")
    return RecordedFrame(
        _HEADER.pack(can_id, length, flags) + data.ljust(room, b"\0"),
        str(fields.get("sender", "")),
        Direction(direction) if direction in (1, 2) else Direction.UNKNOWN,
    )


def timestamp_field(time_ns: int) -> bytes:
    """Encode field 1, a google.protobuf.Timestamp."""
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    inner = (b"\x08" + varint(seconds) if seconds else b"") + (
        b"\x10" + varint(nanos) if nanos else b""
    )
    return b"\x0a%c%b" % (len(inner), inner)


def encode_log(time_ns: int, level: Level, text: str, name: str = "") -> bytes:
    """Encode a foxglove.Log."""
    out = timestamp_field(time_ns) + b"\x10%c" % level + delimited(3, text.encode())
    return out + delimited(4, name.encode()) if name else out


@final
class JointStateEncoder:
    """Encoder of foxglove.JointState messages of one joint."""

    def __init__(self, name: str) -> None:
        self._name: Final = delimited(1, name.encode())
        self._pack: Final = struct.Struct("<BdBdBd").pack
        self._pack_position: Final = struct.Struct("<Bd").pack

    def encode(self, position: float | None, velocity: float | None, effort: float | None) -> bytes:
        """Encode position [rad or m], velocity [1/s] and effort [N·m or N]; None is omitted."""
        if position is not None and velocity is not None and effort is not None:
            return self._name + self._pack(0x11, position, 0x19, velocity, 0x29, effort)
        if position is not None and velocity is None and effort is None:  # the case of most drives
            return self._name + self._pack_position(0x11, position)
        out = self._name
        for head, value in ((b"\x11", position), (b"\x19", velocity), (b"\x29", effort)):
            if value is not None:
                out += head + _DOUBLE.pack(value)
        return out


@final
class TruthEncoder:
    """Encoder of snapshots of one controller: doubles in the order of the message's fields."""

    def __init__(self, message: Message) -> None:
        layout = "<"
        self._arguments: list[bytes | float] = []
        for field in message.fields:
            head = tag(field.number, Kind.DOUBLE)
            layout += f"{len(head)}sd"
            self._arguments += [head, 0.0]
        self._pack: Final = struct.Struct(layout).pack

    def encode(self, values: Iterable[float]) -> bytes:
        """Encode the message; one value per field."""
        self._arguments[1::2] = values
        return self._pack(*self._arguments)
