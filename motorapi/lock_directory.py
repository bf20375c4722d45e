"""Directory of lock files, and secure opening of its files.

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
"""

import errno
import os
import stat
from pathlib import Path
from typing import Final, final

from motorapi.errors import UsageError

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
