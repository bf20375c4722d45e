"""Files of recordings: creation and replacement without loss of other files.

A recording is created unbuffered and locked, so that no second program writes it. It overwrites
only a recording. Any other result is written beside its target, which it replaces when it is
complete. Pipes and devices are refused: reading needs random access, and replacing destroys them.
"""

import fcntl
import io
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import BinaryIO, Final

from motorhil.traces.errors import TraceError

MEMORY_MAX: Final = 1 << 28
"""The default for the bytes that are made of one compressed piece of a file (256 MiB)."""
_KINDS: Final[tuple[tuple[Callable[[int], bool], str], ...]] = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
_STREAMS: Final = _KINDS[:2]


def reason(error: OSError) -> str:
    """Return the operating system's description of an error."""
    return (error.strerror or str(error)).lower()


def unreadable(path: str, error: OSError) -> TraceError:
    """Return the error for a file that the operating system does not read."""
    return TraceError(path, f"cannot be read: {reason(error)}")


def refuse_pipe(path: str | os.PathLike[str]) -> None:
    """Refuse a pipe or socket as input: recordings need random access and repeated reading.

    Raises:
        TraceError: the path is a pipe or a socket. It has not been opened, so no process waits for
            it.
    """
    kind = _kind_of(path, _STREAMS)
    if kind is not None:
        what = f"is {kind}, which can only be read from beginning to end"
        raise TraceError(os.fspath(path), what, remedy="write it to a file first")


@contextmanager
def whole_file(target: str, remedy: str = "") -> Iterator[BinaryIO]:
    """Open a file that replaces the target on success; the target is never incomplete.

    Symbolic links are followed.

    Args:
        target: the path.
        remedy: of the error, if the operating system refuses to write.

    Raises:
        TraceError: the file cannot be written, or the target is not a regular file.
    """
    kind = _kind_of(target, _KINDS)
    if kind is not None:
        what = f"is {kind}, and would be replaced by a file"
        raise TraceError(target, what, remedy="name a file")
    place = os.path.realpath(target)
    part = ""
    try:
        with _new_beside(place) as file:
            part = file.name
            yield file
        os.replace(part, place)
        part = ""
    except OSError as error:
        what = f"cannot be written: {reason(error)}"
        raise TraceError(target, what, remedy=remedy) from error
    finally:
        if part:
            with suppress(OSError):
                os.remove(part)


def _new_beside(place: str) -> BinaryIO:
    """Create a file beside this place, and none of somebody's: PLACE.part, PLACE.2.part, ..."""
    number = 1
    while True:
        try:
            return open(f"{place}.{number}.part" if number > 1 else f"{place}.part", "xb")
        except FileExistsError:
            number += 1


def _kind_of(
    path: str | os.PathLike[str], kinds: tuple[tuple[Callable[[int], bool], str], ...]
) -> str | None:
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # opening the file reports the reason
        return None
    return next((words for is_it, words in kinds if is_it(mode)), None)


def refuse_others(path: str, magic: bytes) -> None:
    """Refuse to replace a file that does not begin with `magic`, or that is being written.

    Raises:
        TraceError: the file is another one, or cannot be read.
    """
    try:
        descriptor = os.open(path, os.O_RDWR)
    except FileNotFoundError:
        return
    except OSError as error:
        raise TraceError(path, f"cannot be written: {reason(error)}") from error
    try:
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            _check_ours(path, descriptor, magic)
    finally:
        os.close(descriptor)


def create(path: str, magic: bytes) -> io.RawIOBase:
    """Create an empty, unbuffered file; each write goes straight to the operating system.

    The file is locked (flock) while it is open.

    Args:
        path: the file.
        magic: the first bytes of a file that may be overwritten.

    Raises:
        TraceError: the file cannot be written, exists and begins otherwise, or is being written by
            another program.
    """

    def open_it(path: str, flags: int) -> int:
        descriptor = os.open(path, flags & ~os.O_TRUNC, 0o666)
        try:
            if stat.S_ISREG(os.fstat(descriptor).st_mode):
                _check_ours(path, descriptor, magic)
                os.ftruncate(descriptor, 0)
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor

    try:
        return io.FileIO(path, "w", opener=open_it)
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


def _check_ours(path: str, descriptor: int, magic: bytes) -> None:
    with open(path, "rb") as file:
        if not magic.startswith(file.read(len(magic))):
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
