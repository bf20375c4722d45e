"""Bus listener of a replayed host, which ignores frames from before a reset."""

from collections.abc import Callable
from typing import final


@final
class Ears:
    """A bus listener that ignores all frames before a given frame of its own.

    Args:
        hear: called with each frame, its time [ns], and True if the frame is an own one.
        opening: the frame to wait for; None: listen at once.
    """

    def __init__(self, hear: Callable[[bytes, int, bool], None], opening: bytes | None) -> None:
        self._hear = hear
        self._opening = opening

    def heard(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        """Handle a frame that was on the bus."""
        if self._opening is not None:
            if not transmitted or frame != self._opening:
                return
            self._opening = None
        self._hear(frame, time_ns, transmitted)
