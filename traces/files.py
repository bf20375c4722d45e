"""Files of recordings: creation and replacement without loss of other files.

A recording is created unbuffered and locked, so that no second program writes it. It overwrites
only a recording. Any other result is written beside its target, which it replaces when it is
complete. Pipes and devices are refused: reading needs random access, and replacing destroys them.

A file that gzip compressed is read as its content, which is unpacked into an unnamed file first.
"""

import errno
import fcntl
import gzip
import io
import os
import re
import stat
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import BinaryIO, Final, cast

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
_GZIP: Final = b"\x1f\x8b\x08"
_GZIP_WINDOW: Final = 16 + zlib.MAX_WBITS  # with a head of gzip
_BLOCK: Final = 1 << 16
_RATIO_MAX: Final = 200  # of a recording; DEFLATE can reach 1032, with nothing but one byte
_READ_REMEDIES: Final = {
    errno.ENOENT: "check the name",
    errno.ENOTDIR: "check the name",
    errno.EISDIR: "name a file in it",
    errno.EACCES: "allow yourself to read it: chmod u+r",
    errno.EIO: "copy it from a medium that can be read",
}
COPY_AGAIN: Final = "copy the file again from where it came"


def reason(error: OSError) -> str:
    """Return the operating system's description of an error."""
    return (error.strerror or str(error)).lower()


def unreadable(path: str, error: OSError) -> TraceError:
    """Return the error for a file that the operating system does not read."""
    remedy = _READ_REMEDIES.get(error.errno or 0, "")
    return TraceError(path, f"cannot be read: {reason(error)}", remedy=remedy)


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


def head_of(path: str, size: int) -> bytes:
    """Return the first bytes of a file, or of its content if it is compressed by gzip.

    Raises:
        TraceError: the file cannot be read.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(max(size, _BLOCK))
    except OSError as error:
        raise unreadable(path, error) from error
    if not head.startswith(_GZIP):
        return head[:size]
    try:
        unpacker = zlib.decompressobj(_GZIP_WINDOW)
        content = unpacker.decompress(head, size)
    except zlib.error:
        return head[:size]
    if not content and not unpacker.eof:
        raise _empty_handed(path, "is cut short")
    return content


def _empty_handed(path: str, damage: str) -> TraceError:
    """Return the error for gzip data without any content before its damage."""
    return TraceError(path, f"its gzip data {damage}, before any content", remedy=COPY_AGAIN)


def open_content(
    path: str, report: Callable[[str], None] | None = None, memory_max: int = MEMORY_MAX
) -> BinaryIO:
    """Open a file, or, if it is compressed by gzip, an unnamed file with its content.

    Args:
        path: the file.
        report: called with a damage of the compressed data; the content before it is complete.
        memory_max: the most bytes of content, if these are also 200 times the compressed size.

    Raises:
        TraceError: the file cannot be read, has no content before a damage, or too much content.
    """
    try:
        file = open(path, "rb")  # noqa: SIM115  # the caller closes it
    except OSError as error:
        raise unreadable(path, error) from error
    try:
        if file.read(len(_GZIP)) != _GZIP:
            file.seek(0)
            return file
        with file:
            file.seek(0)
            return _unpacked(path, file, report, memory_max)
    except OSError as error:
        file.close()
        raise unreadable(path, error) from error


def _unpacked(
    path: str, file: BinaryIO, report: Callable[[str], None] | None, memory_max: int
) -> BinaryIO:
    content = tempfile.TemporaryFile()  # noqa: SIM115  # the caller closes it
    limit = max(memory_max, _RATIO_MAX * os.fstat(file.fileno()).st_size)
    damage = ""
    try:
        try:
            with gzip.GzipFile(fileobj=file) as packed:
                while block := packed.read1(_BLOCK):
                    content.write(block)
                    if content.tell() > limit:
                        what = f"unpacks to more than {limit} bytes"
                        raise TraceError(path, what, remedy="--max-memory allows more")
        except EOFError:
            damage = "is cut short"
        except (gzip.BadGzipFile, zlib.error) as error:
            damage = f"is damaged ({error})"
        if damage and not content.tell():
            raise _empty_handed(path, damage)
        if damage and report is not None:
            report(f"its gzip data {damage}, after {content.tell()} bytes of content")
        content.seek(0)
    except BaseException:
        content.close()
        raise
    return cast("BinaryIO", content)


# Beginning of the file, what it is, what to do with it.
NOT_MCAP: Final = ("is not an MCAP file", "give a recording, or convert it to MCAP")
_STRANGERS: Final[tuple[tuple[bytes, str, str], ...]] = (
    (b"PK\x03\x04", "is a ZIP archive", "unzip it, and give a file in it"),
    (b"7z\xbc\xaf\x27\x1c", "is a 7z archive", "unpack it, and give a file in it"),
    (b"Rar!", "is a RAR archive", "unpack it, and give a file in it"),
    (b"\x28\xb5\x2f\xfd", "is compressed by zstd", "unpack it with unzstd"),
    (_GZIP, "is compressed by gzip", "gunzip it first"),
    (b"BZh", "is compressed by bzip2", "unpack it with bunzip2"),
    (b"\xfd7zXZ\0", "is compressed by xz", "unpack it with unxz"),
    (b"#ROSBAG V", "is a ROS 1 bag", "convert it with rosbags-convert or mcap convert"),
    (b"SQLite format 3\0", "is a SQLite database, as rosbag2 writes", "mcap convert FILE.db3"),
    (b"MDF     3", "is an MDF file of version 3", "convert it to MDF 4, with asammdf"),
    (b"UnFinMF ", "is an MDF file that was not finalised", "open and save it with its own program"),
    (b"\x89HDF\r\n\x1a\n", "is an HDF5 file", "export CAN frames, not signals"),
    (b"MATLAB 5.0 MAT-file", "is a file of MATLAB", "export CAN frames, not signals"),
    (b"\x7fELF", "is a program (ELF)", "give a recording"),
    (b"%PDF-", "is a PDF document", "give a recording"),
    (b"version https://git-lfs", "is a pointer of Git LFS, not the file", "run git lfs pull"),
    (b"<!DOCTYPE", "is a page of the web", "download the file itself, not its page"),
    (b"<html", "is a page of the web", "download the file itself, not its page"),
    (b'VERSION "', "is a DBC file, without traffic", "give it to --dbc, with a recording"),
)


def stranger(head: bytes) -> tuple[str, str] | None:
    """Return the kind of a known file that holds no recording, and what to do; None if unknown."""
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if not text.strip(b"\0"):
        size = f"{len(head)} " if head else ""
        what = f"begins with {size}bytes of nothing" if head else "is empty"
        return what, "record again: its writer wrote nothing"
    if re.search(rb"^\[(FileInfo|DeviceInfo)\]", text, re.IGNORECASE | re.MULTILINE):
        return "is an EDS, without traffic", "give it to --eds, with a recording"
    for begin, what, remedy in _STRANGERS:
        if text[: len(begin)].lower() == begin.lower():
            return what, remedy
    return None


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
    except TraceError as error:
        if error.path != part:
            raise
        raise TraceError(target, error.what, remedy=error.remedy) from error
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
