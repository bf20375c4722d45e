"""Where lock files are, and how one is opened so that nobody can play tricks with it.

Processes keep each other out only if they all look at the same file. So the place depends on
nothing but the user: not on the session, its environment, or where its temporary files are (a
service has no XDG_RUNTIME_DIR, the same user's terminal has one, and both drive the same motor).

- By default: `/tmp/motorhil-<uid>`, mode 0700, the user's own. Processes of other users are not
  seen there.
- Where several users, or containers, share a robot: a directory of a common group, mode 2770, named
  by the environment variable MOTORHIL_LOCK_DIR in all of them. A private directory may be named
  as well.

What is found is looked at after it was opened (no link is followed), and refused if somebody else
could have put it there, or could write to it.
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
"""Nonblocking, so that a FIFO in place of a file is found out, not waited for."""
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
"""Nobody is told to remove a lock file for these: others may be using it."""


@final
class LockDirectory:
    """A directory of lock files. It is looked at anew whenever a file is opened.

    Args:
        path: None: as MOTORHIL_LOCK_DIR says, else `/tmp/motorhil-<uid>`.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        named = os.environ.get(VARIABLE, "") if path is None else str(path)
        self._is_default = not named
        self.path: Final = Path(named or _DEFAULT.format(os.geteuid()))
        if not self.path.is_absolute():
            raise UsageError(f"{VARIABLE}={named}: must be an absolute path")

    def open(self, name: str, *, to_read: bool = False) -> int | None:
        """A descriptor of the lock file `name`, which exists now; None: to_read, and there is none.

        Raises:
            UsageError: the directory or the file is not safe; says what is wrong with it.
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
        """The lock files there are, sorted.

        Raises:
            UsageError: the directory is not safe; or it was named, and is not there.
        """
        try:
            directory, _ = self._open_directory(make=False)
        except FileNotFoundError:
            if self._is_default:
                return []
            raise self._refused(self.path, "there is no such directory") from None
        try:
            return sorted(os.listdir(directory))
        finally:
            os.close(directory)

    def _open_directory(self, make: bool) -> tuple[int, bool]:
        """(descriptor, whether a group shares it)."""
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
                raise self._refused(self.path, "there is no such directory") from None
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
            raise self._refused(self.path, f"{mode} lets others in; it must be 0700")
        if found.st_mode & 0o007:
            raise self._refused(self.path, f"{mode} lets everybody in; it must be 2770 or 0700")
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
                os.fchmod(file, mode)  # whatever the umask says
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
            raise self._refused(path, "it is no file")
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
