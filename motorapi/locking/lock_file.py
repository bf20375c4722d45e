"""Lock file: a lock between processes, as byte ranges locked by the kernel.

The locks are Linux open file description locks (fcntl(2), F_OFD_SETLK). The kernel releases all
locks of an open file with its last descriptor, however the process died. Two open files exclude
each other in one process too, so threads need no second lock.

- The *holder* has locked byte HELD of the present *epoch*. The kernel guarantees that there is only
  one, whatever the file says. The length of the range below HELD is its token, so a reader gets it
  from the kernel.
- A *waiter* has locked one byte, its place, behind all places that existed when it arrived. Its
  turn comes when no place before it is locked. A waiter that dies leaves a gap, which delays no
  other waiter.
- A process that finds the whole queue empty takes token, HELD and MARK in one step. A process that
  has waited keeps its place while it holds the lock. So there is always a byte for which the next
  one can wait.

No step is guarded by another lock. A process paused in the middle of a step delays only those
behind it.

No process can unlock the bytes of a living process. Therefore a takeover does not take the byte: it
advances the *epoch*, and with it the byte that counts (`motorhil.motorapi.locking.takeover`). The
byte of an earlier epoch has no effect. The epoch check and actions that depend on it are atomic: a
commanding write requires a shared lock of WRITING, an epoch change an exclusive one. An acquisition
is an attempt, which a takeover under way defeats:

- In one step, it locks the token after the last one, HELD and MARK. Then it asks for locks of
  WRITING and of the queue, and reads epoch and last token again. It is the holder if there are no
  locks, and nothing has changed. A takeover that begins later takes the lock from it. An attempt
  with a token that was given meanwhile ends there; a takeover leaves it alone.
- After a wait, it locks HELD. With WRITING shared, it checks the epoch and locks the token, which
  makes it the holder. HELD alone is an attempt.

A release is announced with the token before it happens. A lock without this announcement was held
by a process that died.

The records in the file identify holder and waiters. They are used only if the kernel confirms them:
the record of the locked token, the record of a locked place. So they are never stale.

Locked bytes (never written):

    line of an epoch:  [ ... token ... HELD | MARK | WRITING ]   one for each of `LINES` epochs
    queue:             [ place 0 | place 1 | place 2 | ...       one for all epochs

Written bytes, in blocks of 512:

    0           header: magic, check value, epoch, the first valid place
    1 to 16     one per line: present or last holder, its lease, the last released token
    17 to 144   waiters, by place
    145 to 160  takeovers, by the lost token

The block of a line is written only by the holder of the HELD byte of that line. So a process that
has lost the lock without knowing it writes nothing that others read.
"""

import fcntl
import os
import struct
import threading
import time
import weakref
import zlib
from collections.abc import Callable
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.witness import Rival, Witness

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
"""Offset of the epoch, followed by the first valid place."""
_EPOCH: Final = struct.Struct("<QQ")
_CHECKED_AT: Final = EPOCH_AT - 8
"""Offset of the check value of epoch and first place, which are before the epoch."""
_CHECKED: Final = struct.Struct("<QQQ")
_READS_MAX: Final = 100
"""The number of reads before an epoch counts as damaged: a read can meet a write."""

RELEASED_AT: Final = 0
"""In the block of a line: the last released token."""
LEASE_AT: Final = 8
"""In the block of a line: the lease [ns] (0: none) and its end (CLOCK_MONOTONIC [ns])."""
LEASE: Final = struct.Struct("<QQ")
NO_LEASE: Final = LEASE.pack(0, 0)
RECORD_AT: Final = 24
"""In the block of a line: the record of the present or last holder."""
_LINE: Final = struct.Struct("<QQQ8sQ16s")

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


def first_token() -> int:
    """Return a token for a new file, greater than any in a file removed before."""
    return time.time_ns() // 1000


def takeover_block(lost: int) -> int:
    """Return the offset of the block of a lost token."""
    return BLOCK * (1 + LINES + WAITERS + lost % TAKEOVERS)


