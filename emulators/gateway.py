"""What a world in wall time has towards the outside: gateways, and what they hear from."""

from collections.abc import Sequence
from typing import Protocol


class Source(Protocol):
    """Where input comes from: a socket, or whatever else has a descriptor (a pseudo-terminal)."""

    def fileno(self) -> int:
        """The descriptor to wait for."""


class Gateway(Protocol):
    """Something outside that talks to the world; called by the loop, in its thread."""

    def sources(self) -> Sequence[Source]:
        """What to watch for input just now; the same object as before only if it is the same."""

    def readable(self, source: Source) -> None:
        """There is input from this source."""

    def backlogged(self) -> bool:
        """Whether output waits for somebody to take it."""

    def close(self) -> None:
        """Leave nothing open."""
