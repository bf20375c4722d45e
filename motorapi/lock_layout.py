"""Layout of a lock file: locked byte ranges and written blocks.

Locked bytes (never written):

    line of an epoch:  [ ... token ... HELD | MARK | WRITING ]   one for each of `LINES` epochs
    queue:             [ place 0 | place 1 | place 2 | ...       one for all epochs

Written bytes, in blocks of 512:

    0           header: magic, the epoch, the first valid place, the epoch being ended
    1 to 16     one per line: present or last holder, its lease, the last released token
    17 to 144   waiters, by place
    145 to 160  takeovers, by the lost token

The block of a line is written only by the holder of the HELD byte of that line. So a process that
has lost the lock without knowing it writes nothing that others read.
"""

import struct
import zlib
from dataclasses import dataclass
from typing import Final, final

MAGIC: Final = b"motorhi2"
MAGIC_BEFORE: Final = b"motorhil"
"""Magic of an obsolete layout; such a file is treated as new."""

LINES: Final = 16
SPAN: Final = 1 << 57
PLACES: Final = 1 << 62
WAITERS: Final = 128
"""The number of waiters recorded by name."""
TAKEOVERS: Final = 16

BLOCK: Final = 512
_HEAD: Final = struct.Struct("<8sQ16sIIQQQ")
_TAIL: Final = struct.Struct("<64s96s96s")
_CHECK: Final = struct.Struct("<I")
RECORD_SIZE: Final = _HEAD.size + _TAIL.size + _CHECK.size
NUMBER: Final = struct.Struct("<Q")

EPOCH_AT: Final = 488
"""Offset of the epoch, followed by the first valid place and the epoch being ended."""
EPOCH: Final = struct.Struct("<QQ")
HEADER: Final = struct.Struct("<QQQ")
INTENT_AT: Final = EPOCH_AT + 16

RELEASED_AT: Final = 0
"""In the block of a line: the last released token."""
LEASE_AT: Final = 8
"""In the block of a line: the lease [ns] (0: none) and its end (CLOCK_MONOTONIC [ns])."""
LEASE: Final = struct.Struct("<QQ")
RECORD_AT: Final = 24
"""In the block of a line: the record of the present or last holder."""
_LINE: Final = struct.Struct("<QQQ8sQ16s")
LAST_SIZE: Final = _LINE.size

_TAKEOVER_AT: Final = 328
_TAKEOVER: Final = struct.Struct("<QQI64s")


def held_at(epoch: int) -> int:
    """Return the byte that the holder of the lock in that epoch has locked."""
    return (epoch % LINES + 1) * SPAN - 8


def line_block(epoch: int) -> int:
    """Return the offset of the block of an epoch's line."""
    return BLOCK * (1 + epoch % LINES)


def waiter_block(place: int) -> int:
    """Return the offset of the block of a place."""
    return BLOCK * (1 + LINES + place % WAITERS)


def takeover_block(lost: int) -> int:
    """Return the offset of the block of a lost token."""
    return BLOCK * (1 + LINES + WAITERS + lost % TAKEOVERS)


@final
@dataclass(frozen=True, slots=True)
class Record:
    """The record of a holder or a waiter.

    Attributes:
        number: the token of a holder, the place of a waiter.
        identity: 16 unique bytes.
        pid, uid, born: the process; `born` distinguishes it from a later one of the same pid.
        since_ns, since_utc_ns: since when, by the monotonic and the calendar clock.
        program, purpose, label: in words; the label names the locked object.
    """

    number: int
    identity: bytes
    pid: int
    uid: int
    born: int
    since_ns: int
    since_utc_ns: int
    program: str
    purpose: str
    label: str


@final
@dataclass(frozen=True, slots=True)
class Takeover:
    """One takeover of a lock.

    Attributes: by (the new holder; its label is the reason), epoch (the epoch that it ended; done
    if that is over), token (of the new holder), lost (the token that ended), from_pid and
    from_program (the former holder; 0 and "": unknown).
    """

    by: Record
    epoch: int
    token: int
    lost: int
    from_pid: int
    from_program: str

    @property
    def reason(self) -> str:
        """The reason, in words."""
        return self.by.label