@final
@frozen
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
@frozen
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
    told = _HEAD.pack(MAGIC, number, identity, *process, *since) + words
    return told + _CHECK.pack(zlib.crc32(told))


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
        self.token: int = 0
        self.identity: bytes = b""
        self.lease_ns: int = 0
        self.lease_end_ns: int = 0
        self.released: int = 0
        self.record: Final = None if self.is_new else unpack_record(data[RECORD_AT:])
        if not self.is_new:
            told = _LINE.unpack_from(data)
            self.released, self.lease_ns, self.lease_end_ns, _, self.token, self.identity = told


_FLOCK: Final = struct.Struct("@hhqqi0q")  # struct flock: type, whence, start, length, pid
_UNLOCKED: Final = struct.pack("@h", fcntl.F_UNLCK)
_UNLOCK_ALL: Final = _FLOCK.pack(fcntl.F_UNLCK, os.SEEK_SET, 0, 0, 0)


def flock(kind: int, start: int, length: int) -> bytes:
    """Return the kernel's struct flock of a range; length 0: to the end."""
    return _FLOCK.pack(kind, os.SEEK_SET, start, length, 0)


def find(fd: int, kind: int, start: int, length: int) -> tuple[int, int] | None:
    """Return (first, last) byte of a lock in the range that excludes one of `kind`, or None."""
    asked = flock(kind, start, length)
    found, _, first, size, _ = _FLOCK.unpack(fcntl.fcntl(fd, fcntl.F_OFD_GETLK, asked))
    if found == fcntl.F_UNLCK:
        return None
    return first, (first + size if size else 1 << 63) - 1


def first_places(fd: int, start: int, end: int) -> list[int]:
    """Return all locked places in a range of bytes, in order; the kernel reports one at a time."""
    if start >= end:
        return []
    one = find(fd, fcntl.F_RDLCK, start, end - start)
    if one is None:
        return []
    before, behind = first_places(fd, start, one[0]), first_places(fd, one[1] + 1, end)
    return [*before, one[0] - PLACES, *behind]


_HOLD: Final = tuple(flock(fcntl.F_WRLCK, held_at(line), 1) for line in range(LINES))
_DROP: Final = tuple(flock(fcntl.F_UNLCK, SPAN * line, SPAN - 5) for line in range(LINES))
_WRITE: Final = tuple(flock(fcntl.F_RDLCK, held_at(line) + 2, 1) for line in range(LINES))
_WRITE_ALONE: Final = tuple(flock(fcntl.F_WRLCK, held_at(line) + 2, 1) for line in range(LINES))
_WRITTEN: Final = tuple(flock(fcntl.F_UNLCK, held_at(line) + 2, 1) for line in range(LINES))
_BESIDE: Final = tuple(flock(fcntl.F_WRLCK, held_at(line) + 2, 0) for line in range(LINES))
"""WRITING, the lines behind it, and the queue."""

_forking: Final = threading.Lock()
"""Guard against a fork between the opening of a file and its registration here."""
_opened: Final["weakref.WeakSet[LockFile]"] = weakref.WeakSet()


def require_lock(fd: int, name: str) -> None:
    """Raise UsageError if the open file is not a lock file."""
    magic = os.pread(fd, len(MAGIC), 0)
    if magic.strip(b"\0") and magic not in (MAGIC, MAGIC_BEFORE):
        raise UsageError(f"{name}: not a lock file; remove it")


def _check_of(epoch: int, base: int) -> int:
    return zlib.crc32(_EPOCH.pack(epoch, base)) ^ zlib.crc32(bytes(_EPOCH.size))  # 0 of a new file


def write_epoch(fd: int, epoch: int, base: int) -> None:
    """Publish an epoch and its first valid place, in one write."""
    os.pwrite(fd, _CHECKED.pack(_check_of(epoch, base), epoch, base), _CHECKED_AT)


