"""Takeover of a lock from a living process, by an advance of the epoch.

    lock WRITING of this epoch, exclusively     fails if the holder writes, or during a takeover
    check again: this epoch, its lease still expired
    write the new and the former holder         so that waiters can name the new one
    set the witness                             fails if another file of the name is held
    lock HELD and MARK of the next free epoch, and write its line
    write the epoch                             this advances it; no earlier step had an effect
    unlock WRITING

If the process dies before the epoch is written, nothing has changed. If it dies later, it leaves a
lock that a dead process has not released, which the next process handles as usual.

The holder is not in a write section, and begins none, from the first step to the last. So the write
sections of one epoch end before the next epoch begins. No process becomes the holder meanwhile: its
attempt notices WRITING or the new epoch, and ends. A takeover treats an attempt with the next token
like a holder. A holder that releases the lock meanwhile succeeds, and finds nothing lost.
"""

import fcntl
import os
from collections.abc import Callable
from enum import Enum
from typing import Final, final

from motorhil.motorapi.locking.lock_file import (
    BLOCK,
    LEASE,
    LINES,
    MAGIC,
    NUMBER,
    PLACES,
    Line,
    LockFile,
    Record,
    find,
    first_places,
    flock,
    held_at,
    line_block,
    pack_takeover,
    takeover_block,
)
from motorhil.motorapi.locking.lock_status import read_rival


@final
class Attempt(Enum):
    """Result of a takeover attempt."""

    TAKEN = "taken"
    FREE = "the lock is free"
    NOT_DUE = "its lease has not expired"
    WRITING = "its holder is in the middle of a write"
    TAKING = "another takeover is under way"
    RIVAL = "another file of this name is held"
    FULL = "too many former holders are alive"


@final
class TakeoverAttempt:
    """One attempt to take over a lock, through an open file.

    Args:
        file: a file without the lock; it may have a place in the queue, which is kept.
        now_ns: CLOCK_MONOTONIC [ns], to check the lease; None: take over unconditionally.
        describe: returns the record of the new holder, for its token; and that of the takeover, for
            the lost token and the reason.

    Attributes: token (of the new holder, once taken), lost (token of the former holder),
    from_identity (its identity; b"": unknown), taken_from (its name, in words).
    """

    def __init__(
        self,
        file: LockFile,
        now_ns: int | None,
        describe: Callable[[int, str | None], bytes],
        lease_ns: int = 0,
        lease_end_ns: int = 0,
    ) -> None:
        self._file: Final = file
        self._now_ns: Final = now_ns
        self._describe: Final = describe
        self._first_byte = 0  # locked by the holder
        self._lease: Final = LEASE.pack(lease_ns, lease_end_ns)
        self.token: int = 0
        self.lost: int = 0
        self.from_identity: bytes = b""
        self.taken_from: str = ""

    def make(self) -> Attempt:
        """Take over the lock, or return the reason why not; then nothing has changed."""
        file = self._file
        file.look_up()
        seen = self._find_due()
        if seen is not None:
            return seen
        if not file.try_write_alone():
            return self._who_writes()
        old = file.epoch
        try:
            if not file.is_current:
                return Attempt.TAKING  # another process has just taken it over
            return self._find_due() or self._take(old)
        finally:
            fcntl.fcntl(file.fd, fcntl.F_OFD_SETLK, flock(fcntl.F_UNLCK, held_at(old) + 2, 1))

    def _take(self, old: int) -> Attempt:
        file = self._file
        if not file.witness(lambda rival: read_rival(rival) is not None):
            return Attempt.RIVAL  # what is written would look like an owner to its holder
        self._say_who(old)
        seen = self._move_on(old)
        if seen is not Attempt.TAKEN:
            file.drop_witness()
        return seen

    def _find_due(self) -> Attempt | None:
        """Return None if a takeover is permitted, else the reason against it."""
        file = self._file
        held = held_at(file.epoch)
        found = find(file.fd, fcntl.F_RDLCK, held, 1)
        if found is None or found[0] == held:  # free, or locked by an attempt
            return Attempt.FREE
        self._first_byte = found[0]
        told, line = held - found[0], file.line()  # a token not in the line yet is in the lock
        if told < line.token:
            return Attempt.FREE  # an attempt that came too late, or a release meanwhile
        if self._now_ns is not None and (
            line.is_new or told != line.token or not 0 < line.lease_end_ns <= self._now_ns
        ):
            return Attempt.NOT_DUE
        self._line = line
        self.lost = told
        return None

    def _who_writes(self) -> Attempt:
        at = held_at(self._file.epoch) + 2
        alone = find(self._file.fd, fcntl.F_RDLCK, at, 1)
        return Attempt.WRITING if alone is None else Attempt.TAKING

    def _move_on(self, old: int) -> Attempt:
        file = self._file
        base = self._base_behind(old)
        for new in range(old + 1, old + LINES):
            if self._lock(held_at(new)):
                break
        else:
            return Attempt.FULL
        self._write(new)
        file.advance(new, base)
        return Attempt.TAKEN

    def _base_behind(self, old: int) -> int:
        """Return the first place behind that of the holder, if it has one.

        A holder releases all at once: if it has not done so by now, the first place was its own.
        """
        file = self._file
        if find(file.fd, fcntl.F_RDLCK, held_at(old) + 1, 1) is not None:
            return file.base
        places = first_places(file.fd, PLACES + file.base, 1 << 63)
        still = find(file.fd, fcntl.F_RDLCK, held_at(old), 1)
        if not places or still is None or still[0] > self._first_byte:
            return file.base
        return max(file.base, places[0] + 1)

    def _lock(self, held: int) -> bool:
        try:
            fcntl.fcntl(self._file.fd, fcntl.F_OFD_SETLK, flock(fcntl.F_WRLCK, held, 2))
        except (BlockingIOError, PermissionError):
            return False
        return True

    def _write(self, new: int) -> None:
        """Write all data of the new epoch, before the epoch advances."""
        fd, token, held = self._file.fd, self.token, held_at(new)
        fcntl.fcntl(fd, fcntl.F_OFD_SETLK, flock(fcntl.F_WRLCK, held - token, token))
        told = NUMBER.pack(0) + self._lease + self._describe(token, None)
        os.pwrite(fd, told.ljust(BLOCK, b"\0"), line_block(new))
        os.pwrite(fd, MAGIC, 0)

    def _say_who(self, old: int) -> None:
        """Write the new and the former holder; valid once the epoch advances."""
        fd = self._file.fd
        self.token = self.lost + 1
        victim: Record | None = Line(os.pread(fd, BLOCK, line_block(old))).record
        if victim is not None and victim.number != self.lost:
            victim = None
        if victim is not None:
            self.from_identity = victim.identity
            self.taken_from = f"pid {victim.pid} ({victim.program})"
        by = self._describe(self.lost, self._reason())
        os.pwrite(fd, pack_takeover(by, old, self.token, victim), takeover_block(self.lost))

    def _reason(self) -> str:
        if self._now_ns is None:
            return "on demand"
        return f"its lease of {self._line.lease_ns / 1e9:g} s was over"
