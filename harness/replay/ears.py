"""What a replayed host hears of a bus: with a reset, nothing from before it."""

from collections.abc import Callable
from typing import final


@final
class Ears:
    """A listener to a bus, deaf until a frame of its own has been on it.

    Args:
        hear: told each frame, when it was on the bus, and whether it is an own one.
        opening: the frame; None: there is none to wait for.
    """

    def __init__(self, hear: Callable[[bytes, int, bool], None], opening: bytes | None) -> None:
        self._hear = hear
        self._opening = opening

    def heard(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        """A frame was on the bus."""
        if self._opening is not None:
            if not transmitted or frame != self._opening:
                return
            self._opening = None
        self._hear(frame, time_ns, transmitted)
