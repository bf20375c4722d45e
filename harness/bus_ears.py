"""What one application's connection to an emulated bus hears. Every frame on the bus comes here."""

from collections import deque
from typing import TYPE_CHECKING, final

from emulators.media.can_frame import FRAME_BYTES

if TYPE_CHECKING:
    from motorapi.runtime import FrameListener


@final
class Ears:
    """Hands frames to listeners, and keeps them for whoever reads them one by one.

    Attributes:
        listeners: who hears every frame, in the order of subscription.
        backlog: (frame, time [ns], transmitted) nobody has read yet, oldest first.
        keeps: whether frames are kept at all.
        dropped: frames nobody read, given up oldest first.
    """

    def __init__(self, own: bool, backlog_max: int, fd: bool) -> None:
        """Frames are kept.

        Args:
            own: whether those that this connection has transmitted itself are kept too.
            backlog_max: how many; then the oldest one is dropped.
            fd: whether CAN FD frames are kept too. Listeners hear classical ones only.
        """
        self.listeners: list[FrameListener] = []
        self.backlog: deque[tuple[bytes, int, bool]] = deque()
        self.keeps = True
        self.dropped = 0
        self._own = own
        self._backlog_max = backlog_max
        self._fd = fd

    def hear(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        """A frame was on the bus; `transmitted`: by this connection."""
        if len(frame) == FRAME_BYTES:
            for listener in self.listeners:
                listener(frame, time_ns, transmitted)
        elif not self._fd:
            return
        if self.keeps and (self._own or not transmitted):
            if len(self.backlog) >= self._backlog_max:
                self.backlog.popleft()
                self.dropped += 1
            self.backlog.append((frame, time_ns, transmitted))

    def has_frame(self) -> bool:
        """Whether a frame is waiting to be read."""
        return bool(self.backlog)
