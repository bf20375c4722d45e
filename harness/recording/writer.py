"""Writing of live traffic: ordered and counted, to one file or several.

The pump has no clock; its caller passes the time. In each round the caller reads every bus until it
is empty, then passes the frames and the start time of the round. A frame stamped after that start
may be preceded by a frame that another bus had not yet delivered. The pump therefore holds it back
until the next round, and no longer. Its messages go to a series of files, each complete.
"""

import os
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from glob import escape, glob
from operator import itemgetter
from typing import Final, Protocol, final

from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.chunk import Entry
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, LOG, Direction, Level, Schema, encode_log

FLUSH_NS: Final = 1_000_000_000
_HAND_OVER: Final = 2048  # frames; packing in bulk halves the cost per frame
_DIRECTIONS: Final = (Direction.RECEIVED, Direction.TRANSMITTED)
_time_of: Final = itemgetter(1)
_source_of: Final = itemgetter(0)


class Sink(Protocol):
    """Destination of messages, such as `Series`; all methods may raise TraceError."""

    def extend(self, entries: list[Entry]) -> None:
        """Record these messages in this order."""

    def flush(self) -> None:
        """Pass all messages so far to the operating system."""

    def close(self, facts: dict[str, dict[str, str]]) -> None:
        """Complete the recording, with these tables of strings as its metadata."""


def opener(
    buses: Sequence[str], metadata: dict[str, dict[str, str]], compact: bool
) -> Callable[[str], TraceWriter]:
    """Return a maker of files where bus k has sources 2 k (received) and 2 k + 1 (this host)."""

    def open_file(path: str) -> TraceWriter:
        writer = TraceWriter(path, metadata, compact)
        for name in buses:
            channel = writer.channel(f"/can/{name}", Schema.of(CAN_FRAME))
            for direction in _DIRECTIONS:
                writer.source(channel, "", direction)
        writer.channel("/events", Schema.of(LOG))
        return writer

    return open_file


@final
class Pump:
    """Recorder that orders and counts the frames of several buses.

    Attributes:
        frames: number of frames recorded so far, by bus.
        dropped: number of frames known to be lost before they reached the pump, by bus.
        first_ns, last_ns: the earliest and latest recorded time [ns]; None if nothing is recorded.
    """

    def __init__(self, buses: Sequence[str], sink: Sink, flush_ns: int = FLUSH_NS) -> None:
        """Set up an empty recording.

        Args:
            buses: names of the buses.
            sink: must have the sources that `opener` creates.
            flush_ns: longest time for which entries wait to be written [ns].
        """
        self._flush_ns = flush_ns
        self.frames: list[int] = [0] * len(buses)
        self.dropped: list[int] = [0] * len(buses)
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self._buses = list(buses)
        self._events = len(buses) + 1  # the channel after those of the buses
        self._sink = sink
        self._held: list[Entry] = []
        self._pending: list[Entry] = []
        self._unwritten_since_ns: int | None = None
        self._second = 0

    def take(self, came: Sequence[list[Entry]], began_ns: int) -> int:
        """Record the frames of one round and return their number.

        Args:
            came: (source, time [ns], frame) in order, for each bus.
            began_ns: when the first bus was read, by the clock of the stamps [ns].

        Raises:
            TraceError: the frames cannot be written.
            ValueError: an entry is not a CAN frame.
        """
        count = 0
        entries = self._held
        for bus, of_bus in enumerate(came):
            self.frames[bus] += len(of_bus)
            count += len(of_bus)
        fresh = [entry for of_bus in came for entry in of_bus] if len(came) != 1 else came[0]
        if len(came) > 1:
            fresh.sort(key=_time_of)
            end = bisect_right(fresh, began_ns, key=_time_of)
            if end < len(fresh) or entries:
                entries, self._held, fresh = entries + fresh[:end], fresh[end:], []
                entries.sort(key=_time_of)
        self._record(fresh or entries, began_ns)
        return count

    def lost(self, bus: int, total: int, now_ns: int) -> None:
        """Set the total number of lost frames of a bus; record an event if it has grown."""
        more = total - self.dropped[bus]
        if more > 0:
            self.dropped[bus] = total
            self.event(now_ns, Level.WARNING, self._buses[bus], f"{more} frames were lost here")

    def event(self, time_ns: int, level: Level, name: str, text: str) -> None:
        """Record an event about the recording itself. Raises TraceError like `take`."""
        self._record([(-self._events, time_ns, encode_log(time_ns, level, text, name))], time_ns)

    def tick(self, now_ns: int) -> None:
        """Write out entries that have waited for long enough. Raises TraceError like `take`."""
        since = self._unwritten_since_ns
        if since is not None and not 0 <= now_ns - since < self._flush_ns:
            self._unwritten_since_ns = None
            self._hand_over()
            self._sink.flush()

    def close(self, facts: dict[str, dict[str, str]]) -> None:
        """Record the held entries and complete the file. Raises TraceError like `take`."""
        try:
            held, self._held = self._held, []
            self._record(held, 0)
            self._hand_over()
        finally:
            self._sink.close(facts)

    def _record(self, entries: list[Entry], now_ns: int) -> None:
        if not entries:
            return
        first, last = entries[0][1], entries[-1][1]
        self.first_ns = first if self.first_ns is None else min(first, self.first_ns)
        self.last_ns = last if self.last_ns is None else max(last, self.last_ns)
        self._pending += entries
        # The writer itself ends its chunk when a new second begins, by the clock of the stamps.
        is_new = last // FLUSH_NS > self._second
        if self._unwritten_since_ns is None or is_new:
            self._unwritten_since_ns = now_ns
            self._second = last // FLUSH_NS
        if is_new or len(self._pending) >= _HAND_OVER:
            self._hand_over()

    def _hand_over(self) -> None:
        pending, self._pending = self._pending, []
        self._sink.extend(pending)


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
        self.bytes_before: int = 0
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
