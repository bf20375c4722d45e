"""Channels of our recordings, and the protobuf message type of each.

  topic                     message                contents
  /can/<bus>                motorhil.CanFrame      every frame, at the time of its last bit
  /modbus/<line>            motorhil.ModbusAdu     every ADU, when its end was detected
  /motor/<name>/state       foxglove.JointState    the motor's state as the application knows it
  /motor/<name>/lock        motorhil.MotorLock     acquisitions, waits and releases of a motor
  /group/<name>/sync        motorhil.GroupSync     skew at the start and end of a group
  /controller/<name>/truth  motorhil.truth.<kind>  true internal state, a field per quantity
  /events                   foxglove.Log           events

`log_time` is the rig's time [ns from 0]. Field numbers are permanent: they never change their
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
    return Message(f"motorhil.truth.{_identifier(kind)}", tuple(fields))


def _identifier(text: str) -> str:
    name = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return name if name[:1].isalpha() or name[:1] == "_" else f"_{name}"
