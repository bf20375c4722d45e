"""One recording, or several one after another, each complete on its own."""

import os
from bisect import bisect_left
from collections.abc import Callable
from glob import escape, glob
from operator import itemgetter
from typing import Final, final

from traces.chunk import Entry
from traces.errors import TraceError
from traces.writer import TraceWriter

_time_of: Final = itemgetter(1)


@final
class Series:
    """Where frames go: a file until it is large or long enough, then the next one.

    Attributes:
        paths: the files, the one being written last.
        bytes_before: of files that are complete.
    """

    def __init__(
        self,
        path: str,
        open_file: Callable[[str], TraceWriter],
        *,
        rotate_bytes: int | None = None,
        rotate_ns: int | None = None,
        overwrite: bool = False,
    ) -> None:
        """The first file is begun.

        Args:
            path: FILE.mcap; with either limit the files are FILE-0001.mcap and so on.
            open_file: makes a writer that knows its channels and sources, always the same.
            rotate_bytes: a file ends once it is so large, behind a chunk.
            rotate_ns: a file ends so long after its first message.
            overwrite: older recordings of these names may be lost.

        Raises:
            TraceError: it cannot be written, or a file of that name would be lost.
        """
        self.paths: list[str] = []
        self.bytes_before = 0
        self._path = path
        self._open_file = open_file
        self._rotate_bytes = rotate_bytes
        self._rotate_ns = rotate_ns
        self._overwrite = overwrite
        self._end_ns: int | None = None  # of this file; None: nothing is in it
        self._refuse_loss()
        self._writer = self._next()

    @property
    def bytes(self) -> int:
        """Of all files, as far as it is with the operating system."""
        return self.bytes_before + self._writer.size

    def extend(self, entries: list[Entry]) -> None:
        """These messages are recorded, in this order.

        Raises:
            TraceError: they cannot be written.
        """
        while entries:
            if self._rotate_ns is not None:
                if self._end_ns is None:
                    self._end_ns = entries[0][1] + self._rotate_ns
                end = bisect_left(entries, self._end_ns, key=_time_of)
            else:
                end = len(entries)
            self._writer.extend(entries[:end])
            entries = entries[end:]
            if entries or self._is_large():
                self._rotate()

    def flush(self) -> None:
        """All messages so far are with the operating system. Raises as `extend`."""
        self._writer.flush()
        if self._is_large():
            self._rotate()

    def close(self, facts: dict[str, dict[str, str]]) -> None:
        """The last file is complete, with these tables of strings. Raises as `extend`."""
        try:
            if self._writer.error is None:
                for name, values in facts.items():
                    self._writer.add_metadata(name, values)
        finally:
            self._writer.close()

    def _is_large(self) -> bool:
        return self._rotate_bytes is not None and self._writer.size >= self._rotate_bytes

    def _rotate(self) -> None:
        self._writer.close()
        self.bytes_before += self._writer.size
        self._end_ns = None
        self._writer = self._next()

    def _name(self, number: int) -> str:
        if self._rotate_bytes is None and self._rotate_ns is None:
            return self._path
        root, ending = os.path.splitext(self._path)
        return f"{root}-{number:04d}{ending}"

    def _refuse_loss(self) -> None:
        """Raises TraceError before anything is recorded: a file that will be needed is there."""
        if self._overwrite:
            return
        taken = [self._name(1)]
        if taken[0] != self._path:
            root, ending = os.path.splitext(self._path)
            taken = sorted(glob(f"{escape(root)}-[0-9][0-9][0-9][0-9]{escape(ending)}"))
        for path in taken:
            if os.path.exists(path) and os.path.getsize(path):
                raise TraceError(path, "exists", remedy="name another file, or say --force")

    def _next(self) -> TraceWriter:
        path = self._name(len(self.paths) + 1)
        writer = self._open_file(path)
        self.paths.append(path)
        return writer
