"""Streamed set-points, for ramps that the drive does not provide.

CANSimple can set the limits of position trapezoids only. The ramps of velocity and torque are
parameters of the drive that only endpoints (04h) reach. So these ramps are the host's, in small
steps. If the host dies during a ramp, the drive's watchdog ends the last step.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.errors import MotorError

from motorhil_odrive.host.watch import Reached

if TYPE_CHECKING:
    from motorhil.motorapi.ownership.fencing import BoundFence
    from motorhil.motorapi.runtime.api import Registration

    from motorhil_odrive.host.hardware import OdriveHwMotor
    from motorhil_odrive.host.messages import Message
    from motorhil_odrive.host.wire import Sent


@final
class Stream:
    """A stream of set-points, which starts with `begin`, and ends by itself or by `cancel`.

    Args:
        hardware: the drive.
        message: the message with the set-point, as its only or its first signal.
        value: the set-point in the drive's units, over the time since the start [s].
        duration_s: the time of the last set-point.
        watch: receives the last set-point's frame.

    Attributes:
        message: as above.
        error: the error that ended the stream early, or None.
        last: the last set-point sent.
    """

    def __init__(
        self,
        hardware: "OdriveHwMotor",
        message: "Message",
        value: Callable[[float], float],
        duration_s: float,
        watch: Reached,
    ) -> None:
        self.error: MotorError | None = None
        self.last = 0.0
        self._hardware = hardware
        self.message: Final = message
        self._value = value
        self._duration_s = duration_s
        self._watch = watch
        self._fence: BoundFence | None = None
        self._began_ns = 0
        self._registration: Registration | None = None

    @property
    def is_going(self) -> bool:
        """True if more set-points will come."""
        return self._registration is not None

    def begin(self) -> "Sent":
        """Send the first set-point, and start the others; raise as `OdriveHwMotor.tell`."""
        hardware = self._hardware
        self._began_ns = hardware.runtime.now_ns()
        if hardware.fence is not None:
            self._fence = hardware.fence.bound("a stream of set-points")
        sent = self._watch.sent = self._send(0.0)
        if self._duration_s > 0.0:
            period_s = hardware.options.stream_period_ms / 1e3
            self._registration = hardware.runtime.every(period_s, self._again)
        return sent

    def cancel(self) -> None:
        """End the stream; cancelling again does nothing."""
        registration, self._registration = self._registration, None
        if registration is not None:
            registration.cancel()
        fence, self._fence = self._fence, None
        if fence is not None:
            fence.release()

    def _again(self) -> None:
        elapsed_s = (self._hardware.runtime.now_ns() - self._began_ns) / 1e9
        try:
            self._send(min(elapsed_s, self._duration_s))
        except MotorError as error:
            self.error = error
            self.cancel()
            self._hardware.heard.news.grow()

    def _send(self, at_s: float) -> "Sent":
        self.last = self._value(at_s)
        values = (self.last, 0.0) if len(self.message.signals) == 2 else (self.last,)
        sent = self._hardware.tell(self.message, *values, fence=self._fence)
        if at_s >= self._duration_s:
            self._watch.arrive(sent)
            self.cancel()
        return sent
