"""Limit of the frames of one port that wait for its bus."""

from typing import Final, Protocol, final

_WAITING_MAX: Final = 65_536
_LOOK: Final = 1_024  # frames from one look at those that wait to the next


class Sender(Protocol):
    """A port that sends frames."""

    def pending(self) -> int:
        """Return the number of its frames that are not yet sent."""


@final
class SendLimit:
    """The frames that one port has queued, counted.

    A program that sends and never waits lets no time pass, so that none of them is sent.
    """

    def __init__(self, port: Sender, bus: str) -> None:
        self._port = port
        self._bus = bus
        self._queued = 0

    def count(self) -> None:
        """Count a queued frame.

        Raises:
            ValueError: as many frames wait as the limit; looked at after each 1,024 of them.
        """
        self._queued += 1
        if self._queued % _LOOK:
            return
        waiting = self._port.pending()
        if waiting >= _WAITING_MAX:
            raise ValueError(
                f"{self._bus}: {waiting} frames wait for the bus; expected at most {_WAITING_MAX};"
                " let time pass between sends, as frames are sent while you wait"
            )
