"""What stands where in a lock's file, and which of its bytes the kernel locks for what.

Locked bytes (nothing is ever written there):

    epoch's line:  [ ... token ... HELD | MARK | WRITING ]   one line for each of `LINES` epochs
    the row:       [ place 0 | place 1 | place 2 | ...       one for all epochs

Written bytes, in blocks of 512:

    0           header: magic, the epoch, the first place that counts, whether it is being taken
    1 to 16     one for each line: who has it, or had it last, its lease, what was let go last
    17 to 144   who waits, by place
    145 to 160  who took it over from whom, by the token that was lost

A block of a line is written only by who has that line's HELD byte. So a process that has lost the
lock, and does not know it yet, writes nothing that anybody looks at.
"""

import struct
import zlib
from dataclasses import dataclass
from typing import Final, final

MAGIC: Final = b"motorhi2"
MAGIC_BEFORE: Final = b"motorhil"
"""Of a layout that nobody reads any more; such a file is as good as a new one."""

LINES: Final = 16
SPAN: Final = 1 << 57
PLACES: Final = 1 << 62
WAITERS: Final = 128
"""So many who wait are told by name."""
TAKEOVERS: Final = 16

BLOCK: Final = 512
_HEAD: Final = struct.Struct("<8sQ16sIIQQQ")
_TAIL: Final = struct.Struct("<64s96s96s")
_CHECK: Final = struct.Struct("<I")
RECORD_SIZE: Final = _HEAD.size + _TAIL.size + _CHECK.size
NUMBER: Final = struct.Struct("<Q")

EPOCH_AT: Final = 488
"""Of the epoch and, behind it, the first place that counts, and which epoch is being ended."""
EPOCH: Final = struct.Struct("<QQ")
HEADER: Final = struct.Struct("<QQQ")
INTENT_AT: Final = EPOCH_AT + 16

RELEASED_AT: Final = 0
"""In a line's block: the token that was let go last."""
LEASE_AT: Final = 8
"""In a line's block: the lease [ns] (0: none), when it is over (CLOCK_MONOTONIC [ns])."""
LEASE: Final = struct.Struct("<QQ")
RECORD_AT: Final = 24
"""In a line's block: who has the lock, or had it last."""
_LINE: Final = struct.Struct("<QQQ8sQ16s")
LAST_SIZE: Final = _LINE.size

_TAKEOVER_AT: Final = 328
_TAKEOVER: Final = struct.Struct("<QQI64s")


def held_at(epoch: int) -> int:
    """The byte that whoever has the lock in that epoch has locked."""
    return (epoch % LINES + 1) * SPAN - 8


def line_block(epoch: int) -> int:
    """Where the block of an epoch's line begins."""
    return BLOCK * (1 + epoch % LINES)


def waiter_block(place: int) -> int:
    """Where the block of a place begins."""
    return BLOCK * (1 + LINES + place % WAITERS)


def takeover_block(lost: int) -> int:
    """Where the block of a token that was lost begins."""
    return BLOCK * (1 + LINES + WAITERS + lost % TAKEOVERS)


@final
@dataclass(frozen=True, slots=True)
class Record:
    """Who has a lock, or waits for it.

    Attributes:
        number: the token of a holder, the place of a waiter.
        identity: 16 bytes that nobody else ever has.
        pid, uid, born: the process; `born` tells it from a later one of the same pid.
        since_ns, since_utc_ns: since when, of the monotonic clock and of the calendar's.
        program, purpose, label: in words; the label is what is locked.
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

    Attributes: by (who; its label says why), epoch (that it ended: it was done if that is over),
    token (his), lost (the token that ended), from_pid and from_program (whose that was; 0 and "":
    not known).
    """

    by: Record
    epoch: int
    token: int
    lost: int
    from_pid: int
    from_program: str

    @property
    def reason(self) -> str:
        """Why, in words."""
        return self.by.label


def last_of(data: bytes, at: int) -> tuple[int, bytes, bool] | None:
    """(token, identity) of who had it last, and whether it was never let go; of a line's block.

    None: nobody has ever had it.
    """
    if len(data) < at + _LINE.size:
        return None
    released, _, _, magic, token, identity = _LINE.unpack_from(data, at)
    return (token, identity, token != released) if magic == MAGIC else None


def pack_words(program: str, purpose: str, label: str) -> bytes:
    """The words of a record, cut to the room there is."""
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
    """A record as it stands in the file; `process` is (pid, uid, born)."""
    pid, uid, born = process
    head = _HEAD.pack(MAGIC, number, identity, pid, uid, born, since[0], since[1])
    return b"".join((head, words, _CHECK.pack(zlib.crc32(words, zlib.crc32(head)))))


def unpack_record(data: bytes) -> Record | None:
    """None: there is none, or it is just being written."""
    data = data[:RECORD_SIZE]
    if len(data) != RECORD_SIZE or _CHECK.unpack(data[-4:])[0] != zlib.crc32(data[:-4]):
        return None
    _, number, identity, pid, uid, born, since_ns, since_utc_ns = _HEAD.unpack_from(data)
    words = _TAIL.unpack_from(data, _HEAD.size)
    program, purpose, label = (_text(word) for word in words)
    return Record(number, identity, pid, uid, born, since_ns, since_utc_ns, program, purpose, label)


def pack_takeover(record: bytes, epoch: int, token: int, victim: Record | None) -> bytes:
    """A takeover as it stands in the file; `record` is of who took it, by the token lost."""
    pid, program = (0, "") if victim is None else (victim.pid, victim.program)
    return record.ljust(_TAKEOVER_AT, b"\0") + _TAKEOVER.pack(epoch, token, pid, _cut(program, 64))


def unpack_takeover(data: bytes) -> Takeover | None:
    """None: there is none, or it is just being written."""
    record = unpack_record(data)
    if record is None or len(data) < _TAKEOVER_AT + _TAKEOVER.size:
        return None
    epoch, token, pid, program = _TAKEOVER.unpack_from(data, _TAKEOVER_AT)
    return Takeover(record, epoch, token, record.number, pid, _text(program))


def _text(word: bytes) -> str:
    """What somebody wrote, fit for a terminal: on one line, without control characters."""
    text = word.rstrip(b"\0").decode("utf-8", "replace")
    return text if text.isprintable() else "".join(c if c.isprintable() else "?" for c in text)


@final
class Line:
    """What a line's block says.

    Attributes: is_new (nobody has ever had the lock), released (the token that was let go last),
    lease_ns, lease_end_ns, token and identity (of who had it last), record (the same, and more;
    None: it is just being written).
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
