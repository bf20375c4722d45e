"""Files in which controllers keep what they keep without power (`nonvolatile_memory` in a rig)."""

import errno
import os
from pathlib import Path
from typing import final

from emulators.controller import SettingError

_KEY = ("nonvolatile_memory",)
_MAX_BYTES = 1 << 20


@final
class FileMemory:
    """One file, read when it is opened, and replaced as a whole whenever something is saved.

    Implements `emulators.controller.NonvolatileMemory`.
    """

    def __init__(self, path: Path) -> None:
        """Opens it.

        Raises:
            OSError: it is there, and cannot be read.
        """
        self._path = path
        self._data = b""
        if path.exists():
            if not path.is_file():  # a pipe is silent for ever, a device would be replaced
                raise OSError(errno.EINVAL, "it is a folder or a device, not a file")
            with path.open("rb") as file:
                self._data = file.read(_MAX_BYTES)

    def load(self) -> bytes:
        """What was saved last, by this rig or one before."""
        return self._data

    def save(self, data: bytes) -> bool:
        """The file holds this, or what it held before; never a part."""
        new = self._path.with_name(f".{self._path.name}.{os.getpid()}")
        try:
            try:
                with new.open("wb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
                os.replace(new, self._path)
            except BaseException:  # Ctrl-C, too, leaves nothing beside the file
                new.unlink(missing_ok=True)
                raise
        except OSError:
            return False
        self._data = data
        return True

    def where(self) -> str:
        """The file's name; its folder is another one on another machine."""
        return self._path.name


@final
class MemoryFiles:
    """The files of one rig: each is one controller's."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._owners: dict[Path, str] = {}

    def open(self, controller: str, named: str) -> FileMemory:
        """The controller's file.

        Raises:
            SettingError: it is another controller's, or cannot be used.
        """
        try:
            path = (self._folder / named).resolve()  # what a link leads to is the file
        except (OSError, ValueError) as error:  # links in a circle; a path that no file can have
            raise SettingError(_KEY, f"{named!r} is no path: {error}", "name a file") from None
        owner = self._owners.setdefault(path, controller)
        if owner != controller:
            message = f"{named} is the memory of controller {owner!r} already"
            raise SettingError(_KEY, message, "one file for each")
        if not path.parent.is_dir():
            message = f"there is no folder {path.parent}"
            raise SettingError(_KEY, message, "make it; the file need not be there")
        try:
            return FileMemory(path)
        except OSError as error:
            reason = error.strerror or type(error).__name__
            raise SettingError(_KEY, f"{path} cannot be read: {reason}", "name a file") from error
