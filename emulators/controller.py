"""What every emulated controller (drive, I/O node) is to the world around it.

A controller is told frames and told the time; it never asks for either. Between two calls nothing
happens in it that anybody could see: `next_deadline_ns` says when it wants to be called again.
Times are int nanoseconds on one timeline that starts at 0.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, final


class Controller(Protocol):
    """A sans-I/O node on a medium. Third parties implement it; nothing need be inherited."""

    def start(self, now_ns: int) -> None:
        """Power comes on."""

    def receive(self, data: bytes, now_ns: int) -> None:
        """A frame was on the medium, complete at `now_ns` (CAN: Linux can_frame, 16 bytes)."""

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """An own frame left the medium at `now_ns`.

        Returns:
            False if nothing comes of it: no output, no event, no other deadline.
        """

    def wants_sent(self) -> bool:
        """Whether `sent` is to be called at all; constant."""

    def next_deadline_ns(self) -> int | None:
        """When `expire` must be called at the latest [ns]; None: only when something comes in."""

    def expire(self, now_ns: int) -> None:
        """It is `now_ns`; do what is due."""

    def take_output(self) -> Sequence[bytes]:
        """Frames to queue on the medium now, in order; they are then forgotten here."""

    def take_events(self) -> Sequence[tuple[str, str]]:
        """(level, text) of what happened since last asked; level: "info", "warning" or "error"."""

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """A physical input (load, switch) has this value; ValueError names the known ones."""

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """The truth inside at `now_ns`, units in the keys. Looking changes nothing."""

    def identifiers(self) -> Sequence[int] | None:
        """The CAN identifiers it listens to (as in can_frame, with flags); None: all.

        ERR_FLAG among them: error messages (`emulators.media.error_message`) come too.
        """

    def identifiers_revision(self) -> int:
        """Grows whenever `identifiers` would answer something new."""


class NonvolatileMemory(Protocol):
    """What a controller keeps without power: bytes, as a whole."""

    def load(self) -> bytes:
        """What was saved last; b"" if nothing ever was."""

    def save(self, data: bytes) -> bool:
        """From now on this is kept, whole; False: it could not be, and what was kept still is."""

    def where(self) -> str:
        """What to call it to a person."""


@final
class RigMemory:
    """Keeps as long as the rig is there. Implements `NonvolatileMemory`."""

    def __init__(self) -> None:
        self._data = b""

    def load(self) -> bytes:
        """What was saved last."""
        return self._data

    def save(self, data: bytes) -> bool:
        """It is kept."""
        self._data = data
        return True

    def where(self) -> str:
        """What to call it."""
        return "the rig's own memory"


def no_files(file: str) -> NonvolatileMemory:
    """Where nobody keeps files there is none to open.

    Raises:
        SettingError: always.
    """
    raise SettingError(("nonvolatile_memory",), f"nobody here keeps {file}", "leave it out")


@final
@dataclass(frozen=True, slots=True)
class ControllerContext:
    """What a rig tells a controller's builder besides the controller's own table.

    Attributes:
        name: the controller's name in the rig.
        folder: relative paths in the table start here.
        seed: the run's seed; draw only from streams named after the controller.
        memory_file: opens the file that the table names for what is kept without power.
    """

    name: str
    folder: Path
    seed: int
    memory_file: Callable[[str], NonvolatileMemory] = no_files

    def memory(self, file: str | None) -> NonvolatileMemory:
        """What is kept without power: in a file, or (None) as long as the rig is there.

        Raises:
            SettingError: the file cannot be used.
        """
        return RigMemory() if file is None else self.memory_file(file)

    def stream(self) -> str:
        """Where everything drawn for the controller starts from: the seed and its name."""
        return f"{self.seed}:{self.name}"


@final
class SettingError(Exception):
    """A value in a settings table is wrong; whoever read the table adds file and line.

    Attributes: path, the keys down to the value; remedy, what to write instead.
    """

    def __init__(self, path: tuple[str, ...], message: str, remedy: str = "") -> None:
        self.path = path
        self.message = message
        self.remedy = remedy
        super().__init__(f"{'.'.join(path)}: {message}" + (f"; {remedy}" if remedy else ""))
