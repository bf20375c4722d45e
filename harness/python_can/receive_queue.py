"""Receive queue of an application's connection to an emulated bus.

The bus passes every frame to it. It has a module of its own because it is compiled, and classes
that derive from python-can's cannot be.
"""

from collections import deque
from typing import TYPE_CHECKING, final

from motorhil.emulators.can.frame import FRAME_BYTES

if TYPE_CHECKING:
    from motorhil.motorapi.runtime.api import FrameListener


@final
class ReceiveQueue:
    """A receive queue that also passes frames to listeners.

    Attributes:
        listeners: callbacks for every classical frame, in the order of subscription.
        fd_listeners: callbacks for every frame, called after those.
        backlog: unread (frame, time [ns], transmitted), oldest first.
        keeps: True if frames are queued at all.
        dropped: number of unread frames that were discarded, oldest first.
    """

    def __init__(self, own: bool, backlog_max: int, fd: bool) -> None:
        """Create an empty queue that keeps frames.

        Args:
            own: True to queue frames that this connection transmitted itself as well.
            backlog_max: maximum number of queued frames; beyond it the oldest one is dropped.
            fd: True to queue CAN FD frames as well.
        """
        self.listeners: list[FrameListener] = []
        self.fd_listeners: list[FrameListener] = []
        self.backlog: deque[tuple[bytes, int, bool]] = deque()
        self.keeps = True
        self.dropped: int = 0
        self._own = own
        self._backlog_max = backlog_max
        self._fd = fd

    def receive(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        """Process a frame from the bus; `transmitted` marks frames that this connection sent."""
        if len(frame) == FRAME_BYTES:
            for listener in self.listeners:
                listener(frame, time_ns, transmitted)
        elif not self._fd:
            return
        for listener in self.fd_listeners:
            listener(frame, time_ns, transmitted)
        if self.keeps and (self._own or not transmitted):
            if len(self.backlog) >= self._backlog_max:
                self.backlog.popleft()
                self.dropped += 1
            self.backlog.append((frame, time_ns, transmitted))

    def has_frame(self) -> bool:
        """Return True if a frame is waiting to be read."""
        return bool(self.backlog)
