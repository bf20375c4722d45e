"""Protection against pipes and devices as input or output files."""

import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import BinaryIO, Final

from traces.errors import TraceError

_KINDS: Final[tuple[tuple[Callable[[int], bool], str], ...]] = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
_STREAMS: Final = _KINDS[:2]


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


def place_to_replace(target: str | os.PathLike[str]) -> str:
    """Return the real path of a file to be replaced, with symbolic links resolved.

    Raises:
        TraceError: the path is not a regular file, and must not be destroyed.
    """
    kind = _kind_of(target, _KINDS)
    if kind is not None:
        what = f"is {kind}, and would be replaced by a file"
        raise TraceError(os.fspath(target), what, remedy="name a file")
    return os.path.realpath(target)


@contextmanager
def whole_file(target: str) -> Iterator[BinaryIO]:
    """Open a file that replaces the target on success; the target is never incomplete.

    Raises:
        TraceError: the file cannot be written, or the target is not a regular file.
    """
    place = place_to_replace(target)
    part = f"{place}.part"
    try:
        with open(part, "wb") as file:
            yield file
        os.replace(part, place)
    except OSError as error:
        what = f"cannot be written: {(error.strerror or str(error)).lower()}"
        raise TraceError(target, what) from error
    finally:
        with suppress(OSError):
            os.remove(part)


def _kind_of(
    path: str | os.PathLike[str],
    kinds: tuple[tuple[Callable[[int], bool], str], ...],
) -> str | None:
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # opening the file reports the reason
        return None
    return next((words for is_it, words in kinds if is_it(mode)), None)
