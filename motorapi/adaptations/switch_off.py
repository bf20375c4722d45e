"""An amplifier is switched off again until its node shows that it is: a frame may be lost."""

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
    """Takes the enable input of one amplifier away, every 10 ms.

    Otherwise an amplifier that missed the one frame would go on with the current that it was given
    last, for as long as its node hears the host: nobody's servo closes the loop any more, and no
    dead-man helps. Meanwhile the node stays this process's: who else enabled an amplifier of it
    would have it switched off again.

    Args:
        io: the node.
        channel: of the amplifier.
        hold: of the node, released at the end; None: no other process can have it.
    """

    def __init__(self, io: "AmplifierNode", channel: int, hold: "Hold | None") -> None:
        self._io = io
        self._channel = channel
        self._hold = hold
        self._left = _REPEATS
        self._since_ns = io.link.runtime.now_ns()
        self._registration = io.link.runtime.every(_REPEAT_S, self._again)

    def see(self, time_ns: int) -> None:
        """The node told its digital inputs."""
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
            pass  # the bus may take the next one
        except MotorBusyError:
            self.end()  # another process's by now, and so is the amplifier

    def end(self) -> None:
        """Nothing is sent any more, and the node not held for it; again does nothing."""
        self._registration.cancel()
        hold, self._hold = self._hold, None
        if hold is not None:
            hold.release()
