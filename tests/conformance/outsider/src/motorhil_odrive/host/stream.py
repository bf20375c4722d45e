"""Set-points that change from frame to frame, where the drive has no ramp that we could set.

CANSimple can set the limits of trapezoids of position, and no others: the ramps of velocity and
torque are parameters of the drive that only endpoints (04h) reach. So these ramps are the host's,
in small steps, and a host that dies in the middle leaves the last step to the drive's watchdog.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from motorapi.errors import MotorError
from motorhil_odrive.host.watch import Reached

if TYPE_CHECKING:
    from motorapi.fencing import BoundFence
    from motorapi.runtime import Registration
    from motorhil_odrive.host.hardware import OdriveHwMotor
    from motorhil_odrive.host.messages import Message
    from motorhil_odrive.host.wire import Sent


@final
class Stream:
    """One of them; it begins with `begin`, and ends by itself or by `cancel`.

    Args:
        hardware: of the drive.
        message: which brings a set-point, as the first of two signals or alone.
        value: the set-point, so many seconds after the beginning, in the drive's units.
        duration_s: when the last one is due.
        watch: is told of the last one.

    Attributes:
        message: as above.
        error: why it ended early; None: it did not.
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
        """Whether more set-points will come."""
        return self._registration is not None

    def begin(self) -> "Sent":
        """The first set-point is on its way, the others follow. Raises as `OdriveHwMotor.tell`."""
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
        """There are no more set-points; cancelling again does nothing."""
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
