"""Ordering, counting and recording of frames from several buses.

The pump has no clock; its caller passes the time. In each round the caller reads every bus until it
is empty, then passes the frames and the start time of the round. A frame stamped after that start
may be preceded by a frame that another bus had not yet delivered. The pump therefore holds it back
until the next round, and no longer.
"""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Final, Protocol, final

from traces.chunk import Entry
from traces.fields import encode_log
from traces.schema import CAN_FRAME, LOG, Direction, Level, Schema
from traces.writer import TraceWriter

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

    def __init__(self, buses: Sequence[str], sink: Sink) -> None:
        """Set up an empty recording; `sink` must have the sources that `opener` creates."""
        self.frames = [0] * len(buses)
        self.dropped = [0] * len(buses)
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
        """Write out entries that have waited for one second. Raises TraceError like `take`."""
        since = self._unwritten_since_ns
        if since is not None and not 0 <= now_ns - since < FLUSH_NS:
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
