"""One lock between processes, as byte ranges of a file that the kernel locks and unlocks.

The locks are Linux's open file description locks (fcntl(2), F_OFD_SETLK): whatever an open file
has locked the kernel unlocks when its last descriptor is gone, however the process died. Two open
files exclude each other in one process too, so threads need no second lock. Which byte means what
is in `motorapi.lock_layout`.

- *Who has it* is whoever has locked the byte HELD of the present *epoch*: one, by the kernel's
  word, whatever the file says. How far the range reaches down is its token, so a reader has it from
  the kernel.
- *Who waits* has locked one byte, its place, behind every place there was when it came. It is its
  turn when no place before it is locked. A waiter that dies leaves a gap, which nobody waits for.
- Whoever finds the whole row free takes HELD and MARK in one step. Whoever has waited keeps its
  place while it has the lock. So there is always a byte that the next one can wait for.

No step of this is guarded by another lock: a process that is paused in the middle of it stops
nobody but those whom it has to precede.

Nobody can unlock what a living process has locked. So it is not the byte that is taken over from
it: the *epoch* moves on, and with it the byte that counts (`motorapi.lock_takeover`). Who has the
byte of an epoch that is over has nothing. Whether the epoch is over, and what may be done only
while it is not, are settled together: a commanding write is made with WRITING locked, shared; the
epoch is moved with WRITING locked for oneself.

Whoever lets go says so before, by its token: what was had and not let go was a dead process's.

What is written in the file says who they are. It is believed only as far as the kernel agrees: the
record of the token that is locked, the record of a place that is locked. So it is never stale.
"""

import fcntl
import os
import struct
import threading
import weakref
from typing import Final, final

from motorapi.errors import UsageError
from motorapi.lock_directory import LockDirectory
from motorapi.lock_layout import (
    BLOCK,
    EPOCH,
    EPOCH_AT,
    HEADER,
    LAST_SIZE,
    LEASE,
    LEASE_AT,
    LINES,
    MAGIC,
    MAGIC_BEFORE,
    NUMBER,
    PLACES,
    RELEASED_AT,
    Line,
    held_at,
    last_of,
    line_block,
    waiter_block,
)

_FLOCK: Final = struct.Struct("@hhqqi0q")  # struct flock: type, whence, start, length, pid
_UNLOCK_ALL: Final = _FLOCK.pack(fcntl.F_UNLCK, os.SEEK_SET, 0, 0, 0)


def flock(kind: int, start: int, length: int) -> bytes:
    """What the kernel is told of a range; of length 0: to the end."""
    return _FLOCK.pack(kind, os.SEEK_SET, start, length, 0)


def find(fd: int, kind: int, start: int, length: int) -> tuple[int, int] | None:
    """(first, last) byte of a lock there that excludes one of `kind`; None: there is none."""
    asked = flock(kind, start, length)
    found, _, first, size, _ = _FLOCK.unpack(fcntl.fcntl(fd, fcntl.F_OFD_GETLK, asked))
    if found == fcntl.F_UNLCK:
        return None
    return first, (first + size if size else 1 << 63) - 1


def first_places(fd: int, start: int, end: int) -> list[int]:
    """All places locked in a range of bytes, in order; the kernel tells one at a time, in none."""
    if start >= end:
        return []
    one = find(fd, fcntl.F_RDLCK, start, end - start)
    if one is None:
        return []
    before, behind = first_places(fd, start, one[0]), first_places(fd, one[1] + 1, end)
    return [*before, one[0] - PLACES, *behind]


_AT_ONCE: Final = tuple(flock(fcntl.F_WRLCK, held_at(line), 2) for line in range(LINES))
_HOLD: Final = tuple(flock(fcntl.F_WRLCK, held_at(line), 1) for line in range(LINES))
_DROP: Final = tuple(flock(fcntl.F_UNLCK, held_at(line), 3) for line in range(LINES))
_WRITE: Final = tuple(flock(fcntl.F_RDLCK, held_at(line) + 2, 1) for line in range(LINES))
_WRITE_ALONE: Final = tuple(flock(fcntl.F_WRLCK, held_at(line) + 2, 1) for line in range(LINES))
_WRITTEN: Final = tuple(flock(fcntl.F_UNLCK, held_at(line) + 2, 1) for line in range(LINES))
_NO_LEASE: Final = LEASE.pack(0, 0)
_NOTHING: Final = (0, 0, 0)
_LAST_SIZE: Final = HEADER.size + LAST_SIZE

