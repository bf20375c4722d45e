"""What our recordings hold: one protobuf message type a kind of channel, as tables.

    topic                     message                  what
    /can/<bus>                motorhil.CanFrame        every frame, when its last bit was on the bus
    /modbus/<line>            motorhil.ModbusAdu       every ADU, when the line knew it was complete
    /motor/<name>/state       foxglove.JointState      what the application can know of its motor
    /motor/<name>/lock        motorhil.MotorLock       who takes, waits for and gives back a motor
    /group/<name>/sync        motorhil.GroupSync       how far apart a group began and ended
    /controller/<name>/truth  motorhil.truth.<kind>    what is so inside, a field a quantity
    /events                   foxglove.Log             what happened

`log_time` is the rig's time [ns from 0]. Field numbers are a promise: they are never given a new
meaning.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, final

from traces.protobuf import Enumeration, Field, Kind, Message, file_descriptor_set


@final
@dataclass(frozen=True, slots=True)
class Schema:
    """What a channel's messages are encoded with: an MCAP schema record without its number."""

    name: str
    data: bytes
    encoding: str = "protobuf"

    @staticmethod
    def of(message: Message) -> "Schema":
        """The schema of this message type."""
        return Schema(message.name, file_descriptor_set(message))


@final
class Direction(IntEnum):
    """How a frame looks to the application: did it hear it, or send it?"""

    UNKNOWN = 0
    RECEIVED = 1
    TRANSMITTED = 2


@final
class Level(IntEnum):
    """How much an event matters; the values are foxglove.Log's."""

    UNKNOWN = 0
    DEBUG = 1
    INFO = 2
    WARNING = 3
    ERROR = 4
    FATAL = 5


@final
class LockAction(IntEnum):
    """What happened to the ownership of a motor."""

    UNKNOWN = 0
    TAKEN = 1
    RELEASED = 2
    WAITING = 3
    REFUSED = 4
    BROKEN = 5  # taken from one who had died
    TAKEN_OVER = 6  # taken from one who lives
    LOST = 7  # its holder noticed that it was taken over


def _enumeration(name: str, members: type[IntEnum]) -> Enumeration:
    return Enumeration(name, tuple((member.name, member.value) for member in members))


# Source: google/protobuf/timestamp.proto.
TIMESTAMP: Final = Message(
    "google.protobuf.Timestamp",
    (Field(1, "seconds", Kind.INT64), Field(2, "nanos", Kind.INT32)),
)

# `id` has a fixed width and `data` comes last, so that whoever reads millions of frames finds both
# at known places. A flag that is not set is not written. Numbers 11..14 are free for CAN XL.
CAN_FRAME: Final = Message(
    "motorhil.CanFrame",
    (
        Field(1, "id", Kind.FIXED32),  # 11 or 29 bit; of an error frame, the error class
        Field(2, "extended", Kind.BOOL),  # 29 bit identifier
        Field(3, "remote", Kind.BOOL),
        Field(4, "error", Kind.BOOL),  # not traffic: the state of the bus, as SocketCAN tells it
        Field(5, "fd", Kind.BOOL),
        Field(6, "brs", Kind.BOOL),
        Field(7, "esi", Kind.BOOL),
        Field(8, "direction", Kind.ENUM, of=_enumeration("Direction", Direction)),
        Field(9, "sender", Kind.STRING),  # a controller's name, or the application's port
        Field(10, "remote_length", Kind.UINT32),  # the DLC of a remote frame
        Field(15, "data", Kind.BYTES),
    ),
)

# On a serial line it is complete t3.5 after its last bit; on TCP all three times are one. Bytes are
# as they were on the wire: with CRC, or behind an MBAP header.
MODBUS_ADU: Final = Message(
    "motorhil.ModbusAdu",
    (
        Field(1, "direction", Kind.ENUM, of=_enumeration("Direction", Direction)),
        Field(2, "sender", Kind.STRING),  # a controller's name, the gateway's, or the application's
        Field(3, "start_ns", Kind.INT64),  # when its first bit began
        Field(4, "end_ns", Kind.INT64),  # when its last bit ended
        Field(5, "spoiled", Kind.BOOL),  # a pause in it, or a collision: it is no frame
        Field(6, "tcp", Kind.BOOL),  # the framing is MBAP's, else RTU's
        Field(15, "data", Kind.BYTES),
    ),
)

# Source: foxglove-schemas-protobuf 0.4.0, foxglove/JointState.proto. SI units; what is not known is
# absent. (Before its release the draft of that message held arrays.)
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
        Field(4, "name", Kind.STRING),  # who says so
        Field(5, "file", Kind.STRING),
        Field(6, "line", Kind.FIXED32),
    ),
)

# A motor is the owner's from TAKEN (BROKEN, TAKEN_OVER) to RELEASED, or to the next token. What was
# looked at is older than its message: a TAKEN by `held_s`; what lay between two looks is not known.
MOTOR_LOCK: Final = Message(
    "motorhil.MotorLock",
    (
        Field(1, "action", Kind.ENUM, of=_enumeration("Action", LockAction)),
        Field(2, "owner", Kind.STRING),  # who takes, waits or gives back
        Field(3, "holder", Kind.STRING),  # who has it, or had it, if not the owner
        Field(4, "waited_s", Kind.DOUBLE),
        Field(5, "held_s", Kind.DOUBLE),
        Field(6, "token", Kind.INT64),  # of the ownership; it grows from one to the next
        Field(7, "pid", Kind.UINT32),  # of the owner's process; 0: not told
        Field(8, "program", Kind.STRING),
        Field(9, "purpose", Kind.STRING),
        Field(10, "sender", Kind.STRING),  # what the frames of that process are recorded under
        Field(11, "looked", Kind.BOOL),  # seen on the lock from outside, not told by the owner
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
        Field(3, "offset_s", Kind.DOUBLE, repeated=True),  # of each motor, behind the first
        Field(4, "skew_s", Kind.DOUBLE),  # measured: the largest offset
        Field(5, "predicted_skew_s", Kind.DOUBLE),  # what the group had said was possible
        Field(6, "method", Kind.STRING),  # how they were started together
    ),
)


def truth_message(kind: str, keys: Sequence[str]) -> Message:
    """The message type for a controller of `kind` whose snapshots have these keys, all doubles.

    A quantity a viewer can plot is a field of its own; so the type is made from the keys, in their
    order. What cannot be in a protobuf name becomes "_".
    """
    fields: list[Field] = []
    used: list[str] = []  # as protobuf's JSON names compare: without "_"; and without case
    for key in keys:
        name = stem = _identifier(key)
        number = 1
        while name.replace("_", "").lower() in used:
            number += 1
            name = f"{stem}_{number}"
        used.append(name.replace("_", "").lower())
        fields.append(Field(len(used), name, Kind.DOUBLE))
    return Message(f"motorhil.truth.{_identifier(kind)}", tuple(fields))


def _identifier(text: str) -> str:
    name = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return name if name[:1].isalpha() or name[:1] == "_" else f"_{name}"
