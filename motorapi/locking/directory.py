"""Directory of lock files, secure opening of its files, and their names.

Processes exclude each other only if they all use the same file. So the place depends only on the
user, not on the session, its environment, or its temporary directory. (A service has no
XDG_RUNTIME_DIR, a terminal of the same user has one, and both drive the same motor.)

- By default: `/tmp/motorhil-<uid>`, mode 0700, owned by the user. Processes of other users are not
  visible there.
- If several users, or containers, share a robot: a directory of a common group, mode 2770, named by
  the environment variable MOTORHIL_LOCK_DIR in all of them. A private directory is possible as
  well.

Directory and file are checked after opening (links are not followed). They are refused if another
user could have created them, or could write to them.

The name of a lock file is that of a bus or a line, independent of its spelling. One bus or line has
one name in all processes of a host; two have two.

- SocketCAN: the network namespace and the index of the interface; its name can change.
- A hub socket: device and inode of the socket, whatever path leads there, and the bus.
- A serial line: the device numbers of the character device, whatever link leads there
  (/dev/serial/by-id/...).
- A TCP server: host and port; the host as an address if it is one, with one name for all local
  ones.
- Any other python-can bus: its interface and channel, compared as text, because nothing more is
  known.
"""

import errno
import os
import socket
import stat
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Final, final
from urllib.parse import quote

from motorhil.motorapi.errors import UsageError

if TYPE_CHECKING:
    import can

_LOCAL: Final = ("localhost", "ip6-localhost", "")
VARIABLE: Final = "MOTORHIL_LOCK_DIR"
_DEFAULT: Final = "/tmp/motorhil-{}"
_OPEN: Final = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
"""Nonblocking, so that a FIFO in place of a file is detected instead of awaited."""
_PRIVATE: Final = 0o600
_GROUP: Final = 0o660
_NO_FAULT_OF_THE_FILE: Final = (
    errno.EMFILE,
    errno.ENFILE,
    errno.ENOMEM,
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EROFS,
)
"""Errors for which the message must not advise removal: other processes may use the file."""


