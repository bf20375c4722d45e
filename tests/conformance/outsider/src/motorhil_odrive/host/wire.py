"""Frames of one ODrive: received messages, and tracking of sent ones."""

import struct
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.errors import LinkError
from motorhil.motorapi.runtime.can_sources import ERROR_FLAG, status_of

from motorhil_odrive.host.messages import Message, decoded, encoded

if TYPE_CHECKING:
    import can
    from motorhil.motorapi.ownership.fencing import Fence
    from motorhil.motorapi.runtime.api import Runtime

Handler = Callable[[tuple[float, ...], int], None]
"""(values of the signals, time [ns])."""

_FRAME: Final = struct.Struct("<IB3x8s")  # Linux can_frame
_REMOTE: Final = 0x4000_0000
_WAITING_MAX: Final = 256


@final
class Sent:
    """A sent frame; `time_ns` is when it was complete on the bus, or None before that."""

    __slots__ = ("frame", "time_ns")

    def __init__(self, frame: bytes) -> None:
        self.frame = frame
        self.time_ns: int | None = None


@final
class Wire:
    """The host's connection to one ODrive.

    Args:
        bus: the bus of the drive.
        runtime: the runtime for waits.
        node_id: the drive's node-ID.
        label: its name in errors.
        on_command: called with commands of other programs to this drive.
        on_bus_off: called when the bus goes off; queued frames are lost then.

    Attributes:
        status: the state of the bus from the host's CAN controller.
    """

    def __init__(
        self,
        bus: "can.BusABC",
        runtime: "Runtime",
        node_id: int,
        label: str,
        on_command: Callable[[int, int], None],
        on_bus_off: Callable[[], None],
    ) -> None:
        self._bus: Final = bus
        self._runtime: Final = runtime
        self._label: Final = label
        self._first: Final = node_id << 5
        self._on_command: Final = on_command
        self._on_bus_off: Final = on_bus_off
        self.status: Final = status_of(bus, label.partition(" node ")[0])
        self._handlers: dict[int, tuple[Message, Handler]] = {}
        self._waiting: deque[Sent] = deque(maxlen=_WAITING_MAX)
        self._registration = runtime.listen(bus, self._on_frame)

    def handle(self, message: Message, handler: Handler) -> None:
        """Pass the values of this message to `handler`."""
        self._handlers[self._first | message.command] = message, handler

    def tell(self, message: Message, *values: float, fence: "Fence | None" = None) -> Sent:
        """Send a command to the drive, only while its fence permits it.

        Raises:
            LinkError: the bus does not accept the frame.
            MotorBusyError: another user owns the motor.
        """
        data = encoded(message, *values)
        return self._send(_FRAME.pack(self._first | message.command, len(data), data), fence)

    def ask(self, message: Message) -> Sent:
        """Request this message by a remote frame."""
        can_id = self._first | message.command | _REMOTE
        return self._send(_FRAME.pack(can_id, message.length, b""), None)

    def confirm(self, sent: Sent, timeout_s: float = 0.5) -> int:
        """Return when the frame, and so all frames before it, was on the bus [ns].

        Raises:
            LinkError: not within `timeout_s` [s], or the bus went off.
        """
        status, offs = self.status, self.status.offs
        status.check()
        self._runtime.wait_until(lambda: sent.time_ns is not None or status.offs != offs, timeout_s)
        if sent.time_ns is not None:
            return sent.time_ns
        if status.offs != offs:
            raise status.failure()
        reason = f"a frame was not transmitted within {timeout_s:g} s"
        trouble = status.trouble()
        raise LinkError(link=self._label, reason=f"{reason}; {trouble}" if trouble else reason)

    def close(self) -> None:
        """Stop receiving."""
        self._registration.cancel()

    def _send(self, frame: bytes, fence: "Fence | None") -> Sent:
        from can import CanError

        self.status.check()
        sent = Sent(frame)
        self._waiting.append(sent)
        try:
            if fence is None:
                self._runtime.send(self._bus, frame)
            else:
                fence.send(frame)
        except (CanError, OSError) as error:
            self._waiting.remove(sent)
            raise LinkError(link=self._label, reason=f"cannot send: {error}") from error
        except BaseException:
            self._waiting.remove(sent)
            raise
        return sent

    def _on_frame(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        can_id, length, data = _FRAME.unpack(frame)
        if can_id & ERROR_FLAG:
            self._hear_controller(frame, time_ns)
            return
        if can_id & ~(_REMOTE | 0x1F) != self._first:
            return
        if transmitted:
            self.status.sent()
            for sent in self._waiting:
                if sent.frame == frame:
                    sent.time_ns = time_ns
                    self._waiting.remove(sent)
                    return
            return
        known = self._handlers.get(can_id)
        if can_id & _REMOTE:
            return  # a request of another program
        if known is None:
            self._on_command(can_id & 0x1F, time_ns)
            return
        message, handler = known
        values = decoded(message, data[:length])
        if values is not None:
            handler(values, time_ns)

    def _hear_controller(self, message: bytes, time_ns: int) -> None:
        """Handle an error message of the own CAN controller, which is not a frame from the bus."""
        status, offs = self.status, self.status.offs
        status.hear(message, time_ns)
        if status.offs != offs:
            self._waiting.clear()
            self._on_bus_off()
