"""Recording to one file, or to several consecutive files, each complete."""

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
    """Recording that starts a new file at a given size or duration.

    Attributes:
        paths: the files; the last one is being written.
        bytes_before: total size of the completed files [bytes].
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
        """Open the first file.

        Args:
            path: FILE.mcap; with either limit the files are FILE-0001.mcap and so on.
            open_file: makes a writer with its channels and sources, always the same ones.
            rotate_bytes: size after which a file ends, at the end of a chunk [bytes].
            rotate_ns: duration after which a file ends, from its first message [ns].
            overwrite: allow older recordings of these names to be overwritten.

        Raises:
            TraceError: the file cannot be written, or an existing file would be overwritten.
        """
        self.paths: list[str] = []
        self.bytes_before = 0
        self._path = path
        self._open_file = open_file
        self._rotate_bytes = rotate_bytes
        self._rotate_ns = rotate_ns
        self._overwrite = overwrite
        self._end_ns: int | None = None  # of this file; None while it is empty
        self._refuse_loss()
        self._writer = self._next()

    @property
    def bytes(self) -> int:
        """Total size of all files, as passed to the operating system [bytes]."""
        return self.bytes_before + self._writer.size

    def extend(self, entries: list[Entry]) -> None:
        """Record these messages in this order.

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
        """Pass all messages so far to the operating system. Raises TraceError like `extend`."""
        self._writer.flush()
        if self._is_large():
            self._rotate()

    def close(self, facts: dict[str, dict[str, str]]) -> None:
        """Complete the last file, with these metadata tables. Raises TraceError like `extend`."""
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
        """Raise TraceError before recording if an existing file would be overwritten."""
        if self._overwrite:
            return
        taken = [self._name(1)]
        if taken[0] != self._path:
            root, ending = os.path.splitext(self._path)
            taken = sorted(glob(f"{escape(root)}-[0-9][0-9][0-9][0-9]{escape(ending)}"))
        for path in taken:
            if os.path.exists(path) and os.path.getsize(path):
                raise TraceError(path, "exists", remedy="name another file, or give --force")

    def _next(self) -> TraceWriter:
        path = self._name(len(self.paths) + 1)
        writer = self._open_file(path)
        self.paths.append(path)
        return writer