def read_epoch(fd: int, name: str) -> tuple[int, int]:
    """Return (epoch, its first valid place) of an open lock file.

    Raises:
        UsageError: the file is damaged; says how to replace it.
    """
    epoch = 0
    for _ in range(_READS_MAX):
        data = os.pread(fd, _CHECKED.size, _CHECKED_AT)
        if len(data) < _CHECKED.size:
            is_new = not os.pread(fd, len(MAGIC), 0).strip(b"\0")
            if is_new and find(fd, fcntl.F_RDLCK, SPAN, PLACES - SPAN) is None:
                return 0, 0
            problem = f"the file ends within its header of {BLOCK} bytes, and was in use"
        else:
            check, epoch, base = _CHECKED.unpack(data)
            if check == _check_of(epoch, base):
                return epoch, base
            problem = f"epoch {epoch} and its check value {check:X}h do not match"
        os.sched_yield()
    raise UsageError(
        f"{name}: damaged lock file; {problem}; end the programs that use this lock,"
        " then remove the file"
    )


@final
class LockFile:
    """One open file of a lock, for a holder or a waiter. Only the two wait methods block.

    Garbage collection closes the file, which unlocks; in a forked child it is closed at once, which
    does not unlock.

    Attributes:
        epoch: as read last; for a holder, the epoch of its lock.
        base: the first valid place of the epoch: earlier ones belong to processes that lost the
            lock.
        token: the holder's own token, while this file holds the lock without a takeover.
    """

    __slots__ = (
        "__weakref__",
        "_epoch_bytes",
        "_fd",
        "_has_waited",
        "_held",
        "_last",
        "_line_at",
        "_next_token",
        "_number",
        "_row",
        "_witness",
        "base",
        "epoch",
        "name",
        "token",
    )

    def __init__(self, directory: LockDirectory, name: str) -> None:
        self._fd = -1
        self._has_waited = False  # recently; others may wait now
        self._last: tuple[int, bytes, bool] | None = None
        self.token: int = 0
        self._next_token = 0  # expected, if no other process was the last holder; 0: unknown
        self._witness: Witness | None = None
        self.name: Final = str(directory.path / name)
        with _forking:
            fd = directory.open(name)
            assert fd is not None
            self._fd = fd
            _opened.add(self)
        require_lock(fd, self.name)
        self.epoch: int
        self.base: int
        self._note_epoch(0, 0)
        self.look_up()

    def __del__(self) -> None:
        self.close()

    def close(self) -> None:
        """Close the file and release its locks; closing again does nothing."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            if self._witness is not None:
                self._witness.close()
            os.close(fd)

    @property
    def is_closed(self) -> bool:
        """True if the file was closed, as in a forked child."""
        return self._fd < 0

    @property
    def is_new(self) -> bool:
        """True if the lock was never held."""
        return os.fstat(self._fd).st_size == 0

    @property
    def is_gone(self) -> bool:
        """True if the file was removed, so that other processes use another one."""
        return os.fstat(self._fd).st_nlink == 0

    @property
    def is_current(self) -> bool:
        """True if the epoch is still the one that was read last."""
        data = os.pread(self._fd, NUMBER.size, EPOCH_AT)
        return data == self._epoch_bytes or not (data or self.epoch)

    def look_up(self) -> bool:
        """Read the epoch. Return True if it has changed."""
        epoch, base = read_epoch(self._fd, self.name)
        if epoch == self.epoch and base == self.base:
            return False
        self._note_epoch(epoch, base)
        return True

    def advance(self, epoch: int, base: int) -> None:
        """Publish an epoch whose HELD byte this file has locked.

        It is not read again: another process may already have taken over from this one.
        """
        write_epoch(self._fd, epoch, base)
        self._note_epoch(epoch, base)

    def _note_epoch(self, epoch: int, base: int) -> None:
        self.epoch, self.base = epoch, base
        self._number, self._line_at = epoch % LINES, line_block(epoch)
        self._held = held_at(epoch)
        self._epoch_bytes = NUMBER.pack(epoch)
        self._row = flock(fcntl.F_WRLCK, PLACES + base, 0)

    # ---- acquisition ----

    def take_at_once(self) -> bool:
        """Take the lock if it is free and no process waits. Return True on success."""
        while self._has_waited and self._is_locked(self._row):
            if not self.look_up():
                return False  # without an attempt, which would be in the way of the first waiter
        self._has_waited = False
        return self._take_free(self._row)

    def take_in_front(self) -> bool:
        """Take the lock if it is free, ahead of all waiters. Return True on success."""
        return self._take_free(None)

    def _take_free(self, queue: bytes | None) -> bool:
        """Lock token, HELD and MARK. Return True if no process is in the queue."""
        while True:
            token = self._next_token
            if not token:
                self._read_last()
                token = self._token_after()
            if self._try(_FLOCK.pack(fcntl.F_WRLCK, 0, self._held - token, token + 2, 0)):
                number = self._number
                is_free = not self._is_locked(_BESIDE[number]) or not (
                    self._is_locked(_WRITE[number])
                    or (queue is not None and self._is_locked(queue))
                )
                is_current, last = self._read_last(), self._last
                if is_free and is_current:
                    if last is None or last[0] == token - 1:
                        is_mine = last is not None and last[0] == self.token
                        self._next_token = token + 1 if is_mine else 0
                        self.token = token
                        return True
                    self._next_token = last[0] + 1
                self._try(_DROP[number])
                if is_free and is_current:
                    continue  # another process has had the lock in between
            if not self.look_up():
                return False

    def _read_last(self) -> bool:
        """Read the last holder. Return True if the epoch is still the one that was read last."""
        begin = self._line_at - EPOCH_AT
        data = os.pread(self._fd, begin + RECORD_AT + _LINE.size, EPOCH_AT)
        self._last = last_of(data, begin)
        return data.startswith(self._epoch_bytes) or not (data or self.epoch)

    def _token_after(self) -> int:
        return 1 + (first_token() if self._last is None else self._last[0])

    def queue_up(self, at_least: int = 1) -> int:
        """Take and return a place in the queue, behind all earlier ones.

        Args:
            at_least: the lowest acceptable place, >= 1.
        """
        place = at_least
        while True:
            place = self._first_free(max(place, self.base))
            if not self._try(flock(fcntl.F_WRLCK, PLACES + place, 1)):
                continue
            if find(self._fd, fcntl.F_RDLCK, PLACES + place + 1, 0) is None:
                self.look_up()
                if place >= self.base:
                    return place
            self.let_go()  # another waiter arrived before us in the meantime

    def take(self, place: int) -> bool:
        """Take the lock if it is the turn of this place. Return True on success."""
        self._has_waited = True
        return self.is_first(place) and self._take_turn()

    def is_first(self, place: int) -> bool:
        """Return True if no process waits before this place."""
        while place > self.base:
            if find(self._fd, fcntl.F_RDLCK, PLACES + self.base, place - self.base) is None:
                break
            if not self.look_up():
                return False
        return True

    def _take_turn(self) -> bool:
        """Lock HELD of the present epoch, with a place. Return True on success."""
        while True:
            number = self._number
            if self._try(_HOLD[number]):
                if self._try(_WRITE[number]) and self._become_holder():
                    return True
                self._try(_DROP[number])  # a takeover is under way, or was quicker
            if not self.look_up():
                return False

    def _become_holder(self) -> bool:
        """Become the holder, with HELD and WRITING locked; False: the epoch is over."""
        if not self._read_last():
            return False
        self._next_token, self.token = 0, self._token_after()
        self._try(flock(fcntl.F_WRLCK, self._held - self.token, self.token))
        self._try(_WRITTEN[self._number])
        return True

    def wait_before(self, place: int) -> None:
        """Wait, without a timeout, until no process is before the place."""
        if place > self.base:
            whole = flock(fcntl.F_RDLCK, PLACES + self.base, place - self.base)
            fcntl.fcntl(self._fd, fcntl.F_OFD_SETLKW, whole)
            self.let_go()

    def wait_for_mark(self) -> None:
        """Wait until the process that took the lock of the known epoch at once has released it."""
        mark = flock(fcntl.F_RDLCK, self._held + 1, 1)
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLKW, mark)
        self.let_go()

    def let_go(self) -> None:
        """Release the lock and the place."""
        self._last = None
        fd = self._fd
        if fd >= 0:
            if self._witness is not None:
                self._witness.drop()
            fcntl.fcntl(fd, fcntl.F_OFD_SETLK, _UNLOCK_ALL)

    def let_go_of_places(self) -> None:
        """Release the place, but keep the lock."""
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, flock(fcntl.F_UNLCK, PLACES, 0))

    def _first_free(self, place: int) -> int:
        while True:
            found = find(self._fd, fcntl.F_WRLCK, PLACES + place, 0)
            if found is None:
                return place
            place = found[1] - PLACES + 1

    def _is_locked(self, wanted: bytes) -> bool:
        """Return True if another open file has a lock that excludes the wanted one."""
        return not fcntl.fcntl(self._fd, fcntl.F_OFD_GETLK, wanted).startswith(_UNLOCKED)

    def _try(self, lock: bytes) -> bool:
        try:
            fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, lock)
        except (BlockingIOError, PermissionError):
            return False
        return True

    # ---- exclusion of other files under the same name ----

    def witness(self, is_live: Callable[[Rival], bool] | None = None) -> bool:
        """Witness that this file is held. Return False if another file of the name is held.

        The holder calls it before it checks `is_gone`. See `Witness.set`.
        """
        if self._witness is None:
            with _forking:  # a child that shares the descriptor would keep the witness alive
                self._witness = Witness(self.name, os.fstat(self._fd).st_ino)
        return self._witness.set(is_live)

    def drop_witness(self) -> None:
        """Withdraw the witness of a lock that was lost."""
        if self._witness is not None:
            self._witness.drop()

    # ---- records of holder and waiters ----

    def last(self) -> tuple[int, bytes, bool] | None:
        """Return (token, identity, True if it died with the lock) of the previous holder.

        None: no previous holder is known.
        """
        return self._last

    def line(self) -> Line:
        """Return the block of the epoch that was read last."""
        return Line(os.pread(self._fd, BLOCK, self._line_at))

    def tell_holder(self, record: bytes, lease: bytes = NO_LEASE) -> None:
        """Publish the record of this process as the holder."""
        os.pwrite(self._fd, lease + record, self._line_at + LEASE_AT)
        if self._last is None:
            os.pwrite(self._fd, MAGIC, 0)

    def tell_release(self, token: int) -> None:
        """Publish the release of the lock."""
        if self._fd >= 0:
            os.pwrite(self._fd, NUMBER.pack(token), self._line_at + RELEASED_AT)

    def tell_waiter(self, place: int, record: bytes) -> None:
        """Publish the record of this process as a waiter."""
        os.pwrite(self._fd, record, waiter_block(place))

    def tell_lease(self, lease_ns: int, end_ns: int) -> None:
        """Publish the lease, inside a write section."""
        os.pwrite(self._fd, LEASE.pack(lease_ns, end_ns), self._line_at + LEASE_AT)

    # ---- write sections, which block takeovers ----

    def try_write(self) -> bool:
        """Block takeovers until `end_write`. Return False during a takeover."""
        return self._fd >= 0 and self._try(_WRITE[self._number])

    def end_write(self) -> None:
        """Permit takeovers again."""
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, _WRITTEN[self._number])

    def try_write_alone(self) -> bool:
        """Exclude all other writers of the known epoch. Return True on success."""
        return self._try(_WRITE_ALONE[self._number])

    @property
    def fd(self) -> int:
        """The descriptor, for `motorhil.motorapi.locking.takeover`."""
        return self._fd


def _in_child() -> None:
    """Close all lock files in a forked child, which must not keep the parent's locks alive."""
    for file in tuple(_opened):
        file.close()
    _opened.clear()
    _forking.release()


os.register_at_fork(
    before=_forking.acquire, after_in_parent=_forking.release, after_in_child=_in_child
)
