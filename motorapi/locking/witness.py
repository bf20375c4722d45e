"""Witness of a held lock, which survives the removal of the lock file.

A lock file excludes only the processes that have the same file open. After its removal, or after a
move of its directory, other processes create a new file under the same name. The witness excludes
them from each other: at most one file of a name is held at any time.

The witness is a locked byte of the network namespace's own file, /proc/self/ns/net. No process can
remove that file, and every process may open it for reading. The processes that can share a CAN
interface have it in common. The kernel releases the byte of a dead process.

    byte:  [ hash of directory and name, 40 bits | hash of the lock file's inode, 23 bits ]

A reader can hold shared locks only. So a holder first locks the byte of its own file, and then asks
for locked bytes of other files under the same name. Of two processes with different files, at least
one finds the byte of the other. Several holders of one file share one byte: a process that has lost
the lock by a takeover does not exclude the next holder.

A lock of an open file has no process that the kernel would name. The process is found in
/proc/<pid>/fdinfo, which only its own user may read.
"""

import fcntl
import os
import stat
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import Final, NamedTuple, final

PLACE: Final = "/proc/self/ns/net"

_INODE_BITS: Final = 23
_FLOCK: Final = struct.Struct("@hhqqi0q")  # struct flock: type, whence, start, length, pid


def _flock(kind: int, start: int, length: int) -> bytes:
    return _FLOCK.pack(kind, os.SEEK_SET, start, length, 0)


_DROP: Final = _flock(fcntl.F_UNLCK, 0, 0)


def _hash_of(inode: int) -> int:
    return zlib.crc32(inode.to_bytes(8, "little")) >> (32 - _INODE_BITS)


@final
class Rival(NamedTuple):
    """The holder of another file under the same name.

    Attributes: byte (its witness), pid (0: of another user or PID namespace, or just ended), fd (a
    new descriptor of its file, to read and then close; None: no access).
    """

    byte: int
    pid: int
    fd: int | None


@final
class Witness:
    """The witness for one open lock file. It never blocks.

    Garbage collection does not close it; see `close`.

    Args:
        path: path of the lock file.
        inode: number of its inode.
    """

    __slots__ = ("_all", "_alone", "_fd", "_first", "_is_set", "_mine", "_others")

    def __init__(self, path: str, inode: int) -> None:
        folder, name = os.path.split(path)
        words = os.fsencode(f"{os.path.realpath(folder)}/{name}")
        first = int.from_bytes(blake2b(words, digest_size=5).digest()) << _INODE_BITS
        size, own = 1 << _INODE_BITS, _hash_of(inode)
        self._first: Final = first
        self._mine: Final = _flock(fcntl.F_RDLCK, first + own, 1)
        self._all: Final = _flock(fcntl.F_WRLCK, first, size)
        self._alone: Final = _flock(fcntl.F_UNLCK, first, size)  # the kernel's answer for no lock
        self._others: Final = ((first, first + own), (first + own + 1, first + size))
        self._is_set = False
        try:
            self._fd = os.open(PLACE, os.O_RDONLY | os.O_CLOEXEC)
        except OSError:
            self._fd = -1  # no /proc: the lock file alone has to do

    def close(self) -> None:
        """Drop the witness; closing again does nothing."""
        fd, self._fd = self._fd, -1
        self._is_set = False
        if fd >= 0:
            os.close(fd)

    def set(self, is_live: Callable[["Rival"], bool] | None = None) -> bool:
        """Witness that this file is held. Return False if another file of the name is held.

        Args:
            is_live: returns False for a holder that has lost its lock and has not noticed it.
        """
        fd = self._fd
        if fd < 0:
            return True
        try:
            fcntl.fcntl(fd, fcntl.F_OFD_SETLK, self._mine)
        except OSError:
            return True  # refused by a security module
        self._is_set = True
        if fcntl.fcntl(fd, fcntl.F_OFD_GETLK, self._all) == self._alone:
            return True
        if is_live is None:
            is_alone = next(self._locked(), None) is None
        else:
            is_alone = not any(is_live(rival) for rival in self.rivals())
        if not is_alone:
            self.drop()
        return is_alone

    def drop(self) -> None:
        """Withdraw the witness, if it is set."""
        if self._is_set:
            self._is_set = False
            fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, _DROP)

    def _locked(self) -> Iterator[int]:
        """Return the locked bytes of other files under the same name."""
        for start, end in self._others:
            at = start
            while at < end and self._fd >= 0:
                asked = _flock(fcntl.F_WRLCK, at, end - at)
                answer = _FLOCK.unpack(fcntl.fcntl(self._fd, fcntl.F_OFD_GETLK, asked))
                kind, _, first, length, _ = answer
                if kind == fcntl.F_UNLCK:
                    break
                yield first
                at = first + length if length else end

    def rivals(self) -> Iterator[Rival]:
        """Return the holders of other files under the same name, one for each file."""
        for at in self._locked():
            inode = os.fstat(self._fd).st_ino
            pid = _find_process(inode, at)
            yield Rival(at, pid, _open_file(pid, at - self._first) if pid else None)


def _find_process(inode: int, byte: int) -> int:
    """Return a process of this user that has locked the byte of the inode, or 0."""
    for pid in _processes():
        for words in _locks_of(pid):
            if words[5].endswith(f":{inode}") and int(words[6]) == byte:
                return pid
    return 0


def _processes() -> Iterator[int]:
    for name in os.listdir("/proc"):
        if name.isdecimal():
            yield int(name)


def _locks_of(pid: int) -> Iterator[list[str]]:
    """Return the locks of open files of a process: the words of /proc/<pid>/fdinfo."""
    with suppress(OSError):
        for path in Path(f"/proc/{pid}/fdinfo").iterdir():
            with suppress(OSError):
                for line in path.read_text().splitlines():
                    words = line.removeprefix("lock:").split()
                    if line.startswith("lock:") and len(words) == 8 and words[1] == "OFDLCK":
                        yield words


def _open_file(pid: int, wanted: int) -> int | None:
    """Return a descriptor of the lock file of a process with this hash of its inode, or None."""
    with suppress(OSError):
        for path in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):
                found = path.stat()
                if stat.S_ISREG(found.st_mode) and _hash_of(found.st_ino) == wanted:
                    return os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    return None
