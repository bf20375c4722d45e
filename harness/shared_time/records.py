"""Records between a rig and a program in another process that shares its virtual time.

The transport is a UNIX SEQPACKET socket. A message is a record, or a BATCH of records, each after
its length (u16). The first byte of a record is the kind; kinds below 16 are those of a hub
(`motorhil.emulators.simulation.ownership_notice`). All numbers are little-endian. Times are in ns
from the rig's start.

One program runs at a time. The rig's GRANT gives it the turn. It sends frames, opens buses and
starts waits while it has the turn, and gives it back with IDLE. While it waits, the rig calls it
for each frame on its ports, and for each period that it asked for; it answers each message with
IDLE, after what it sends in return. IDLE names the first of its waits whose condition holds.

A program that does nothing when a frame comes but keep it calls the port quiet. The rig keeps such
frames until a wait could end: they come before the next GRANT, or before TRY, which asks whether
they end that wait. If it is the first of the program whose condition holds, the program has the
turn, and says so by TAKEN before anything else; if not, it answers with IDLE.

    program -> rig  JOIN      | version (u16) | name (UTF-8)
                    OPEN      | fd (u8) | bus (UTF-8)
                    CLOSE     | port (u16)
                    SEND      | port | can_frame (16) or canfd_frame (72)
                    NOTICE    | port | OWNS record of the hub
                    EVERY     | id (u32) | period_ns (i64)
                    CANCEL    | id
                    PARTY     | party (u16) | name (UTF-8)
                    WAIT      | wait (u32) | party | flags (u8) | deadline_ns (i64; -1: none)
                    WITHDRAW  | wait
                    IDLE      | wait whose condition holds (0: none)
                    LEAVE
                    CHILD     | pid (u32) | name (UTF-8)    a process that it has started
                    PORT      | port | PortFlags (u8)
                    TAKEN
    rig -> program  WELCOME   | version | now_ns (i64) | seed (i64) | buses (JSON)
                    REFUSED   | reason (UTF-8)
                    OPENED    | port | name (UTF-8)
                    HEARD     | port | time_ns | transmitted (u8) | frame
                    TOLD      | port | time_ns | 0 | error message of its CAN controller
                    EXPIRED   | id | time_ns
                    CHECK     | time_ns               another program has had a turn
                    GRANT     | wait | time_ns | result (u8) | reason (UTF-8)
                    TRY       | wait | time_ns
                    ADMITTED  | reason why the child has not joined, or nothing (UTF-8)
"""

import struct
from collections.abc import Iterator, Sequence
from enum import IntEnum, IntFlag
from typing import Final, final

VERSION: Final = 2
RECORD_MAX: Final = 65_536
NO_WAIT: Final = 0
NO_DEADLINE: Final = -1

BATCH: Final = 15
JOIN: Final = 16
OPEN: Final = 17
CLOSE: Final = 18
SEND: Final = 19
NOTICE: Final = 20
EVERY: Final = 21
CANCEL: Final = 22
PARTY: Final = 23
WAIT: Final = 24
WITHDRAW: Final = 25
IDLE: Final = 26
LEAVE: Final = 27
CHILD: Final = 28
PORT: Final = 29
TAKEN: Final = 30
WELCOME: Final = 32
REFUSED: Final = 33
OPENED: Final = 34
HEARD: Final = 35
TOLD: Final = 36
EXPIRED: Final = 37
CHECK: Final = 38
GRANT: Final = 39
ADMITTED: Final = 40
TRY: Final = 41

NUMBERED: Final = struct.Struct("<BH")
"""Kind and a port, a party, a version or the flag of OPEN; text or a frame follows."""
COUNTED: Final = struct.Struct("<BI")
"""Kind and the number of a wait, a period or a process; text may follow."""
PERIOD: Final = struct.Struct("<BIq")
"""EVERY, EXPIRED and TRY: kind, number, and a time or duration [ns]."""
WAITING: Final = struct.Struct("<BIHBq")
"""WAIT: kind, wait, party, flags, deadline [ns]."""
DELIVERY: Final = struct.Struct("<BHqB")
"""HEARD and TOLD: kind, port, time [ns], transmitted; the frame follows."""
CALL: Final = struct.Struct("<Bq")
"""CHECK: kind and time [ns]."""
TURN: Final = struct.Struct("<BIqB")
"""GRANT: kind, wait, time [ns], result; a reason follows."""
PORT_FLAGS: Final = struct.Struct("<BHB")
"""PORT: kind, port, flags."""
WELCOMED: Final = struct.Struct("<BHqq")
"""WELCOME: kind, version, time [ns], seed; the buses follow."""


@final
class WaitFlags(IntFlag):
    """Ends of a wait beside its deadline and the events of its own process."""

    PARTIES = 1
    PROCESSES = 2
    DEAF = 4
    """No frame of a quiet port ends it."""


@final
class PortFlags(IntFlag):
    """Uses that a program makes of the frames of a port."""

    QUIET = 1
    """The program keeps them until one of its parties looks for them."""
    OTHERS = 2
    """The program has no use for those that it has sent itself."""


@final
class Result(IntEnum):
    """How a wait has ended."""

    EXPIRED = 0
    HOLDS = 1
    REFUSED = 2
    INTERRUPTED = 3


LENGTH: Final = struct.Struct("<H")
"""Length of a record in a BATCH."""
_BATCH: Final = bytes([BATCH])

LengthError: Final = struct.error
"""Raised for a record that is too short or too long for its kind."""


@final
class RecordError(Exception):
    """A record that the protocol does not allow; the message says which."""


def batch(several: Sequence[bytes]) -> bytes:
    """Return these records as one message, of at most RECORD_MAX bytes."""
    if len(several) == 1:
        return several[0]
    parts = [_BATCH]
    for record in several:
        parts += (LENGTH.pack(len(record)), record)
    return b"".join(parts)


def split(message: bytes) -> Iterator[bytes]:
    """Yield the records of a message that is not empty.

    Raises:
        RecordError: a length is 0, or beyond the message.
    """
    if message[0] != BATCH:
        yield message
        return
    at, end = 1, len(message)
    while at < end:
        size = LENGTH.unpack_from(message, at)[0] if at + 2 <= end else 0
        if size == 0 or at + 2 + size > end:
            raise RecordError(f"batch of {end} bytes, record at {at}: {size} bytes long")
        yield message[at + 2 : at + 2 + size]
        at += 2 + size


def numbered(kind: int, number: int, text: str = "") -> bytes:
    """Pack a record of a number and a text."""
    return NUMBERED.pack(kind, number) + text.encode()


def text_of(record: bytes, size: int) -> str:
    """Return the text that follows the first `size` bytes."""
    return record[size:].decode("utf-8", "replace")
