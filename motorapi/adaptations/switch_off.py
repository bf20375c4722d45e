"""Repeated switching-off of an amplifier, as a frame may be lost."""

from typing import TYPE_CHECKING, Final, final

from motorapi.errors import LinkError, MotorBusyError

if TYPE_CHECKING:
    from motorapi.adaptations.software_node import AmplifierNode
    from motorapi.process_lock import Hold

READY: Final = 1
_REPEAT_S: Final = 0.01
_REPEATS: Final = 500


@final
class SwitchOff:
    """A command that clears the enable input of one amplifier, every 10 ms until it is confirmed.

    Without it, an amplifier that missed the one frame would keep its last current while its node
    hears the host. The loop is open, and no supervision helps. Meanwhile this process occupies the
    node; otherwise another process could enable an amplifier that is then switched off again.

    Args:
        io: the node.
        channel: the channel of the amplifier.
        hold: the occupation of the node, released at the end; None: no other process can have it.
    """

    def __init__(self, io: "AmplifierNode", channel: int, hold: "Hold | None") -> None:
        self._io = io
        self._channel = channel
        self._hold = hold
        self._left = _REPEATS
        self._since_ns = io.link.runtime.now_ns()
        self._registration = io.link.runtime.every(_REPEAT_S, self._again)

    def see(self, time_ns: int) -> None:
        """Evaluate digital inputs received from the node."""
        if time_ns > self._since_ns and not self._io.status(self._channel) & READY:
            self.end()

    def _again(self) -> None:
        if not self._left:
            self.end()
            return
        self._left -= 1
        try:
            self._io.switch(self._channel, False)
        except LinkError:
            pass  # the bus may accept the next one
        except MotorBusyError:
            self.end()  # another process owns the node now, and the amplifier

    def end(self) -> None:
        """End the repetition and release the node; further calls do nothing."""
        self._registration.cancel()
        hold, self._hold = self._hold, None
        if hold is not None:
            hold.release()
