"""Own frames on their way, and when each was on the wire."""

from collections import deque
from collections.abc import Sequence
from typing import Final, final

from motorapi.errors import LinkError

_UNCONFIRMED_MAX: Final = 1000


@final
class Transmission:
    """One frame on its way; `time_ns` is when it was complete on the bus, None before that."""

    __slots__ = ("frame", "time_ns")

    def __init__(self, frame: bytes) -> None:
        self.frame = frame
        self.time_ns: int | None = None


def all_sent(transmissions: Sequence[Transmission]) -> bool:
    """Whether all of them were on the wire."""
    return all(one.time_ns is not None for one in transmissions)


@final
class Transmissions:
    """All that wait for one bus, by identifier."""

    def __init__(self, link: str) -> None:
        self._link: Final = link
        self._awaited: dict[bytes, deque[Transmission]] = {}

    def add(self, transmission: Transmission, confirms: bool) -> None:
        """It waits for the bus, which tells of own frames (`confirms`), or has not yet.

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
            waiting.popleft()  # a bus that never tells of own frames
        waiting.append(transmission)

    def remove(self, transmission: Transmission) -> None:
        """It was not sent after all."""
        self._awaited[transmission.frame[:4]].remove(transmission)

    def pending(self, key: bytes) -> Sequence[Transmission]:
        """Those that wait with this identifier (its 4 bytes)."""
        return tuple(self._awaited.get(key, ()))

    def confirm(self, frame: bytes, time_ns: int) -> None:
        """Of one identifier's frames the oldest equal one was sent; those before it never were."""
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
        """None of them is waited for any more: with the bus off they are lost."""
        self._awaited.clear()
