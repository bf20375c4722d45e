"""Creation of a recording file, without destroying other files."""

import fcntl
import io
import os
import stat
from contextlib import suppress

from traces.errors import TraceError
from traces.records import MAGIC


def create(path: str) -> io.RawIOBase:
    """Create an empty, unbuffered file; each write goes straight to the operating system.

    The file is locked (flock) while it is open.

    Raises:
        TraceError: the file cannot be written, is not a recording, or is being written by another
            program.
    """
    try:
        return io.FileIO(path, "w", opener=_open)
    except OSError as error:
        folder = os.path.dirname(path) or "."
        remedy = "name a file in a folder you may write to"
        if not os.path.isdir(folder):
            remedy = f"make the folder first: mkdir -p {folder}"
        raise TraceError(path, f"cannot be written: {reason(error)}", remedy=remedy) from error


def let_go(file: io.RawIOBase) -> None:
    """Close the file; processes forked meanwhile do not keep its lock."""
    if not file.closed:
        with suppress(OSError):  # not every target supports locks
            fcntl.flock(file.fileno(), fcntl.LOCK_UN)
    file.close()


def reason(error: OSError) -> str:
    """Return the operating system's description of an error."""
    return (error.strerror or str(error)).lower()


def _open(path: str, flags: int) -> int:
    descriptor = os.open(path, flags & ~os.O_TRUNC, 0o666)
    try:
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            _check_ours(path, descriptor)
            os.ftruncate(descriptor, 0)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _check_ours(path: str, descriptor: int) -> None:
    with open(path, "rb") as file:
        if not MAGIC.startswith(file.read(len(MAGIC))):
            raise TraceError(
                path, "is not a recording, and would be overwritten", remedy="name another file"
            )
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise TraceError(
            path, "is being written by another program", remedy="name another file"
        ) from None
    except OSError:  # a file system without locks
        pass
