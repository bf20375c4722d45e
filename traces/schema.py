"""Channels of our recordings, and the protobuf message type of each.

  topic                     message                contents
  /can/<bus>                motorhil.CanFrame      every frame, at the time of its last bit
  /modbus/<line>            motorhil.ModbusAdu     every ADU, when its end was detected
  /serial/<line>            motorhil.SerialData    what one sender sent without a pause
  /motor/<name>/state       foxglove.JointState    the motor's state as the application knows it
  /motor/<name>/lock        motorhil.MotorLock     acquisitions, waits and releases of a motor
  /group/<name>/sync        motorhil.GroupSync     skew at the start and end of a group
  /controller/<name>/truth  motorhil.truth.<kind>  true internal state, a field per quantity
  /events                   foxglove.Log           events

`log_time` is the rig's time [ns from 0]. Field numbers are permanent: they never change their
meaning.

The most frequent messages are packed by hand: no object is created except for the resulting bytes.
A CAN frame has Linux's layout; see `traces.can_frame`.
"""

import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, final

from motorhil.traces.can_frame import (
    BRS,
    CAN_FRAME_SIZE,
    CANFD_FRAME_SIZE,
    EFF,
    EFF_MASK,
    ERR,
    ESI,
    FDF,
    RTR,
    SFF_MASK,
)
from motorhil.traces.protobuf import (
    Enumeration,
    Field,
    Kind,
    Message,
    Value,
    decode,
    delimited,
    file_descriptor_set,
    tag,
    varint,
)

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
_REMEMBERED: Final = 1 << 16  # beginnings of messages
_ALIKE: Final = 16  # of them with one identifier and size
_LAYOUTS_LEARNED: Final = 256  # then payloads without a known layout are decoded by the table


@final
@dataclass(frozen=True, slots=True)
class Schema:
    """The encoding of a channel's messages: an MCAP schema record without its number."""

    name: str
    data: bytes
    encoding: str = "protobuf"

    @staticmethod
    def of(message: Message) -> "Schema":
        """Return the schema of a message type."""
        return Schema(message.name, file_descriptor_set(message))


@final
class Direction(IntEnum):
    """Direction of a frame, as seen by the application."""

    UNKNOWN = 0
    RECEIVED = 1
    TRANSMITTED = 2


@final
class Level(IntEnum):
    """Severity of an event; the values are foxglove.Log's."""

    UNKNOWN = 0
    DEBUG = 1
    INFO = 2
    WARNING = 3
    ERROR = 4
    FATAL = 5


@final
class LockAction(IntEnum):
    """A change of the ownership of a motor."""

    UNKNOWN = 0
    TAKEN = 1
    RELEASED = 2
    WAITING = 3
    REFUSED = 4
    BROKEN = 5  # taken from an owner that had died
    TAKEN_OVER = 6  # taken from a live owner
    LOST = 7  # the owner noticed a takeover


def _enumeration(name: str, members: type[IntEnum]) -> Enumeration:
    return Enumeration(name, tuple((member.name, member.value) for member in members))


# Source: google/protobuf/timestamp.proto.
TIMESTAMP: Final = Message(
    "google.protobuf.Timestamp",
    (Field(1, "seconds", Kind.INT64), Field(2, "nanos", Kind.INT32)),
)

# `id` has a fixed width and `data` comes last, so that bulk readers find both at fixed offsets. A
# flag that is not set is not written. Numbers 11..14 are reserved for CAN XL.
CAN_FRAME: Final = Message(
    "motorhil.CanFrame",
    (
        Field(1, "id", Kind.FIXED32),  # 11 or 29 bit; in an error frame, the error class
        Field(2, "extended", Kind.BOOL),  # 29 bit identifier
        Field(3, "remote", Kind.BOOL),
        Field(4, "error", Kind.BOOL),  # not traffic: the state of the bus, from SocketCAN
        Field(5, "fd", Kind.BOOL),
        Field(6, "brs", Kind.BOOL),
        Field(7, "esi", Kind.BOOL),
        Field(8, "direction", Kind.ENUM, of=_enumeration("Direction", Direction)),
        Field(9, "sender", Kind.STRING),  # a controller's name, or the application's port
        Field(10, "remote_length", Kind.UINT32),  # the DLC of a remote frame
        Field(15, "data", Kind.BYTES),
    ),
)

