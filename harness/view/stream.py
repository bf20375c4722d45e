"""Events for pages, by their position in the record.

A position names the messages that an event includes: their number, and the CRC of their contents.
Equal positions mean equal histories, even in another process. A page that reconnects sends its
last position; it gets the events after that, or None if they are no longer here.
"""

from collections import deque
from typing import Final, final

from motorhil.frozen import frozen

EVENTS_MAX: Final = 600
BYTES_MAX: Final = 16_000_000


@final
@frozen
class Event:
    """One event: the position after it, its kind, and its data without line ends."""

    position: str
    kind: str
    data: str

    def text(self) -> bytes:
        """Return the event as server-sent text (WHATWG HTML, server-sent events)."""
        return f"id: {self.position}\nevent: {self.kind}\ndata: {self.data}\n\n".encode()


@final
class Stream:
    """The latest events, limited in number and bytes.

    Attributes:
        position: the position after the latest event; "" before the first.
    """

    def __init__(self, events_max: int = EVENTS_MAX, bytes_max: int = BYTES_MAX) -> None:
        self.position: str = ""
        self._events_max = events_max
        self._bytes_max = bytes_max
        self._kept: deque[tuple[str, Event]] = deque()  # with the position before each event
        self._bytes = 0

    def append(self, event: Event) -> None:
        """Add an event that follows the latest one."""
        self._kept.append((self.position, event))
        self._bytes += len(event.data)
        self.position = event.position
        while len(self._kept) > self._events_max or self._bytes > self._bytes_max:
            _, oldest = self._kept.popleft()
            self._bytes -= len(oldest.data)

    def after(self, position: str) -> list[Event] | None:
        """Return the events after a position; None: they do not follow from what is kept."""
        if position == self.position:
            return []
        found: list[Event] = []
        for before, event in reversed(self._kept):
            found.append(event)
            if before == position:
                return found[::-1]
        return None