_forking: Final = threading.Lock()
"""Nobody forks between the opening of a file and its being known here."""
_opened: Final["weakref.WeakSet[LockFile]"] = weakref.WeakSet()


def require_lock(fd: int, name: str) -> None:
    """Raises UsageError if what is open here is no lock file."""
    magic = os.pread(fd, len(MAGIC), 0)
    if magic.strip(b"\0") and magic not in (MAGIC, MAGIC_BEFORE):
        raise UsageError(f"{name}: this is no lock file; remove it")


@final
class LockFile:
    """One open file of a lock: one who has it, or waits for it. Nothing here waits, but two.

    It is closed, which unlocks, when it is dropped; in a forked child at once, which does not.

    Attributes:
        epoch: as looked up last; once it is taken, the one in which it was.
        base: the first place that counts in it: those before are of who lost the lock.
    """

    __slots__ = ("__weakref__", "_epoch_bytes", "_fd", "_last", "_row", "base", "epoch", "name")

    def __init__(self, directory: LockDirectory, name: str) -> None:
        self._fd = -1
        self._last: tuple[int, bytes, bool] | None = None
        self.name: Final = str(directory.path / name)
        with _forking:
            fd = directory.open(name)
            assert fd is not None
            self._fd = fd
            _opened.add(self)
        require_lock(fd, self.name)
        self._note_epoch(0, 0)
        self.look_up()

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

    @property
    def is_current(self) -> bool:
        """Whether the epoch is still the one that was looked up."""
        data = os.pread(self._fd, NUMBER.size, EPOCH_AT)
        return data == self._epoch_bytes or not (data or self.epoch)

    def look_up(self) -> bool:
        """The epoch is known; whether it is another one than before."""
        data = os.pread(self._fd, EPOCH.size, EPOCH_AT)
        epoch, base = EPOCH.unpack(data) if len(data) == EPOCH.size else (0, 0)
        if epoch == self.epoch and base == self.base:
            return False
        self._note_epoch(epoch, base)
        return True

    def _note_epoch(self, epoch: int, base: int) -> None:
        self.epoch, self.base = epoch, base
        self._epoch_bytes = NUMBER.pack(epoch)
        self._row = flock(fcntl.F_WRLCK, PLACES + base, 0)

    # ---- taking it ----

    def take_at_once(self) -> bool:
        """Whether it was free, nobody waited, and it is taken."""
        while _is_locked(fcntl.fcntl(self._fd, fcntl.F_OFD_GETLK, self._row)):
            if not self.look_up():
                return False
        return self._take(_AT_ONCE)

    def take_in_front(self) -> bool:
        """Whether it was free, whoever waited, and it is taken."""
        return self._take(_AT_ONCE)

    def queue_up(self, at_least: int = 1) -> int:
        """The place taken in the queue: behind everybody who came before.

        Args:
            at_least: a place >= 1 that it is not before.
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
            self.let_go()  # somebody came before us in the meantime

    def take(self, place: int) -> bool:
        """Whether it is the turn of this place, and it is taken."""
        return self.is_first(place) and self._take(_HOLD)

    def is_first(self, place: int) -> bool:
        """Whether nobody waits before this place."""
        while place > self.base:
            if find(self._fd, fcntl.F_RDLCK, PLACES + self.base, place - self.base) is None:
                break
            if not self.look_up():
                return False
        return True

    def _take(self, which: tuple[bytes, ...]) -> bool:
        """Whether HELD of the present epoch is ours."""
        while True:
            epoch = self.epoch
            number = epoch % LINES
            if not self._try(which[number]):
                if not self.look_up():
                    return False
                continue
            data = os.pread(self._fd, _LAST_SIZE + BLOCK * number, EPOCH_AT)
            now, _, intent = HEADER.unpack_from(data) if len(data) >= HEADER.size else _NOTHING
            if now == epoch and (intent != epoch + 1 or not self._is_being_taken(number)):
                self._last = last_of(data, HEADER.size + BLOCK * number)
                return True
            self._try(_DROP[number])  # it was moved on before we had it
            if not self.look_up():
                return False

    def _is_being_taken(self, number: int) -> bool:
        """Whether somebody takes it over now; one who died at it has not locked the byte."""
        return find(self._fd, fcntl.F_RDLCK, held_at(number) + 2, 1) is not None

    def wait_before(self, place: int) -> None:
        """Nobody is before the place any more. Waits without a limit, as `wait_for_mark` does."""
        if place > self.base:
            whole = flock(fcntl.F_RDLCK, PLACES + self.base, place - self.base)
            fcntl.fcntl(self._fd, fcntl.F_OFD_SETLKW, whole)
            self.let_go()

    def wait_for_mark(self) -> None:
        """Whoever took it at once, in the epoch looked up last, does not have it any more."""
        mark = flock(fcntl.F_RDLCK, held_at(self.epoch) + 1, 1)
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLKW, mark)
        self.let_go()

    def let_go(self) -> None:
        """Nothing is taken, no place is kept."""
        self._last = None
        if self._fd >= 0:
            fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, _UNLOCK_ALL)

    def let_go_of_places(self) -> None:
        """What is taken is kept, and no place."""
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, flock(fcntl.F_UNLCK, PLACES, 0))

    def _first_free(self, place: int) -> int:
        while True:
            found = find(self._fd, fcntl.F_WRLCK, PLACES + place, 0)
            if found is None:
                return place
            place = found[1] - PLACES + 1

    def _try(self, lock: bytes) -> bool:
        try:
            fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, lock)
        except (BlockingIOError, PermissionError):
            return False
        return True

    # ---- saying who has it ----

    def last(self) -> tuple[int, bytes, bool] | None:
        """(token, identity) of who had it before it was taken now, and whether it died with it.

        None: nobody ever had it, as far as is known.
        """
        return self._last

    def line(self) -> Line:
        """What the block of the epoch looked up last says."""
        return Line(os.pread(self._fd, BLOCK, line_block(self.epoch)))

    def tell_holder(self, token: int, record: bytes, lease: bytes = _NO_LEASE) -> None:
        """Everybody can read that we have it, and who we are."""
        fd, epoch = self._fd, self.epoch
        held = flock(fcntl.F_WRLCK, held_at(epoch) - token, token)
        fcntl.fcntl(fd, fcntl.F_OFD_SETLK, held)
        os.pwrite(fd, lease + record, line_block(epoch) + LEASE_AT)
        if self._last is None:
            os.pwrite(fd, MAGIC, 0)

    def tell_release(self, token: int) -> None:
        """Everybody can read that it was let go."""
        if self._fd >= 0:
            os.pwrite(self._fd, NUMBER.pack(token), line_block(self.epoch) + RELEASED_AT)

    def tell_waiter(self, place: int, record: bytes) -> None:
        """Everybody can read that we wait, and who we are."""
        os.pwrite(self._fd, record, waiter_block(place))

    def tell_lease(self, lease_ns: int, end_ns: int) -> None:
        """Everybody can read how long we have it, inside of a write section."""
        os.pwrite(self._fd, LEASE.pack(lease_ns, end_ns), line_block(self.epoch) + LEASE_AT)

    # ---- writing while it cannot be taken over ----

    def try_write(self) -> bool:
        """Whether nobody can take it over now, until `end_write`; False: somebody just does."""
        return self._fd >= 0 and self._try(_WRITE[self.epoch % LINES])

    def end_write(self) -> None:
        """It can be taken over again."""
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, _WRITTEN[self.epoch % LINES])

    def try_write_alone(self) -> bool:
        """Whether nobody else writes in the epoch looked up last, nor begins to."""
        return self._try(_WRITE_ALONE[self.epoch % LINES])

    @property
    def fd(self) -> int:
        """The descriptor, for `motorapi.lock_takeover`."""
        return self._fd


def _is_locked(answer: bytes) -> bool:
    kind: int = _FLOCK.unpack(answer)[0]
    return kind != fcntl.F_UNLCK


def _in_child() -> None:
    """A forked child has none of its parent's locks, and must not keep them from being let go."""
    for file in tuple(_opened):
        file.close()
    _opened.clear()
    _forking.release()


os.register_at_fork(
    before=_forking.acquire, after_in_parent=_forking.release, after_in_child=_in_child
)