# On a serial line an ADU is complete t3.5 after its last bit; on TCP all three times are equal.
# Bytes are as on the wire: with CRC, or with an MBAP header.
MODBUS_ADU: Final = Message(
    "motorhil.ModbusAdu",
    (
        Field(1, "direction", Kind.ENUM, of=_enumeration("Direction", Direction)),
        Field(
            2, "sender", Kind.STRING
        ),  # name of a controller or the gateway, or the application's
        Field(3, "start_ns", Kind.INT64),  # start of its first bit
        Field(4, "end_ns", Kind.INT64),  # end of its last bit
        Field(5, "spoiled", Kind.BOOL),  # a pause in it, or a collision: not a valid frame
        Field(6, "tcp", Kind.BOOL),  # framing: MBAP, else RTU
        Field(15, "data", Kind.BYTES),
    ),
)

# Lines of other protocols; field numbers as in an ADU.
SERIAL_DATA: Final = Message(
    "motorhil.SerialData",
    (
        *MODBUS_ADU.fields[:4],
        Field(5, "spoiled", Kind.BOOL),  # a collision
        Field(15, "data", Kind.BYTES),
    ),
)

# Source: foxglove-schemas-protobuf 0.4.0, foxglove/JointState.proto. SI units; unknown values are
# absent. (Before its release the draft of that message had arrays.)
JOINT_STATE: Final = Message(
    "foxglove.JointState",
    (
        Field(1, "name", Kind.STRING),
        Field(2, "position", Kind.DOUBLE, optional=True),
        Field(3, "velocity", Kind.DOUBLE, optional=True),
        Field(4, "acceleration", Kind.DOUBLE, optional=True),
        Field(5, "effort", Kind.DOUBLE, optional=True),
    ),
)

# Source: foxglove-schemas-protobuf 0.4.0, foxglove/Log.proto.
LOG: Final = Message(
    "foxglove.Log",
    (
        Field(1, "timestamp", Kind.MESSAGE, of=TIMESTAMP),
        Field(2, "level", Kind.ENUM, of=_enumeration("Level", Level)),
        Field(3, "message", Kind.STRING),
        Field(4, "name", Kind.STRING),  # source of the event
        Field(5, "file", Kind.STRING),
        Field(6, "line", Kind.FIXED32),
    ),
)

# A motor belongs to its owner from TAKEN (BROKEN, TAKEN_OVER) to RELEASED, or to the next token. An
# observation is older than its message: a TAKEN by `held_s`. Changes between two observations are
# unknown.
MOTOR_LOCK: Final = Message(
    "motorhil.MotorLock",
    (
        Field(1, "action", Kind.ENUM, of=_enumeration("Action", LockAction)),
        Field(2, "owner", Kind.STRING),  # the one that takes, waits or releases
        Field(3, "holder", Kind.STRING),  # the present or previous holder, if it is not the owner
        Field(4, "waited_s", Kind.DOUBLE),
        Field(5, "held_s", Kind.DOUBLE),
        Field(6, "token", Kind.INT64),  # of the ownership; increases with each one
        Field(7, "pid", Kind.UINT32),  # of the owner's process; 0: unknown
        Field(8, "program", Kind.STRING),
        Field(9, "purpose", Kind.STRING),
        Field(10, "sender", Kind.STRING),  # sender name of that process's recorded frames
        Field(
            11, "looked", Kind.BOOL
        ),  # observed at the lock from outside, not reported by the owner
    ),
)

GROUP_SYNC: Final = Message(
    "motorhil.GroupSync",
    (
        Field(
            1,
            "phase",
            Kind.ENUM,
            of=Enumeration("Phase", (("UNKNOWN", 0), ("START", 1), ("END", 2))),
        ),
        Field(2, "motor", Kind.STRING, repeated=True),
        Field(3, "offset_s", Kind.DOUBLE, repeated=True),  # delay of each motor after the first
        Field(4, "skew_s", Kind.DOUBLE),  # measured: the largest offset
        Field(5, "predicted_skew_s", Kind.DOUBLE),  # the group's prediction
        Field(6, "method", Kind.STRING),  # the method of the common start
    ),
)


_TRUTH: Final = "motorhil.truth."

# Source: google/protobuf/descriptor.proto; only the fields used here.
_FIELD: Final = Message(
    "google.protobuf.FieldDescriptorProto",
    (Field(1, "name", Kind.STRING), Field(3, "number", Kind.INT32), Field(5, "type", Kind.INT32)),
)
_MESSAGE: Final = Message(
    "google.protobuf.DescriptorProto",
    (
        Field(1, "name", Kind.STRING),
        Field(2, "field", Kind.MESSAGE, repeated=True, of=_FIELD),
    ),
)
_FILE: Final = Message(
    "google.protobuf.FileDescriptorProto",
    (
        Field(2, "package", Kind.STRING),
        Field(4, "message_type", Kind.MESSAGE, repeated=True, of=_MESSAGE),
    ),
)
_SET: Final = Message(
    "google.protobuf.FileDescriptorSet",
    (Field(1, "file", Kind.MESSAGE, repeated=True, of=_FILE),),
)


