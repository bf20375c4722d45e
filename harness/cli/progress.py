"""Progress of long work: one line on stderr, replaced twice a second, on a terminal only.

The work reports nothing. The operating system knows how far each open file was read
(`/proc/self/fdinfo`), so a thread beside the work can tell the part of a recording that is done, at
no cost for the work and in any format. Work that only writes is known by the file it writes.

Source: proc(5), /proc/pid/fdinfo.
"""

import os
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final, TextIO, cast, final

_LOOK_S: Final = 0.5
_FIRST_S: Final = 1.0  # work that is shorter needs no line
_STILL_S: Final = 2.0  # then the file is read, and the work goes on without it
_END: Final = 0.9  # of a file: reading it again from the beginning is another pass
_MB: Final = 1e6


@final
class StatusLine:
    """The last line of a terminal, which is replaced; nothing, if the stream is not a terminal."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.__stderr__ if stream is None else stream
        self._is_shown = False
        self.is_terminal: bool = self._stream is not None and self._stream.isatty()

    def show(self, text: str) -> None:
        """Replace the line by this text."""
        if self.is_terminal and self._stream is not None:
            self._stream.write(f"\r{text}\x1b[K")  # clear to the end of the line
            self._stream.flush()
            self._is_shown = True

    def clear(self) -> None:
        """Remove the line."""
        if self._is_shown:
            self.show("\r")
            self._is_shown = False


@final
class FilesRead:
    """How far the files of a work were read, in words.

    Args:
        paths: the files that the work reads, or one that it writes.
        size: the size that the file will have [bytes]; None: its own.
    """

    def __init__(self, paths: Sequence[str], size: int | None = None) -> None:
        self._places = [os.path.realpath(path) for path in paths]
        self._size = size
        self._path = ""
        self._position = 0
        self._moved_s = 0.0
        self._begun_s = 0.0
        self._begun_at = 0
        self._passes: dict[str, int] = {}

    def look(self, now_s: float) -> str | None:
        """Return the line at a time [s], at least half a second after the last; or None."""
        path, position = self._present()
        if not path:
            return None
        size = self._size or os.path.getsize(path)
        if path != self._path or position < self._position:
            if path != self._path or self._position >= _END * size:
                self._passes[path] = self._passes.get(path, 0) + 1
            self._path, self._begun_s, self._begun_at = path, now_s, position
            self._moved_s = now_s
        elif position > self._position:
            self._moved_s = now_s
        self._position = position
        return self._line(now_s, size)

    def _line(self, now_s: float, size: int) -> str:
        name = os.path.basename(self._path).removesuffix(".part")
        number = self._passes.get(self._path, 1)
        done = f"{name}: {100 * self._position // max(1, size)} %"
        if number > 1:
            done += f" of pass {number}"
        if now_s - self._moved_s >= _STILL_S:
            return f"{done}, working for {now_s - self._moved_s:.0f} s"
        passed_s = now_s - self._begun_s
        rate = (self._position - self._begun_at) / passed_s if passed_s > 0 else 0.0
        done += f", {self._position / _MB:,.1f} of {size / _MB:,.1f} MB"
        if rate <= 0:
            return done
        left_s = max(0.0, size - self._position) / rate
        return f"{done}, {rate / _MB:,.1f} MB/s, {left_s:,.0f} s left"

    def _present(self) -> tuple[str, int]:
        """Return the file that is open, and the position in it; "" if none is."""
        found = "", -1
        with suppress(OSError):
            for number in os.listdir("/proc/self/fd"):
                with suppress(OSError, ValueError):
                    path = os.readlink(f"/proc/self/fd/{number}")
                    if any(path == place or _is_part(path, place) for place in self._places):
                        with open(f"/proc/self/fdinfo/{number}") as file:
                            position = int(file.readline().split()[1])
                        found = max(found, (path, position), key=lambda one: one[1])
        return found


def _is_part(path: str, place: str) -> bool:
    return path.startswith(place) and path.endswith(".part")


@final
class _Above:
    """A text stream whose texts replace the status line; everything but writing is that one's."""

    def __init__(self, stream: TextIO, line: StatusLine) -> None:
        self._stream = stream
        self._line = line

    def write(self, text: str) -> int:
        """Write the text."""
        self._line.clear()
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:  # Any: whatever the stream has
        return getattr(self._stream, name)


@contextmanager
def following(
    verb: str, paths: Sequence[str], size: int | None = None, line: StatusLine | None = None
) -> Iterator[None]:
    """Show on a terminal how far the files were read, until the block ends.

    Args:
        verb: the verb that reads.
        paths: the files that it reads, or one that it writes.
        size: the size that the file will have [bytes]; None: its own.
        line: the line to show; None: that of stderr.
    """
    line = StatusLine() if line is None else line
    if not line.is_terminal:
        yield
        return
    over = threading.Event()
    files = FilesRead(paths, size)

    def run() -> None:
        wait_s = _FIRST_S
        while not over.wait(wait_s):
            wait_s = _LOOK_S
            text = files.look(time.monotonic())
            if text is not None:
                line.show(f"motorhil {verb}: {text}")

    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (cast("TextIO", _Above(stream, line)) for stream in before)
    thread = threading.Thread(target=run, name="progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        line.clear()
        sys.stdout, sys.stderr = before
