"""One lock between processes, as byte ranges of a file that the kernel locks and unlocks.

The locks are Linux's open file description locks (fcntl(2), F_OFD_SETLK): whatever an open file
has locked the kernel unlocks when its last descriptor is gone, however the process died. Two open
files exclude each other in one process too, so threads need no second lock.

    ... [ _HELD - token ... _HELD ] [ place 0 ] [ place 1 ] [ place 2 ] ...
        whoever has the lock         who waits, in order

- *Who has it* is whoever has locked the byte `_HELD`: one, by the kernel's word, whatever the file
  says. How far the range reaches down is its token, so a reader has it from the kernel.
- *Who waits* has locked one byte, its place, behind every place there was when it came. It is its
  turn when no place before it is locked. A waiter that dies leaves a gap, which nobody waits for.
- Whoever finds the whole row free takes `_HELD` and place 0 in one step.

No step of this is guarded by another lock: a process that is paused in the middle of it stops
nobody but those whom it has to precede.

Whoever lets go says so before, by its token: what was had and not let go was a dead process's.

What is written in the file says who they are. It is believed only as far as the kernel agrees: the
record of the token that is locked, the record of a place that is locked. So it is never stale.
"""

import fcntl
import os
import struct
import threading
import weakref
import zlib
from dataclasses import dataclass
from typing import Final, final

from motorapi.errors import UsageError
from motorapi.lock_directory import LockDirectory

_FLOCK: Final = struct.Struct("@hhqqi0q")  # struct flock: type, whence, start, length, pid
_HELD: Final = (1 << 62) - 1
_PLACES: Final = _HELD + 1
_UNLOCK_ALL: Final = _FLOCK.pack(fcntl.F_UNLCK, os.SEEK_SET, 0, 0, 0)
_ANY: Final = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, _HELD, 0, 0)
_AT_ONCE: Final = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, _HELD, 2, 0)
_HOLD: Final = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, _HELD, 1, 0)

_MAGIC: Final = b"motorhil"
_HEAD: Final = struct.Struct("<8sQ16sIIQQQ")
_TAIL: Final = struct.Struct("<64s96s96s")
_CHECK: Final = struct.Struct("<I")
_RECORD_SIZE: Final = _HEAD.size + _TAIL.size + _CHECK.size
_SLOT: Final = 512
_RELEASED: Final = 504  # the token that was let go last, behind the record
_TOKEN: Final = struct.Struct("<Q")
_SLOTS: Final = 128
"""So many waiters are told by name."""
_READS_MAX: Final = 20


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
    head = _HEAD.pack(_MAGIC, number, identity, pid, uid, born, since[0], since[1])
    return b"".join((head, words, _CHECK.pack(zlib.crc32(words, zlib.crc32(head)))))


def _unpack_record(data: bytes) -> Record | None:
    """None: there is none, or it is just being written."""
    if len(data) != _RECORD_SIZE or _CHECK.unpack(data[-4:])[0] != zlib.crc32(data[:-4]):
        return None
    _, number, identity, pid, uid, born, since_ns, since_utc_ns = _HEAD.unpack_from(data)
    words = _TAIL.unpack_from(data, _HEAD.size)
    program, purpose, label = (word.rstrip(b"\0").decode("utf-8", "replace") for word in words)
    return Record(number, identity, pid, uid, born, since_ns, since_utc_ns, program, purpose, label)


_forking: Final = threading.Lock()
"""Nobody forks between the opening of a file and its being known here."""
_opened: Final["weakref.WeakSet[LockFile]"] = weakref.WeakSet()