@final
class LockDirectory:
    """A directory of lock files, checked whenever a file is opened.

    Args:
        path: None: from MOTORHIL_LOCK_DIR, else `/tmp/motorhil-<uid>`.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        named = os.environ.get(VARIABLE, "") if path is None else str(path)
        self._is_default = not named
        self.path: Final = Path(named or _DEFAULT.format(os.geteuid()))
        if not self.path.is_absolute():
            raise UsageError(f"{VARIABLE}={named}: must be an absolute path")

    def open(self, name: str, *, to_read: bool = False) -> int | None:
        """Return a descriptor of lock file `name`, created if necessary; None: no file to read.

        Raises:
            UsageError: the directory or the file is not safe; names the problem.
        """
        try:
            directory, is_shared = self._open_directory(make=not to_read)
        except FileNotFoundError:
            return None
        try:
            return self._open_file(directory, name, is_shared, to_read)
        except OSError as error:
            if error.errno in _NO_FAULT_OF_THE_FILE:
                reason = f"{error.strerror}: the lock between processes cannot be opened"
                raise UsageError(f"{self.path / name}: {reason}") from error
            problem = "it is a link" if error.errno == errno.ELOOP else str(error.strerror)
            raise self._refused(self.path / name, problem) from error
        finally:
            os.close(directory)

    def names(self) -> list[str]:
        """Return the names of the lock files, sorted.

        Raises:
            UsageError: the directory is not safe, or was named and does not exist.
        """
        try:
            directory, _ = self._open_directory(make=False)
        except FileNotFoundError:
            if self._is_default:
                return []
            raise self._refused(self.path, "the directory does not exist") from None
        try:
            return sorted(os.listdir(directory))
        finally:
            os.close(directory)

    def last_used(self) -> list[tuple[str, float]]:
        """Return (name, time of the last change [s], as `time.time`) of the files, oldest first.

        Raises as `names`.
        """
        directory, _ = self._open_directory(make=False)
        try:
            with os.scandir(directory) as entries:
                found = [
                    (one.name, one.stat(follow_symlinks=False).st_mtime)
                    for one in entries
                    if one.is_file(follow_symlinks=False)
                ]
        finally:
            os.close(directory)
        return sorted(found, key=lambda one: one[1])

    def remove(self, name: str) -> None:
        """Remove a file; its lock is held meanwhile. Raises as `names`."""
        directory, _ = self._open_directory(make=False)
        try:
            os.unlink(name, dir_fd=directory)
        finally:
            os.close(directory)

    def _open_directory(self, make: bool) -> tuple[int, bool]:
        """Return (descriptor, True if a group shares the directory)."""
        if make and self._is_default:
            try:
                os.mkdir(self.path, 0o700)
            except FileExistsError:
                pass
            except OSError as error:
                raise self._refused(self.path, str(error.strerror)) from error
        try:
            directory = os.open(self.path, _OPEN | os.O_DIRECTORY)
        except FileNotFoundError:
            if make:
                raise self._refused(self.path, "the directory does not exist") from None
            raise
        except OSError as error:
            problem = "it is a link" if self.path.is_symlink() else str(error.strerror)
            raise self._refused(self.path, problem) from error
        try:
            return directory, self._is_shared(os.fstat(directory))
        except BaseException:
            os.close(directory)
            raise

    def _is_shared(self, found: os.stat_result) -> bool:
        is_private = not found.st_mode & 0o077
        if found.st_uid == os.geteuid() and is_private:
            return False
        mode = f"mode {stat.S_IMODE(found.st_mode):04o}"
        if self._is_default:
            if found.st_uid != os.geteuid():
                raise self._refused(self.path, f"it belongs to user {found.st_uid}")
            raise self._refused(self.path, f"{mode} gives access to others; it must be 0700")
        if found.st_mode & 0o007:
            raise self._refused(
                self.path, f"{mode} gives access to everybody; it must be 2770 or 0700"
            )
        if not found.st_mode & stat.S_ISGID or found.st_mode & 0o070 != 0o070:
            whose = "" if found.st_uid == os.geteuid() else f", of user {found.st_uid}"
            raise self._refused(self.path, f"{mode}{whose}; it must be 2770, or 0700 and your own")
        return True

    def _open_file(self, directory: int, name: str, is_shared: bool, to_read: bool) -> int | None:
        flags = _OPEN | (os.O_RDONLY if to_read else os.O_RDWR)
        mode = _GROUP if is_shared else _PRIVATE
        try:
            file = os.open(name, flags, dir_fd=directory)
        except FileNotFoundError:
            if to_read:
                return None
            try:
                file = os.open(name, flags | os.O_CREAT | os.O_EXCL, mode, dir_fd=directory)
                os.fchmod(file, mode)  # independent of the umask
            except FileExistsError:
                file = os.open(name, flags, dir_fd=directory)
        try:
            self._check_file(os.fstat(file), os.fstat(directory), self.path / name, is_shared)
        except BaseException:
            os.close(file)
            raise
        return file

    def _check_file(
        self, found: os.stat_result, directory: os.stat_result, path: Path, is_shared: bool
    ) -> None:
        if not stat.S_ISREG(found.st_mode):
            raise self._refused(path, "it is not a file")
        if found.st_nlink > 1:
            raise self._refused(path, "it has another name elsewhere (a hard link)")
        mode = f"mode {stat.S_IMODE(found.st_mode):04o}"
        if is_shared:
            if found.st_gid != directory.st_gid or found.st_mode & 0o007:
                group = f"group {found.st_gid}, {mode}"
                raise self._refused(path, f"{group}; it must be group {directory.st_gid}, 0660")
        elif found.st_uid != os.geteuid() or found.st_mode & 0o077:
            owner = f"user {found.st_uid}, {mode}"
            raise self._refused(path, f"{owner}; it must be your own, 0600")

    def _refused(self, path: Path, problem: str) -> UsageError:
        return UsageError(
            f"{path}: {problem}. Locks between processes live here: remove it, or name another"
            f" directory by {VARIABLE} (your own, mode 0700; or a group's, mode 2770)"
        )


def bus_name(bus: "can.BusABC") -> str | None:
    """Return the name of the CAN bus of this bus object; None: it exists in this process only.

    Raises:
        UsageError: the interface no longer exists.
    """
    hub = getattr(bus, "hub_bus", None)
    if hub is None and getattr(bus, "runtime", None) is not None:
        return None  # a rig of this process, in virtual time
    raw = getattr(bus, "socket", None)
    channel = str(getattr(bus, "channel", ""))
    if isinstance(raw, socket.socket) and raw.family == socket.AF_CAN and channel:
        return socketcan_name(channel)
    if hub is not None:
        path, name = hub
        return hub_name(path, name)
    kind = type(bus).__name__.removesuffix("Bus").lower()
    if kind == "virtual":
        return None  # python-can's virtual bus, within one process
    if channel.startswith("/dev/"):
        return f"{kind}-{serial_name(channel)}"
    return _quoted(f"{kind}-{channel or bus.channel_info}")


def socketcan_name(interface: str) -> str:
    """Return the name of the bus of a SocketCAN interface. Raise UsageError if it is missing."""
    try:
        index = socket.if_nametoindex(interface)
    except OSError as error:
        raise UsageError(f"{interface}: no such network interface ({error.strerror})") from error
    return f"can-if{index}-net{_stat('/proc/self/ns/net').st_ino}"


def hub_name(path: str, bus: str) -> str:
    """Return the name of a bus of the hub that serves on the socket at `path`."""
    found = _stat(path)
    return _quoted(f"hub-{found.st_dev}-{found.st_ino}-{bus}")


def line_name(line: object) -> str | None:
    """Return the name of the line of a byte line object; None: it exists in this process only."""
    hub = getattr(line, "hub_line", None)
    if hub is not None:
        return hub_name(*hub)
    path, address = getattr(line, "path", None), getattr(line, "address", None)
    if isinstance(path, str):
        return serial_name(path)
    if isinstance(address, tuple):
        return tcp_name(*address)
    return None


def serial_name(path: str) -> str:
    """Return the name of the serial line of the character device at `path`.

    Raises:
        UsageError: `path` does not exist, or is not a character device.
    """
    found = _stat(path)
    if not stat.S_ISCHR(found.st_mode):
        raise UsageError(f"{path}: not a serial line, but {_kind(found.st_mode)}")
    return f"serial-{os.major(found.st_rdev)}-{os.minor(found.st_rdev)}"


def tcp_name(host: str, port: int) -> str:
    """Return the name of the server at a TCP address, without a name service."""
    if host.lower() in _LOCAL:
        where = "127.0.0.1"
    else:
        try:
            address = ip_address(host)
            mapped = getattr(address, "ipv4_mapped", None)
            address = mapped or address
            where = "127.0.0.1" if address.is_loopback else str(address)
        except ValueError:
            where = host.lower().rstrip(".")
    return _quoted(f"tcp-{where}-{port}")


def _stat(path: str) -> os.stat_result:
    try:
        return os.stat(path)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error


def _kind(mode: int) -> str:
    kinds = {stat.S_IFREG: "a file", stat.S_IFDIR: "a directory", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "something else")


def _quoted(text: str) -> str:
    return quote(text, safe=" :").replace(" ", "_")[:180]
