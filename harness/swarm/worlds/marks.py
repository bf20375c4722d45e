"""Marks of a run: commands of its program, and the answers to them.

A command is a frame of the host whose bytes its stream has not had for a while, and has rarely.
Polls and heartbeats repeat theirs sooner and more often. An answer is the first frame of each
stream of a controller after a command on the same bus. A stream has the frames of one identifier
from one sender, or all transmissions of a sender on a line.
"""

from collections.abc import Callable, Container, Sequence
from typing import TYPE_CHECKING, Any, Final, final

from motorhil.frozen import frozen

if TYPE_CHECKING:
    from motorhil.emulators.simulation.world import World

_AGAIN_NS: Final = 300_000_000
"""Polls repeat within this time, commands do not."""
_RARE: Final = 12
"""Commands have bytes that come that often at most: a stop is repeated some times."""
_MARKS_MAX: Final = 96
_DIGITS: Final = 4  # of a time [s]


@final
@frozen
class Traffic:
    """Frames of one stream.

    Attributes:
        bus: the bus or line.
        sender: the sender's name, as faults name it.
        identifier: the CAN identifier; None on a line.
        frames: number of frames.
        marks: number and time [s] of commands, or of the answers to them.
        answers: True if a controller sends them.
    """

    bus: str
    sender: str
    identifier: int | None
    frames: int
    marks: tuple[tuple[int, float], ...] = ()
    answers: bool = False

    def as_row(self) -> list[object]:
        """Return it for JSON, without names of its fields."""
        return [self.bus, self.sender, self.identifier, self.frames, self.marks, self.answers]


def traffic_from(row: Sequence[Any]) -> Traffic:
    """Return the traffic of `as_row`."""
    bus, sender, identifier, frames, marks, answers = row
    places = tuple((number, at_s) for number, at_s in marks)
    return Traffic(bus, sender, identifier, frames, places, answers)


@final
class _Content:
    """The bytes of some frames of a host's stream.

    Attributes:
        frames: number of these frames.
        last_ns: time of the last one [ns].
    """

    __slots__ = ("frames", "last_ns")

    def __init__(self) -> None:
        self.frames = 0
        self.last_ns = -_AGAIN_NS


@final
class _Stream:
    """A stream, as far as its frames have passed.

    Attributes:
        frames: number of its frames.
        marks: number and time [ns] of those that may be marks, and the content of the command.
        contents: contents by their bytes; of a host's stream only.
        command: the last command that it has answered; of a controller's only.
    """

    __slots__ = ("command", "contents", "frames", "marks")

    def __init__(self) -> None:
        self.frames = 0
        self.marks: list[tuple[int, int, _Content]] = []
        self.contents: dict[bytes, _Content] = {}
        self.command = 0


_NONE: Final = 0, _Content()
"""The command before any other."""


@final
class Marks:
    """The marks of a run, from now on.

    Args:
        world: the rig's emulation.
        controllers: names of senders that answer; all others command.
        on_command: called with the identifier of each command, None on a line.
    """

    def __init__(
        self,
        world: "World",
        controllers: Container[str],
        on_command: Callable[[int | None, int], None] = lambda *_: None,
    ) -> None:
        self._controllers = controllers
        self._on_command = on_command
        self._streams: dict[tuple[str, str, int | None], _Stream] = {}
        self._commands: dict[str, tuple[int, _Content]] = {}  # by bus: number, and the last one
        world.tap_frames(self._frame)
        world.tap_lines(self._adu)

    def traffic(self, since_ns: int = 0, until_ns: int | None = None) -> tuple[Traffic, ...]:
        """Return all streams, in order of the first frame, with their marks in a time."""
        return tuple(
            Traffic(
                *key,
                one.frames,
                _within(one.marks, since_ns, until_ns),
                key[1] in self._controllers,
            )
            for key, one in self._streams.items()
        )

    def _frame(self, bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        identifier = int.from_bytes(frame[:4], "little") & 0x1FFF_FFFF
        self._take(bus, sender, identifier, time_ns, frame)

    def _adu(
        self,
        line: str,
        now_ns: int,
        begin_ns: int,
        end_ns: int,
        sender: str,
        adu: bytes,
        *_: object,
    ) -> None:
        self._take(line, sender, None, begin_ns, adu)

    def _take(
        self, bus: str, sender: str, identifier: int | None, time_ns: int, data: bytes
    ) -> None:
        key = bus, sender, identifier
        stream = self._streams.get(key)
        if stream is None:
            stream = self._streams[key] = _Stream()
        number = stream.frames
        stream.frames += 1
        if sender in self._controllers:
            count, content = self._commands.get(bus, _NONE)
            if stream.command != count:
                stream.command = count
                stream.marks.append((number, time_ns, content))
            return
        known = stream.contents.get(data)
        content = known or _Content()
        if known is None:
            stream.contents[data] = content
        content.frames += 1
        if time_ns - content.last_ns >= _AGAIN_NS:
            count, _ = self._commands.get(bus, _NONE)
            self._commands[bus] = count + 1, content
            stream.marks.append((number, time_ns, content))
            self._on_command(identifier, time_ns)
        content.last_ns = time_ns


def _within(
    marks: list[tuple[int, int, _Content]], since_ns: int, until_ns: int | None
) -> tuple[tuple[int, float], ...]:
    """Return the marks of a time whose commands are rare, thinned if there are many."""
    found = [
        (number, round(at_ns / 1e9, _DIGITS))
        for number, at_ns, content in marks
        if at_ns >= since_ns and (until_ns is None or at_ns <= until_ns) and content.frames <= _RARE
    ]
    step = -(-len(found) // _MARKS_MAX) or 1
    return tuple(found[step - 1 :: step])
