"""Limit of the frames of one port that wait for its bus, or of characters for its line."""

from typing import Final, Protocol, final

_WAITING_MAX: Final = 65_536
_LOOK: Final = 1_024  # frames from one look at those that wait to the next


class Sender(Protocol):
    """A port that sends frames or characters."""

    def pending(self) -> int:
        """Return the number of those that are not yet sent."""


@final
class SendLimit:
    """The times that one port has sent, counted.

    A program that sends and never waits lets no time pass, so that nothing leaves the port.

    Args:
        port: the port.
        bus: the bus or line, for messages.
        what: what the port counts as pending.
    """

    def __init__(self, port: Sender, bus: str, what: str = "frames") -> None:
        self._port = port
        self._bus = bus
        self._what = what
        self._queued = 0

    def count(self) -> None:
        """Count what was queued.

        Raises:
            ValueError: as much waits as the limit; looked at after each 1,024 calls.
        """
        self._queued += 1
        if self._queued % _LOOK:
            return
        waiting = self._port.pending()
        if waiting >= _WAITING_MAX:
            raise ValueError(
                f"{self._bus}: {waiting} {self._what} wait; expected at most {_WAITING_MAX};"
                " let time pass between sends, as what waits is sent while you wait"
            )
