"""Lock status: the state of a lock between processes, for any process.

Reading takes no lock and delays no process. Each process publishes its own description, which
counts only while the kernel confirms that it holds the lock, or its place in the queue.
"""

import fcntl
import os
import sys
import time
from pathlib import Path
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.lock_file import (
    BLOCK,
    PLACES,
    RECORD_SIZE,
    TAKEOVERS,
    Line,
    Record,
    Takeover,
    find,
    first_places,
    held_at,
    line_block,
    read_epoch,
    require_lock,
    takeover_block,
    unpack_record,
    unpack_takeover,
    waiter_block,
)
from motorhil.motorapi.locking.witness import Rival

_READS_MAX: Final = 20


@final
class LockReader:
    """A lock file, open for reading.

    Raises:
        UsageError: the file is not a lock file, or damaged; says how to replace it.
    """

    def __init__(self, fd: int, name: str) -> None:
        self._fd = fd
        self._name: Final = name

    def close(self) -> None:
        """Close the file; closing again does nothing."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def require_lock(self) -> None:
        """Raise UsageError if the file is not a lock file."""
        require_lock(self._fd, self._name)

    def _epoch(self) -> tuple[int, int]:
        """Return (epoch, the first valid place in it)."""
        return read_epoch(self._fd, self._name)

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
            line = Line(os.pread(self._fd, BLOCK, line_block(epoch)))
            record, token = line.record, held - found[0]
            if record is not None and record.number == token != line.released:
                return record  # else an attempt, a holder that has not published, or a release
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


def read_process(pid: int) -> tuple[str, int] | None:
    """Return (state letter, time of birth) of a process, as in proc(5), or None."""
    try:
        text = Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return None
    fields = text[text.rindex(b")") + 2 :].split()
    return fields[0].decode(), int(fields[19])


@final
class ThisProcess:
    """The published identity of this process. A forked child has another one."""

    def __init__(self) -> None:
        self.pid: Final = os.getpid()
        status = read_process(self.pid)
        self.facts: Final = (self.pid, os.geteuid(), 0 if status is None else status[1])
        path = Path(sys.argv[0] if sys.argv and sys.argv[0] else "python")
        if path.name == "__main__.py":
            path = path.parent
        self.program: Final = "python -c" if path.name == "-c" else path.name


@final
class Occupant:
    """The holder of a lock, or a waiter.

    Attributes: record (as published by the process; None: not yet), is_paused (by SIGSTOP or a
    debugger), age_s (duration of holding or waiting [s]).
    """

    __slots__ = ("age_s", "is_paused", "record")

    def __init__(self, record: Record | None) -> None:
        status = None if record is None else read_process(record.pid)
        if record is not None and status is not None and status[1] != record.born:
            record, status = None, None  # left by a dead process whose pid was reused
        self.record: Final = record
        self.is_paused: Final = status is not None and status[0] in "Tt"
        age_ns = 0 if record is None else time.monotonic_ns() - record.since_ns
        self.age_s: Final = max(0, age_ns) / 1e9

    @property
    def who(self) -> str:
        """The process, with a note if it is paused."""
        if self.record is None:
            return "a process that is not yet identified"
        paused = ", paused" if self.is_paused else ""
        return f"pid {self.record.pid} ({self.record.program}{paused})"

    def __str__(self) -> str:
        return self.who if self.record is None else f"{self.who} for {self.record.purpose}"

    @property
    def since(self) -> str:
        """The time since when, by the calendar, and its age."""
        if self.record is None:
            return "just now"
        moment = time.gmtime(self.record.since_utc_ns // 1_000_000_000)
        return f"{time.strftime('%Y-%m-%d %H:%M:%S', moment)} UTC ({self.age_s:.1f} s ago)"


@final
@frozen
class LockView:
    """The state of a lock at one moment.

    Attributes: name (of its file), label (the locked object), holder (None: free), waiters (place
    and process, in order), abandoned (token of a holder that died with it, if not taken since; else
    0), token (of the present or last holder), lease_s (of the holder, or None), lease_left_s
    (remaining time [s]; negative: expired), is_writing (no takeover is possible now), taken_over
    (the takeover by the present holder, or None).
    """

    name: str
    label: str
    holder: Occupant | None
    waiters: tuple[tuple[int, Occupant], ...]
    abandoned: int = 0
    token: int = 0
    lease_s: float | None = None
    lease_left_s: float = 0.0
    is_writing: bool = False
    taken_over: Takeover | None = None


def look(directory: LockDirectory, name: str) -> LockView:
    """Return the present state of the lock; free if the file does not exist.

    Raises:
        UsageError: the directory or the file is not safe.
    """
    fd = directory.open(name, to_read=True)
    if fd is None:
        return LockView(name, name, None, ())
    reader = LockReader(fd, str(directory.path / name))
    try:
        reader.require_lock()
        record = reader.holder()
        holder = Occupant(record) if record is not None or reader.is_held() else None
        waiters = tuple((place, Occupant(one)) for place, one in reader.waiters())
        line, label = reader.line(), reader.label() or name
        if holder is None or record is None:
            return LockView(name, label, holder, waiters, reader.abandoned(), line.token)
        has_lease = line.token == record.number and line.lease_ns > 0
        return LockView(
            name,
            label,
            holder,
            waiters,
            token=record.number,
            lease_s=line.lease_ns / 1e9 if has_lease else None,
            lease_left_s=(line.lease_end_ns - time.monotonic_ns()) / 1e9 if has_lease else 0.0,
            is_writing=reader.is_writing(),
            taken_over=reader.takeover_by(record.number),
        )
    finally:
        reader.close()


def find_takeover(
    directory: LockDirectory, name: str, lost: int, *, is_done: bool = True
) -> Takeover | None:
    """Return the takeover in which token `lost` was lost, or None. See `LockReader.takeover_of`."""
    fd = directory.open(name, to_read=True)
    if fd is None:
        return None
    reader = LockReader(fd, str(directory.path / name))
    try:
        return reader.takeover_of(lost, is_done=is_done)
    finally:
        reader.close()


def read_rival(rival: Rival) -> Occupant | None:
    """Return the holder of another file of the same name; None: it has lost the lock there."""
    if rival.fd is None:
        return Occupant(None)
    reader = LockReader(rival.fd, f"lock file of pid {rival.pid}")
    try:
        return Occupant(reader.holder()) if reader.is_held() else None
    except UsageError:
        return Occupant(None)
    finally:
        reader.close()


def list_locks(directory: LockDirectory | None = None) -> list[LockView]:
    """Return all locks in a directory, present and past (None: the directory of new locks)."""
    where = LockDirectory() if directory is None else directory
    return [look(where, name) for name in where.names()]
