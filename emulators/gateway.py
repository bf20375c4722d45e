"""Gateways between a world in wall time and the outside."""

from collections.abc import Sequence
from typing import Protocol


class Source(Protocol):
    """A source of input: a socket, or another object with a descriptor (a pseudo-terminal)."""

    def fileno(self) -> int:
        """Return the descriptor to wait for."""


class Gateway(Protocol):
    """An outside party that talks to the world; called by the loop, in its thread."""

    def sources(self) -> Sequence[Source]:
        """Return the sources to watch now; the same object as before only if unchanged."""

    def readable(self, source: Source) -> None:
        """Process input from this source."""

    def backlogged(self) -> bool:
        """Return whether output waits for a reader."""

    def close(self) -> None:
        """Close all resources."""
