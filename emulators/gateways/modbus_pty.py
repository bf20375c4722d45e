"""A Gateway between a serial line of a world and a pseudo-terminal.

A pseudo-terminal has no bit times: a client's data arrive at once, and silences of milliseconds are
lost. Frames are therefore delimited by their content (RtuRequests), and otherwise by a silence
longer than any scheduling delay. Each frame is then sent on the emulated line as a whole, t3.5
after the previous one, and takes its time there. Characters on the line are passed to the client
when the last one is complete. Late responses, or two clients at once, still collide.

On a line without silences (`SerialLine.has_silences`) data are sent at once, as written.
"""

import os
import tty
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Final, final

from motorhil.emulators.gateways.loop import Source
from motorhil.emulators.modbus.rtu import RtuRequests
from motorhil.emulators.simulation.serial_network import SerialSegment
from motorhil.emulators.simulation.world import World

_PIECE: Final = 4096
_FRAMES_MAX: Final = 256  # that wait for the line
_CHARACTERS_MAX: Final = 16_384
_SILENCE_NS: Final = 20_000_000  # longer than an interruption of a writer


class ModbusPtyError(Exception):
    """The link cannot be created; the message has path, reason and remedy."""


@final
class ModbusPty:
    """A Gateway: a program that opens `link` is on a serial line of the world.

    Any baud rate may be set: the line keeps its own. `link` may be opened, closed and opened again;
    it lasts until this closes. A link left behind by a killed server is replaced.

    Args:
        link: the path of the link to the terminal.
        world: the world of the line.
        line: the name of a serial line.

    Attributes:
        link: as given.
        terminal: the target of the link.
        lost: characters that were not read.

    Raises:
        ModbusPtyError: `link` is taken, or cannot be created.
    """

    def __init__(self, link: Path, world: World, line: str) -> None:
        segment = world.line(line)
        assert isinstance(segment, SerialSegment)
        self.link: Final = link
        self.lost: int = 0
        self._line = segment.line
        self._queue = world.queue
        self._silence_ns = max(_SILENCE_NS, self._line.t35_ns)
        self._sources: Final = (self,)
        self._requests = RtuRequests()
        self._frames: deque[bytes] = deque()
        self._free_ns = 0  # when the last frame is sent
        self._pause = self._queue.alarm(self._fall_silent)
        self._turn = self._queue.alarm(self._send)
        # The slave stays open: otherwise a client that leaves would end the terminal for all.
        self._master, self._slave = os.openpty()
        try:
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            self.terminal: Final = os.ttyname(self._slave)
            self._make_link()
        except BaseException:
            os.close(self._master)
            os.close(self._slave)
            raise
        self._host = world.add_line_host(line, link.name, self._tell)

    def _make_link(self) -> None:
        if self.link.is_symlink() and not self.link.exists():
            self.link.unlink()  # its target does not exist any more
        try:
            self.link.symlink_to(self.terminal)
        except OSError as error:
            raise ModbusPtyError(
                f"{self.link}: cannot create the link to the terminal: "
                f"{error.strerror or error}; choose another path, in a writable folder"
            ) from None

    def fileno(self) -> int:
        """Return the descriptor of our end of the terminal."""
        return self._master

    def sources(self) -> Sequence[Source]:
        """Return the terminal as the only source, unless the line is behind.

        Then a client's further data wait in the terminal, and its writes with them.
        """
        is_full = len(self._frames) >= _FRAMES_MAX or self._host.pending() >= _CHARACTERS_MAX
        return () if is_full else self._sources

    def readable(self, source: Source) -> None:
        """Process what a client has written."""
        self._read()

    def _read(self) -> bool:
        try:
            data = os.read(self._master, _PIECE)
        except OSError:  # no data
            return False
        if not self._line.has_silences:
            self._host.send(data)
            return True
        self._frames.extend(self._requests.feed(data))
        now_ns = self._queue.now_ns
        self._pause.set(now_ns + self._silence_ns if self._requests.waits else None)
        self._send(now_ns)
        return True

    def _fall_silent(self, now_ns: int) -> None:
        if not self._read():  # no unread data arrived in time
            self._frames.append(self._requests.silence())
            self._send(now_ns)

    def _send(self, now_ns: int) -> None:
        """Send the next frame after a silence of t3.5 on the line."""
        line = self._line
        while self._frames:
            quiet_ns = max(line.silent_since_ns(), self._free_ns)
            if quiet_ns and now_ns < quiet_ns + line.t35_ns:
                self._turn.set(quiet_ns + line.t35_ns)
                return
            frame = self._frames.popleft()
            self._free_ns = now_ns + line.duration_ns(len(frame))
            self._host.send(frame)

    def _tell(self, data: bytes, time_ns: int, transmitted: bool) -> None:
        if transmitted:
            return
        try:
            self.lost += len(data) - os.write(self._master, data)
        except OSError:  # clients have not read for a long time
            self.lost += len(data)

    def backlogged(self) -> bool:
        """Return False: unread characters are lost, as on a line."""
        return False

    def close(self) -> None:
        """Remove the link and close the terminal."""
        self._host.close()
        self._pause.set(None)
        self._turn.set(None)
        if self.link.is_symlink() and os.readlink(self.link) == self.terminal:
            self.link.unlink()
        os.close(self._master)
        os.close(self._slave)