@final
class LockFile:
    """One open file of a lock: one who has it, or waits for it. Nothing here waits, but one.

    It is closed, which unlocks, when it is dropped; in a forked child at once, which does not.
    """

    __slots__ = ("__weakref__", "_fd", "name")

    def __init__(self, directory: LockDirectory, name: str) -> None:
        self._fd = -1
        self.name: Final = str(directory.path / name)
        with _forking:
            fd = directory.open(name)
            assert fd is not None
            self._fd = fd
            _opened.add(self)
        magic = os.pread(fd, len(_MAGIC), 0)
        if magic.strip(b"\0") and magic != _MAGIC:
            raise UsageError(f"{self.name}: this is no lock file; remove it")

    def __del__(self) -> None:
        self.close()

    def close(self) -> None:
        """Whatever it has locked is unlocked; closing again does nothing."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    @property
    def is_closed(self) -> bool:
        """Whether it was closed, as it is in a forked child."""
        return self._fd < 0

    @property
    def is_gone(self) -> bool:
        """Whether somebody has removed the file, so that others use another one."""
        return os.fstat(self._fd).st_nlink == 0

    # ---- taking it ----

    def take_at_once(self) -> bool:
        """Whether it was free, nobody waited, and it is taken."""
        fd = self._fd
        if _is_locked(fcntl.fcntl(fd, fcntl.F_OFD_GETLK, _ANY)):
            return False
        return self._try(_AT_ONCE)

    def queue_up(self, at_least: int = 1) -> int:
        """The place taken in the queue: behind everybody who came before.

        Args:
            at_least: a place >= 1 that it is not before.
        """
        place = at_least
        while True:
            place = self._first_free(place)
            if not self._try(_at(place)):
                continue
            above = _find(self._fd, fcntl.F_RDLCK, _PLACES + place + 1, 0)
            if above is None:
                return place
            self.let_go()  # somebody came before us in the meantime

    def take(self, place: int) -> bool:
        """Whether it is the turn of this place, and it is taken."""
        if _find(self._fd, fcntl.F_RDLCK, _PLACES, place) is not None:
            return False
        return self._try(_HOLD)

    def wait_before(self, place: int) -> None:
        """Nobody is before the place any more. The one call that waits, without a limit."""
        whole = _FLOCK.pack(fcntl.F_RDLCK, os.SEEK_SET, _PLACES, place, 0)
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLKW, whole)
        self.let_go()

    def let_go(self) -> None:
        """Nothing is taken, no place is kept."""
        if self._fd >= 0:
            fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, _UNLOCK_ALL)

    def _first_free(self, place: int) -> int:
        while True:
            found = _find(self._fd, fcntl.F_WRLCK, _PLACES + place, 0)
            if found is None:
                return place
            place = found[1] - _PLACES + 1

    def _try(self, lock: bytes) -> bool:
        try:
            fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, lock)
        except (BlockingIOError, PermissionError):
            return False
        return True

    # ---- saying who has it ----

    def last(self) -> tuple[int, bytes, bool]:
        """(token, identity) of who had it last, and whether it died with it."""
        head = os.pread(self._fd, _SLOT, 0)
        if len(head) < _HEAD.size:
            return 0, b"", False
        _, token, identity, *_ = _HEAD.unpack_from(head)
        return token, identity, token != _released(head)

    def tell_holder(self, token: int, record: bytes) -> None:
        """Everybody can read that we have it, and who we are."""
        held = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, _HELD - token, token, 0)
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, held)
        os.pwrite(self._fd, record, 0)

    def tell_release(self, token: int) -> None:
        """Everybody can read that it was let go."""
        if self._fd >= 0:
            os.pwrite(self._fd, _TOKEN.pack(token), _RELEASED)

    def tell_waiter(self, place: int, record: bytes) -> None:
        """Everybody can read that we wait, and who we are."""
        os.pwrite(self._fd, record, _slot(place))


@final
class LockReader:
    """Looks at a lock file without ever taking, or delaying, anything."""

    def __init__(self, fd: int) -> None:
        self._fd = fd

    def close(self) -> None:
        """Closed; closing again does nothing."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def label(self) -> str | None:
        """What the lock is for; None if it was never taken."""
        record = _unpack_record(os.pread(self._fd, _RECORD_SIZE, 0))
        return None if record is None else record.label

    def abandoned(self) -> int:
        """The token of who died with it, if nobody had it since; else 0."""
        data = os.pread(self._fd, _SLOT, 0)
        record = _unpack_record(data[:_RECORD_SIZE])
        if record is None or record.number == _released(data) or self.is_held():
            return 0
        return record.number

    def is_held(self) -> bool:
        """Whether somebody has it."""
        return _find(self._fd, fcntl.F_RDLCK, _HELD, 1) is not None

    def holder(self) -> Record | None:
        """Who has it; None: nobody, or one who has not yet said (see `is_held`)."""
        for _ in range(_READS_MAX):
            found = _find(self._fd, fcntl.F_RDLCK, _HELD, 1)
            if found is None:
                return None
            record = _unpack_record(os.pread(self._fd, _RECORD_SIZE, 0))
            if record is not None and record.number == _HELD - found[0]:
                return record
        return None

    def waiters(self) -> list[tuple[int, Record | None]]:
        """(place, who) of those who wait, in order; None: it has not yet said who."""
        found = []
        for place in self._places(_PLACES + 1, (1 << 63) - 1):
            record = _unpack_record(os.pread(self._fd, _RECORD_SIZE, _slot(place)))
            found.append((place, record if record and record.number == place else None))
        if found and self.is_held() and _find(self._fd, fcntl.F_RDLCK, _PLACES, 1) is None:
            found.pop(0)  # whoever waited for it and has it now keeps its place
        return found

    def _places(self, first: int, end: int) -> list[int]:
        """All places locked in that range; the kernel tells one, in no order."""
        if first >= end:
            return []
        one = _find(self._fd, fcntl.F_RDLCK, first, end - first)
        if one is None:
            return []
        return [*self._places(first, one[0]), one[0] - _PLACES, *self._places(one[1] + 1, end)]


def _released(data: bytes) -> int:
    """The token that was let go last, in what the file begins with."""
    if len(data) < _RELEASED + _TOKEN.size:
        return 0
    token: int = _TOKEN.unpack_from(data, _RELEASED)[0]
    return token


def _at(place: int) -> bytes:
    return _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, _PLACES + place, 1, 0)


def _slot(place: int) -> int:
    return _SLOT * (1 + place % _SLOTS)


def _is_locked(answer: bytes) -> bool:
    kind: int = _FLOCK.unpack(answer)[0]
    return kind != fcntl.F_UNLCK


def _find(fd: int, kind: int, start: int, length: int) -> tuple[int, int] | None:
    """(first, last) byte of a lock there that excludes one of `kind`; None: there is none."""
    asked = _FLOCK.pack(kind, os.SEEK_SET, start, length, 0)
    found, _, first, size, _ = _FLOCK.unpack(fcntl.fcntl(fd, fcntl.F_OFD_GETLK, asked))
    if found == fcntl.F_UNLCK:
        return None
    return first, (first + size if size else 1 << 63) - 1


def _in_child() -> None:
    """A forked child has none of its parent's locks, and must not keep them from being let go."""
    for file in tuple(_opened):
        file.close()
    _opened.clear()
    _forking.release()


os.register_at_fork(
    before=_forking.acquire, after_in_parent=_forking.release, after_in_child=_in_child
)
