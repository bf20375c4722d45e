"""Files for controllers' nonvolatile memory (`nonvolatile_memory` in a rig)."""

import errno
import os
from pathlib import Path
from typing import final

from motorhil.emulators.controller import SettingError

_KEY = ("nonvolatile_memory",)
_MAX_BYTES = 1 << 20


@final
class FileMemory:
    """One file, read when it is opened and replaced as a whole on every save.

    Implements `NonvolatileMemory` of the emulators.
    """

    def __init__(self, path: Path) -> None:
        """Open the file and read it.

        Raises:
            OSError: the file exists but cannot be read.
        """
        self._path = path
        self._data = b""
        if path.exists():
            if not path.is_file():  # reading a pipe would block, and a device would be replaced
                raise OSError(errno.EINVAL, "it is a folder or a device, not a file")
            with path.open("rb") as file:
                self._data = file.read(_MAX_BYTES)

    def load(self) -> bytes:
        """Return the data saved last, by this rig or an earlier one."""
        return self._data

    def save(self, data: bytes) -> bool:
        """Replace the file's contents atomically; return False if it cannot be written."""
        new = self._path.with_name(f".{self._path.name}.{os.getpid()}")
        try:
            try:
                with new.open("wb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
                os.replace(new, self._path)
            except BaseException:  # leaves no temporary file, not even on Ctrl-C
                new.unlink(missing_ok=True)
                raise
        except OSError:
            return False
        self._data = data
        return True

    def where(self) -> str:
        """Return the file's name, without the folder, which depends on the machine."""
        return self._path.name


@final
class MemoryFiles:
    """The memory files of one rig, one per controller."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._owners: dict[Path, str] = {}

    def open(self, controller: str, named: str) -> FileMemory:
        """Return the controller's file.

        Raises:
            SettingError: the file belongs to another controller, or cannot be used.
        """
        try:
            path = (self._folder / named).resolve()  # compares the targets of links
        except (OSError, ValueError) as error:  # a cycle of links, or a path that no file can have
            raise SettingError(_KEY, f"{named!r} is not a path: {error}", "name a file") from None
        owner = self._owners.setdefault(path, controller)
        if owner != controller:
            message = f"{named} is the memory of controller {owner!r} already"
            raise SettingError(_KEY, message, "give each controller its own file")
        if not path.parent.is_dir():
            message = f"folder {path.parent} does not exist"
            raise SettingError(_KEY, message, "create the folder; the file may be absent")
        try:
            return FileMemory(path)
        except OSError as error:
            reason = error.strerror or type(error).__name__
            raise SettingError(_KEY, f"{path} cannot be read: {reason}", "name a file") from error
