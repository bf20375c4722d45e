"""Interface between emulated controllers (drives, I/O nodes) and their world.

A controller receives frames and the time; it never asks for them. Its observable state changes only
within calls: `next_deadline_ns` returns the time of the next required call. Times are int
nanoseconds on one timeline that starts at 0.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final, Protocol, TypeVar, final

from motorhil.frozen import frozen
from motorhil.settings import SettingError as SettingError

API_VERSION: Final = 1
"""The version of `motorhil.emulators.api`."""

STUCK: Final = 1000
"""How often a controller may be called at one time, by its own wish."""


class Controller(Protocol):
    """A sans-I/O node on a medium. Third parties may implement it, without inheritance."""

    def start(self, now_ns: int) -> None:
        """Power on."""

    def receive(self, data: bytes, now_ns: int) -> None:
        """Process a frame on the medium, complete at `now_ns` (CAN: Linux can_frame, 16 bytes)."""

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """Confirm that an own frame left the medium at `now_ns`.

        Returns:
            False if it has no effect: no output, no event, no other deadline.
        """

    def wants_sent(self) -> bool:
        """Return whether `sent` must be called at all; constant."""

    def next_deadline_ns(self) -> int | None:
        """Return when `expire` must be called at the latest [ns], or None."""

    def expire(self, now_ns: int) -> None:
        """Process what is due at `now_ns`."""

    def take_output(self) -> Sequence[bytes]:
        """Return and clear the frames to queue on the medium now, in order."""

    def take_events(self) -> Sequence[tuple[str, str]]:
        """Return (level, text) of new events; level: "info", "warning" or "error"."""

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Set a physical input (load, switch); ValueError names the known ones."""

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """Return the true state at `now_ns`, units in the keys, without side effects."""

    def identifiers(self) -> Sequence[int] | None:
        """Return the CAN identifiers it listens to (as in can_frame, with flags); None: all.

        With ERR_FLAG among them it also receives error messages (`error_message`).
        """

    def identifiers_revision(self) -> int:
        """Return a number that increases with every change of `identifiers`."""


BuildT = TypeVar("BuildT", bound=Callable[..., object])


def controller(*, api: int, bus_kinds: Sequence[str] = ("can",)) -> Callable[[BuildT], BuildT]:
    """Mark a function as the builder of an emulated controller: build(settings, context).

    Args:
        api: the version of `motorhil.emulators.api` that the controller was written for.
        bus_kinds: the kinds of buses that it builds for: can, modbus_rtu, modbus_tcp, serial.
    """

    def mark(build: BuildT) -> BuildT:
        vars(build).update(api_version=api, bus_kinds=tuple(bus_kinds))
        return build

    return mark


class StuckControllerError(RuntimeError):
    """A controller whose deadline does not move on, so that time would stand still for ever."""

    def __init__(self, name: str, now_ns: int) -> None:
        super().__init__(
            f"controller {name}: after `expire` at {now_ns / 1e9:.9f} s it asked {STUCK} times to"
            " be called at that time or before; `next_deadline_ns` must be later once `expire` has"
            " handled what is due; this is a defect of the controller: report it to its author"
        )


class NonvolatileMemory(Protocol):
    """The nonvolatile memory of a controller: bytes, as a whole."""

    def load(self) -> bytes:
        """Return the bytes saved last, or b"" if there are none."""

    def save(self, data: bytes) -> bool:
        """Save the bytes as a whole; on failure keep the old ones and return False."""

    def where(self) -> str:
        """Return its name for messages."""


@final
class RigMemory:
    """A memory that lasts as long as the rig. Implements `NonvolatileMemory`."""

    def __init__(self) -> None:
        self._data = b""

    def load(self) -> bytes:
        """Return the bytes saved last."""
        return self._data

    def save(self, data: bytes) -> bool:
        """Save the bytes."""
        self._data = data
        return True

    def where(self) -> str:
        """Return its name."""
        return "the rig's own memory"


def no_files(file: str) -> NonvolatileMemory:
    """Refuse the file, because this context has no files.

    Raises:
        SettingError: always.
    """
    raise SettingError(
        ("nonvolatile_memory",), f"{file} cannot be opened; this rig has no files", "leave it out"
    )


@final
@frozen
class ControllerContext:
    """The information of a rig for a controller's builder, besides the controller's table.

    Attributes:
        name: the controller's name in the rig.
        folder: the start of relative paths in the table.
        seed: the run's seed; draw only from streams named after the controller.
        memory_file: opens the file for nonvolatile data that the table names.
        bitrate_bit_s: the bit rate of its bus or serial line; None: not known, or without one.
    """

    name: str
    folder: Path
    seed: int
    memory_file: Callable[[str], NonvolatileMemory] = no_files
    bitrate_bit_s: int | None = None

    def memory(self, file: str | None) -> NonvolatileMemory:
        """Return the nonvolatile memory: a file, or (None) one that lasts as long as the rig.

        Raises:
            SettingError: the file cannot be used.
        """
        return RigMemory() if file is None else self.memory_file(file)

    def stream(self) -> str:
        """Return the name of the controller's random streams: the seed and its name."""
        return f"{self.seed}:{self.name}"
