"""Who has a lock between processes, and who waits for it: for anybody to read.

Looking takes nothing and delays nobody. What is told of a process is what it wrote itself, as long
as the kernel says that it has the lock, or its place in the queue.
"""

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from motorapi.lock_directory import LockDirectory
from motorapi.lock_layout import Record, Takeover
from motorapi.lock_reader import LockReader


def read_process(pid: int) -> tuple[str, int] | None:
    """(state letter, time of birth) of a process, as proc(5) tells; None: there is none."""
    try:
        text = Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return None
    fields = text[text.rindex(b")") + 2 :].split()
    return fields[0].decode(), int(fields[19])


@final
class ThisProcess:
    """Who we are, as others read it. A forked child is another one."""

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
    """Who has a lock, or waits for it.

    Attributes: record (what it says of itself; None: it has not yet said), is_paused (by SIGSTOP or
    a debugger), age_s (for how long it has it, or waits).
    """

    __slots__ = ("age_s", "is_paused", "record")

    def __init__(self, record: Record | None) -> None:
        status = None if record is None else read_process(record.pid)
        if record is not None and status is not None and status[1] != record.born:
            record, status = None, None  # left by a dead one whose pid somebody else has now
        self.record: Final = record
        self.is_paused: Final = status is not None and status[0] in "Tt"
        age_ns = 0 if record is None else time.monotonic_ns() - record.since_ns
        self.age_s: Final = max(0, age_ns) / 1e9

    @property
    def who(self) -> str:
        """The process, and whether it is well."""
        if self.record is None:
            return "a process that has not yet said who it is"
        paused = ", paused" if self.is_paused else ""
        return f"pid {self.record.pid} ({self.record.program}{paused})"

    def __str__(self) -> str:
        return self.who if self.record is None else f"{self.who} for {self.record.purpose}"

    @property
    def since(self) -> str:
        """Since when, by the calendar and by now."""
        if self.record is None:
            return "just now"
        moment = time.gmtime(self.record.since_utc_ns // 1_000_000_000)
        return f"{time.strftime('%Y-%m-%d %H:%M:%S', moment)} UTC ({self.age_s:.1f} s ago)"


@final
@dataclass(frozen=True, slots=True)
class LockView:
    """A lock at one moment.

    Attributes: name (of its file), label (what it locks), holder (None: it is free), waiters (place
    and who, in order), abandoned (the token of who died with it, if nobody had it since; else 0),
    token (of who has it, or had it last), lease_s (of the holder; None: it has none), lease_left_s
    (how long it lasts; negative: it is over since), is_writing (it cannot be taken over now),
    taken_over (how the holder took it from one who lives; None: it did not).
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
    """The lock as it is now; free, if there is no such file.

    Raises:
        UsageError: the directory or the file is not safe.
    """
    fd = directory.open(name, to_read=True)
    if fd is None:
        return LockView(name, name, None, ())
    reader = LockReader(fd)
    try:
        reader.require_lock(str(directory.path / name))
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
    """How the token `lost` was lost (not `is_done`: is just being); None: it was not."""
    fd = directory.open(name, to_read=True)
    if fd is None:
        return None
    reader = LockReader(fd)
    try:
        return reader.takeover_of(lost, is_done=is_done)
    finally:
        reader.close()


def list_locks(directory: LockDirectory | None = None) -> list[LockView]:
    """All locks that there are, or ever were, in a directory (None: as for a new lock)."""
    where = LockDirectory() if directory is None else directory
    return [look(where, name) for name in where.names()]