def last_of(data: bytes, at: int) -> tuple[int, bytes, bool] | None:
    """Return (token, identity, True if never released) of the last holder, from a line's block.

    None: the lock was never held.
    """
    if len(data) < at + _LINE.size:
        return None
    released, _, _, magic, token, identity = _LINE.unpack_from(data, at)
    return (token, identity, token != released) if magic == MAGIC else None


def pack_words(program: str, purpose: str, label: str) -> bytes:
    """Pack the words of a record, cut to the available space."""
    return _TAIL.pack(_cut(program, 64), _cut(purpose, 96), _cut(label, 96))


def _cut(text: str, size: int) -> bytes:
    return text.encode("utf-8", "replace")[:size].decode("utf-8", "ignore").encode()


def pack_record(
    number: int,
    identity: bytes,
    process: tuple[int, int, int],
    since: tuple[int, int],
    words: bytes,
) -> bytes:
    """Pack a record for the file; `process` is (pid, uid, born)."""
    pid, uid, born = process
    head = _HEAD.pack(MAGIC, number, identity, pid, uid, born, since[0], since[1])
    return b"".join((head, words, _CHECK.pack(zlib.crc32(words, zlib.crc32(head)))))


def unpack_record(data: bytes) -> Record | None:
    """Return the record, or None if there is none or it is being written."""
    data = data[:RECORD_SIZE]
    if len(data) != RECORD_SIZE or _CHECK.unpack(data[-4:])[0] != zlib.crc32(data[:-4]):
        return None
    _, number, identity, pid, uid, born, since_ns, since_utc_ns = _HEAD.unpack_from(data)
    words = _TAIL.unpack_from(data, _HEAD.size)
    program, purpose, label = (_text(word) for word in words)
    return Record(number, identity, pid, uid, born, since_ns, since_utc_ns, program, purpose, label)


def pack_takeover(record: bytes, epoch: int, token: int, victim: Record | None) -> bytes:
    """Pack a takeover for the file; `record` describes the new holder, under the lost token."""
    pid, program = (0, "") if victim is None else (victim.pid, victim.program)
    return record.ljust(_TAKEOVER_AT, b"\0") + _TAKEOVER.pack(epoch, token, pid, _cut(program, 64))


def unpack_takeover(data: bytes) -> Takeover | None:
    """Return the takeover, or None if there is none or it is being written."""
    record = unpack_record(data)
    if record is None or len(data) < _TAKEOVER_AT + _TAKEOVER.size:
        return None
    epoch, token, pid, program = _TAKEOVER.unpack_from(data, _TAKEOVER_AT)
    return Takeover(record, epoch, token, record.number, pid, _text(program))


def _text(word: bytes) -> str:
    """Return foreign text fit for a terminal: on one line, without control characters."""
    text = word.rstrip(b"\0").decode("utf-8", "replace")
    return text if text.isprintable() else "".join(c if c.isprintable() else "?" for c in text)


@final
class Line:
    """The content of a line's block.

    Attributes: is_new (the lock was never held), released (the last released token), lease_ns,
    lease_end_ns, token and identity (of the last holder), record (its whole record; None: being
    written).
    """

    __slots__ = (
        "identity",
        "is_new",
        "lease_end_ns",
        "lease_ns",
        "record",
        "released",
        "token",
    )

    def __init__(self, data: bytes) -> None:
        self.is_new: Final = len(data) < _LINE.size or data[RECORD_AT:].find(MAGIC) != 0
        self.token, self.identity = 0, b""
        self.lease_ns = self.lease_end_ns = self.released = 0
        self.record: Final = None if self.is_new else unpack_record(data[RECORD_AT:])
        if not self.is_new:
            told = _LINE.unpack_from(data)
            self.released, self.lease_ns, self.lease_end_ns, _, self.token, self.identity = told
