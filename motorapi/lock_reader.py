"""Read-only access to a lock file, which never takes or delays a lock."""

import fcntl
import os
from typing import Final, final

from motorapi.lock_file import find, first_places, require_lock
from motorapi.lock_layout import (
    BLOCK,
    EPOCH,
    EPOCH_AT,
    PLACES,
    RECORD_SIZE,
    TAKEOVERS,
    Line,
    Record,
    Takeover,
    held_at,
    line_block,
    takeover_block,
    unpack_record,
    unpack_takeover,
    waiter_block,
)

_READS_MAX: Final = 20


@final
class LockReader:
    """A lock file, open for reading."""

    def __init__(self, fd: int) -> None:
        self._fd = fd

    def close(self) -> None:
        """Close the file; closing again does nothing."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def require_lock(self, name: str) -> None:
        """Raise UsageError if the file is not a lock file."""
        require_lock(self._fd, name)

    def _epoch(self) -> tuple[int, int]:
        """Return (epoch, the first valid place in it)."""
        data = os.pread(self._fd, EPOCH.size, EPOCH_AT)
        if len(data) < EPOCH.size:
            return 0, 0
        epoch, base = EPOCH.unpack(data)
        return epoch, base

    def line(self) -> Line:
        """Return the block of the present epoch: holder and lease."""
        return Line(os.pread(self._fd, BLOCK, line_block(self._epoch()[0])))

    def label(self) -> str | None:
        """Return the name of the locked object; None if the lock was never held."""
        record = self.line().record
        return None if record is None else record.label

    def abandoned(self) -> int:
        """Return the token of a holder that died with the lock, if not taken since; else 0."""
        line = self.line()
        if line.is_new or line.token == line.released or self.is_held():
            return 0
        return line.token

    def is_held(self) -> bool:
        """Return True if the lock is held."""
        return find(self._fd, fcntl.F_RDLCK, held_at(self._epoch()[0]), 1) is not None

    def is_writing(self) -> bool:
        """Return True during a write or a takeover, when no other takeover is possible."""
        return find(self._fd, fcntl.F_WRLCK, held_at(self._epoch()[0]) + 2, 1) is not None

    def holder(self) -> Record | None:
        """Return the record of the holder; None: free, or not yet published (see `is_held`)."""
        for _ in range(_READS_MAX):
            epoch, _ = self._epoch()
            held = held_at(epoch)
            found = find(self._fd, fcntl.F_RDLCK, held, 1)
            if found is None:
                if self._epoch()[0] == epoch:
                    return None
                continue
            record = Line(os.pread(self._fd, BLOCK, line_block(epoch))).record
            if record is not None and record.number == held - found[0]:
                return record
        return None

    def waiters(self) -> list[tuple[int, Record | None]]:
        """Return (place, record) of the waiters, in order; record None: not yet published."""
        epoch, base = self._epoch()
        found = []
        for place in first_places(self._fd, PLACES + max(1, base), (1 << 63) - 1):
            record = unpack_record(os.pread(self._fd, RECORD_SIZE, waiter_block(place)))
            found.append((place, record if record and record.number == place else None))
        marked = find(self._fd, fcntl.F_RDLCK, held_at(epoch) + 1, 1)
        if found and marked is None and self.is_held():
            found.pop(0)  # a holder that has waited keeps its place
        return found

    def takeover_of(self, lost: int, *, is_done: bool = True) -> Takeover | None:
        """Return the takeover in which token `lost` was lost; None: none, or too long ago.

        Args:
            lost: the token.
            is_done: False: accept a takeover still under way.
        """
        takeover = unpack_takeover(os.pread(self._fd, BLOCK, takeover_block(lost)))
        if takeover is None or takeover.lost != lost:
            return None
        if is_done and self._epoch()[0] <= takeover.epoch:
            return None
        return takeover

    def takeover_by(self, token: int) -> Takeover | None:
        """Return the takeover by the holder with this token; None: none, or too long ago."""
        for slot in range(TAKEOVERS):
            takeover = unpack_takeover(os.pread(self._fd, BLOCK, takeover_block(slot)))
            if takeover is None or takeover.token != token:
                continue
            if self._epoch()[0] > takeover.epoch:
                return takeover
        return None
