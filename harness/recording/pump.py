"""What was read from buses goes to a file, in the order of its times, and is counted.

The pump is told the time and asks no clock. Whoever reads the buses reads all of them until they
are empty and tells what came, and when that began: a frame stamped later may have an earlier one
before it that another bus had not yet delivered, so it waits for the next round, never longer.
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
_HAND_OVER: Final = 2048  # frames; packed in bulk they cost half as much as a few at a time
_DIRECTIONS: Final = (Direction.RECEIVED, Direction.TRANSMITTED)
_time_of: Final = itemgetter(1)
_source_of: Final = itemgetter(0)


class Sink(Protocol):
    """Where messages go (harness.recording.series.Series); all may raise TraceError."""

    def extend(self, entries: list[Entry]) -> None:
        """These messages are recorded, in this order."""

    def flush(self) -> None:
        """All messages so far are with the operating system."""

    def close(self, facts: dict[str, dict[str, str]]) -> None:
        """The recording is complete, with these tables of strings."""


def opener(
    buses: Sequence[str], metadata: dict[str, dict[str, str]], compact: bool
) -> Callable[[str], TraceWriter]:
    """Makes files in which bus k has the sources 2 k (received) and 2 k + 1 (of this host)."""

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
    """Orders, counts and records what comes from several buses.

    Attributes:
        frames: recorded so far, by bus.
        dropped: lost on the way to us, by bus, as far as it is known.
        first_ns, last_ns: the earliest and latest time recorded; None: nothing was.
    """

    def __init__(self, buses: Sequence[str], sink: Sink) -> None:
        """Nothing is recorded yet; `sink` has the sources that `opener` gives it."""
        self.frames = [0] * len(buses)
        self.dropped = [0] * len(buses)
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self._buses = list(buses)
        self._events = len(buses) + 1  # the channel behind those of buses
        self._sink = sink
        self._held: list[Entry] = []
        self._pending: list[Entry] = []
        self._unwritten_since_ns: int | None = None
        self._second = 0

    def take(self, came: Sequence[list[Entry]], began_ns: int) -> int:
        """What buses gave in one round that began then; how many frames that was.

        Args:
            came: of each bus, (source, time [ns], frame) in order.
            began_ns: when the first bus was asked, by the clock of the stamps.

        Raises:
            TraceError: they cannot be written.
            ValueError: one is no CAN frame.
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
        """So many frames of a bus have been lost up to now; told in the recording if it is news."""
        more = total - self.dropped[bus]
        if more > 0:
            self.dropped[bus] = total
            self.event(now_ns, Level.WARNING, self._buses[bus], f"{more} frames were lost here")

    def event(self, time_ns: int, level: Level, name: str, text: str) -> None:
        """Something happened to the recording itself. Raises TraceError as `take`."""
        self._record([(-self._events, time_ns, encode_log(time_ns, level, text, name))], time_ns)

    def tick(self, now_ns: int) -> None:
        """It is `now_ns`: what has waited a second is in the file. Raises TraceError as `take`."""
        since = self._unwritten_since_ns
        if since is not None and not 0 <= now_ns - since < FLUSH_NS:
            self._unwritten_since_ns = None
            self._hand_over()
            self._sink.flush()

    def close(self, facts: dict[str, dict[str, str]]) -> None:
        """All is recorded, and the file complete. Raises TraceError as `take`."""
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
        # The writer ends its chunk itself when a new second begins, by the clock of the stamps.
        is_new = last // FLUSH_NS > self._second
        if self._unwritten_since_ns is None or is_new:
            self._unwritten_since_ns = now_ns
            self._second = last // FLUSH_NS
        if is_new or len(self._pending) >= _HAND_OVER:
            self._hand_over()

    def _hand_over(self) -> None:
        pending, self._pending = self._pending, []
        self._sink.extend(pending)
