"""Set-points sent by the host, for drives that follow a target but generate no profile.

The stream samples a function of time. It belongs to the ownership under which it began, and ends by
itself at its last set-point, or with the first error. If the host dies, the drive keeps the last
set-point until its own watchdog ends it: what that means is the drive's to tell.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.errors import MotorError, PluginError
from motorhil.motorapi.synchronization.quality import MotionTimes

if TYPE_CHECKING:
    from motorhil.motorapi.api.can_drive import CanDrive
    from motorhil.motorapi.ownership.fencing import BoundFence
    from motorhil.motorapi.runtime.api import Registration
    from motorhil.motorapi.runtime.can_link import Transmission as SentFrame

SendSetpoint = Callable[[float, "BoundFence | None"], "SentFrame"]
"""(value, fence for `CanDrive.command`): send one set-point."""


@final
class SetpointStream:
    """A stream of set-points, which starts with `begin`, and ends by itself or by `cancel`.

    Args:
        drive: the drive; its `news` count the end by an error.
        value: the set-point over the time since the start [s].
        duration_s: the time of the last set-point [s].
        period_s: the time between two set-points [s].
        send: sends one.
        on_last: called with the frame of the last set-point; None: nothing is.

    Attributes:
        last: the last set-point sent, or None.
        error: the error that ended the stream early, or None.
        late_s: the longest time by which a set-point exceeded its period [s]; 0 in virtual time.
    """

    def __init__(
        self,
        drive: "CanDrive",
        value: Callable[[float], float],
        duration_s: float,
        period_s: float,
        send: SendSetpoint,
        on_last: "Callable[[SentFrame], None] | None" = None,
    ) -> None:
        self.last: float | None = None
        self.error: MotorError | None = None
        self.late_s: float = 0.0
        self._drive: Final = drive
        self._value: Final = value
        self._duration_s: Final = duration_s
        self._period_s: Final = period_s
        self._send_one: Final = send
        self._on_last: Final = on_last
        self._first: SentFrame | None = None
        self._end: SentFrame | None = None
        self._fence: BoundFence | None = None
        self._began_ns = self._last_ns = 0
        self._registration: Registration | None = None

    @property
    def is_going(self) -> bool:
        """True if more set-points will come."""
        return self._registration is not None

    @property
    def is_queued(self) -> bool:
        """True until the first set-point was on the bus."""
        return self._first is not None and self._first.time_ns is None

    def begin(self) -> "SentFrame":
        """Send the first set-point, and start the others; raise as `CanDrive.command`."""
        drive = self._drive
        self._began_ns = self._last_ns = drive.runtime.now_ns()
        self._fence = drive.stream_fence("a stream of set-points")
        self._first = self._send(0.0)
        if self._duration_s > 0.0:
            self._registration = drive.runtime.every(self._period_s, self._again)
        return self._first

    def times(self) -> MotionTimes | None:
        """Return when the first and the last set-point were on the bus; None: not begun."""
        if self._first is None:
            return None
        began_ns, end = self._first.time_ns, self._end
        source = "the first and the last set-point on the wire"
        ended_ns = None if end is None else end.time_ns
        return MotionTimes(began_ns, ended_ns, source, latched_ns=began_ns)

    def cancel(self) -> None:
        """End the stream; cancelling again does nothing."""
        registration, self._registration = self._registration, None
        if registration is not None:
            registration.cancel()
        fence, self._fence = self._fence, None
        if fence is not None:
            fence.release()

    def _again(self) -> None:
        now_ns = self._drive.runtime.now_ns()
        self.late_s = max(self.late_s, (now_ns - self._last_ns) / 1e9 - self._period_s)
        self._last_ns = now_ns
        try:
            self._send(min((now_ns - self._began_ns) / 1e9, self._duration_s))
        except MotorError as error:
            self._fail(error)
        except Exception as error:  # of a user's function
            kind, problem = type(error).__name__, str(error)
            self._fail(PluginError(plugin=kind, where="sampling a trajectory", problem=problem))

    def _fail(self, error: MotorError) -> None:
        self.error = error
        self.cancel()
        self._drive.news.grow()

    def _send(self, at_s: float) -> "SentFrame":
        self.last = self._value(at_s)
        sent = self._send_one(self.last, self._fence)
        if at_s >= self._duration_s:
            self._end = sent
            if self._on_last is not None:
                self._on_last(sent)
            self.cancel()
        return sent
