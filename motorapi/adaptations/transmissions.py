"""Own frames that wait for transmission, and their times on the wire."""

from collections import deque
from collections.abc import Sequence
from typing import Final, final

from motorapi.errors import LinkError

_UNCONFIRMED_MAX: Final = 1000


@final
class Transmission:
    """One queued frame; `time_ns` is its time of completion on the bus, None before that."""

    __slots__ = ("frame", "time_ns")

    def __init__(self, frame: bytes) -> None:
        self.frame = frame
        self.time_ns: int | None = None


def all_sent(transmissions: Sequence[Transmission]) -> bool:
    """Return whether all of them were on the wire."""
    return all(one.time_ns is not None for one in transmissions)


@final
class Transmissions:
    """All frames that wait for one bus, by identifier."""

    def __init__(self, link: str) -> None:
        self._link: Final = link
        self._awaited: dict[bytes, deque[Transmission]] = {}

    def add(self, transmission: Transmission, confirms: bool) -> None:
        """Record a frame that waits for the bus; `confirms`: whether the bus reports own frames.

        Raises:
            LinkError: the bus has not transmitted anything for a long time.
        """
        key = transmission.frame[:4]
        waiting = self._awaited.get(key)
        if waiting is None:
            waiting = self._awaited[key] = deque()
        elif len(waiting) >= _UNCONFIRMED_MAX:
            if confirms:
                reason = f"{len(waiting)} frames wait, none is transmitted"
                raise LinkError(link=self._link, reason=reason)
            waiting.popleft()  # a bus that does not report own frames
        waiting.append(transmission)

    def remove(self, transmission: Transmission) -> None:
        """Remove a frame that was not sent."""
        self._awaited[transmission.frame[:4]].remove(transmission)

    def pending(self, key: bytes) -> Sequence[Transmission]:
        """Return the waiting frames with this identifier (its 4 bytes)."""
        return tuple(self._awaited.get(key, ()))

    def confirm(self, frame: bytes, time_ns: int) -> None:
        """Confirm the oldest equal frame with this identifier; earlier ones were never sent."""
        waiting = self._awaited.get(frame[:4])
        if not waiting:
            return
        for place, transmission in enumerate(waiting):
            if transmission.frame == frame:
                transmission.time_ns = time_ns
                for _ in range(place + 1):
                    waiting.popleft()
                return

    def forget(self) -> None:
        """Forget all frames: with the bus off they are lost."""
        self._awaited.clear()