def truth_message(kind: str, keys: Sequence[str]) -> Message:
    """Return the message type for snapshots of a controller of `kind` with these keys.

    Each quantity is a double field of its own, which viewers can plot. The fields follow the order
    of the keys. Characters that are invalid in protobuf names become "_".
    """
    fields: list[Field] = []
    used: list[str] = []  # compared like protobuf's JSON names: without "_" and case
    for key in keys:
        name = stem = _identifier(key)
        number = 1
        while name.replace("_", "").lower() in used:
            number += 1
            name = f"{stem}_{number}"
        used.append(name.replace("_", "").lower())
        fields.append(Field(len(used), name, Kind.DOUBLE))
    return Message(f"{_TRUTH}{_identifier(kind)}", tuple(fields))


def _identifier(text: str) -> str:
    name = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return name if name[:1].isalpha() or name[:1] == "_" else f"_{name}"


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
    if fd and not flags & FDF:
        raise ValueError("a canfd_frame without CANFD_FDF (04h) in its flags")
    out = bytearray(_ID_FIELD.pack(_ID, can_id & (EFF_MASK if can_id & (EFF | ERR) else SFF_MASK)))
    if can_id & EFF:
        out += _EXTENDED
    if can_id & RTR:
        out += _REMOTE
    if can_id & ERR:
        out += _ERROR
    if fd:
        out += _FD_SET
        if flags & BRS:
            out += _BRS_SET
        if flags & ESI:
            out += _ESI_SET
    if direction:
        out += _DIRECTION + varint(direction)
    if sender:
        out += delimited(9, sender)
    if can_id & RTR:
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
    asked = fields.get("remote_length", 0)
    assert isinstance(can_id, int)  # guaranteed by the table and by decode
    assert isinstance(data, bytes)
    assert isinstance(asked, int)
    flags = 0
    for bit, name in ((FDF, "fd"), (BRS, "brs"), (ESI, "esi")):
        flags |= bit if fields.get(name) else 0
    for bit, name in ((EFF, "extended"), (RTR, "remote"), (ERR, "error")):
        can_id |= bit if fields.get(name) else 0
    room = 64 if flags & FDF else 8
    length = asked if can_id & RTR else len(data)
    if max(length, len(data)) > room:
        raise ValueError(f"a CanFrame of {max(length, len(data))} bytes with room for {room}")
    return RecordedFrame(
        _HEADER.pack(can_id, length, flags) + data.ljust(room, b"\0"),
        str(fields.get("sender", "")),
        direction_of(fields),
    )


def direction_of(fields: Mapping[str, Value]) -> Direction:
    """Return the direction in the fields of a message."""
    number = fields.get("direction", 0)
    if isinstance(number, int) and number in (1, 2):
        return Direction(number)
    return Direction.UNKNOWN


@final
class FrameDecoder:
    """Decoder that caches the beginnings of messages.

    The same identifier may have other senders on other buses, so a few beginnings share a key.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[bytes, int], list[tuple[bytes, bytes, bytes, Direction, str]]] = {}
        self._count: int = 0

    def decode(self, payload: bytes) -> tuple[bytes, Direction, str]:
        """Return can_frame or canfd_frame, direction and sender of a motorhil.CanFrame.

        Raises:
            ValueError: the payload is not a CanFrame.
        """
        before = self._known.get((payload[:5], len(payload)))
        if before is not None:
            for prefix, head, padding, direction, sender in before:
                if payload.startswith(prefix):
                    return head + payload[len(prefix) :] + padding, direction, sender
        told = decode_can_frame(payload)
        head = told.frame[:8]
        sender_bytes = told.sender.encode()
        prefix, length = can_frame_prefix(head, len(told.frame), sender_bytes, told.direction)
        if len(prefix) + length == len(payload) and payload.startswith(prefix):
            padding = bytes(len(told.frame) - 8 - length)
            self._remember(payload, (prefix, head, padding, told.direction, told.sender))
        return told.frame, told.direction, told.sender

    def _remember(
        self, payload: bytes, beginning: tuple[bytes, bytes, bytes, Direction, str]
    ) -> None:
        if self._count >= _REMEMBERED:
            self._known.clear()
            self._count = 0
        before = self._known.setdefault((payload[:5], len(payload)), [])
        if len(before) >= _ALIKE:
            self._count -= len(before)
            before.clear()
        before.append(beginning)
        self._count += 1


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


def truth_message_of(schema: Schema) -> Message | None:
    """Return the message type of a truth channel with its double fields, or None."""
    if not schema.name.startswith(_TRUTH) or schema.encoding != "protobuf":
        return None
    try:
        files = decode(_SET, schema.data).get("file", [])
    except ValueError:
        return None
    for file in files if isinstance(files, list) else []:
        if not isinstance(file, dict):
            continue
        package = file.get("package", "")
        messages = file.get("message_type", [])
        for message in messages if isinstance(messages, list) else []:
            if isinstance(message, dict) and f"{package}.{message.get('name')}" == schema.name:
                return Message(schema.name, _doubles(message.get("field", [])))
    return None


def _doubles(fields: object) -> tuple[Field, ...]:
    found: list[Field] = []
    for one in fields if isinstance(fields, list) else []:
        if isinstance(one, dict) and one.get("type") == Kind.DOUBLE.value:
            number = one.get("number")
            if isinstance(number, int):
                found.append(Field(number, str(one.get("name", "")), Kind.DOUBLE))
    return tuple(found)


@final
class DoublesLayout:
    """The layout of payloads that are a constant beginning and then doubles.

    Attributes:
        prefix: the beginning.
        tags: one byte before each double.
        names: names of the doubles, in their order.
        size: size of the payload [bytes].
    """

    def __init__(self, prefix: bytes, tags: bytes, names: tuple[str, ...]) -> None:
        self.prefix: Final = prefix
        self.tags: Final = tags
        self.names: Final = names
        self.size: Final = len(prefix) + 9 * len(tags)
        self._unpack: Final = struct.Struct("<" + "xd" * len(tags)).unpack_from

    def fits(self, payload: bytes) -> bool:
        """Return True if the payload has this layout."""
        prefix = self.prefix
        return (
            len(payload) == self.size
            and payload.startswith(prefix)
            and payload[len(prefix) :: 9] == self.tags
        )

    def values(self, payload: bytes) -> tuple[float, ...]:
        """Return the doubles of a payload that fits."""
        return self._unpack(payload, len(self.prefix))


@final
class DoublesDecoder:
    """Decoder of a message's doubles, for frequent messages; it caches the layouts of payloads."""

    def __init__(self, message: Message) -> None:
        self._message: Final = message
        self._layouts: dict[int, DoublesLayout] = {}  # by size of the payload
        self._learned = 0

    def layout(self, payload: bytes) -> DoublesLayout | None:
        """Return the layout of the payload; None: other fields follow the first double."""
        found = self._layouts.get(len(payload))
        if found is not None and found.fits(payload):
            return found
        if self._learned >= _LAYOUTS_LEARNED:
            return None
        self._learned += 1
        learned = self._learn(payload)
        if learned is not None:
            self._layouts[len(payload)] = learned
        return learned

    def decode(self, payload: bytes) -> dict[str, float]:
        """Return the doubles of the payload by name.

        Raises:
            ValueError: the payload is not such a message.
        """
        layout = self.layout(payload)
        if layout is not None:
            return dict(zip(layout.names, layout.values(payload), strict=True))
        return self._doubles(payload)

    def _doubles(self, payload: bytes) -> dict[str, float]:
        told = decode(self._message, payload)
        return {name: value for name, value in told.items() if isinstance(value, float)}

    def _learn(self, payload: bytes) -> DoublesLayout | None:
        """Return the layout of a payload that ends with its doubles, each once."""
        try:
            count = len(self._doubles(payload))
            prefix = payload[: len(payload) - 9 * count]
            if self._doubles(prefix):
                return None
        except ValueError:
            return None
        tags = payload[len(prefix) :: 9]
        by_tag = {
            field.number << 3 | 1: field.name
            for field in self._message.fields
            if field.kind is Kind.DOUBLE and not field.repeated and field.number < 16
        }
        names = [by_tag[tag] for tag in tags if tag in by_tag]
        if len(names) != count or len(set(names)) != count or len(tags) != count:
            return None
        return DoublesLayout(prefix, tags, tuple(names))


@final
class TruthDecoder:
    """Decoder of snapshots of one controller."""

    def __init__(self, message: Message) -> None:
        self.doubles: Final = DoublesDecoder(message)
        self.names: Final = tuple([field.name for field in message.fields])

    def decode(self, payload: bytes) -> dict[str, float]:
        """Return every field; a missing one is 0, as in protobuf.

        Raises:
            ValueError: the payload is not such a message.
        """
        told = self.doubles.decode(payload)
        if len(told) == len(self.names):
            return told
        return {name: told.get(name, 0.0) for name in self.names}
