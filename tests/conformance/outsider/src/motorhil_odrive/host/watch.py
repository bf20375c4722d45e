"""When what was commanded last is over, as the drive shows it: one class for each kind of command.

A heartbeat says whether the trapezoid is done, and goes on saying so of the last one. One that had
been queued before the drive heard of the new one may come after it. So *done* counts once a
heartbeat since the command has denied it, or with the second one since.
"""

from typing import TYPE_CHECKING, Final, final

from motorhil_odrive.host.messages import HOMING, result_text

if TYPE_CHECKING:
    from motorhil_odrive.host.heard import Estimate, Heartbeat
    from motorhil_odrive.host.wire import Sent

_ENOUGH: Final = 2
_STILL: Final = 3  # estimates in a row


class Watch:
    """Follows one command.

    Args:
        sent: what brought it; None: not known yet.

    Attributes:
        ended_ns: when it was seen to be over; None: it was not.
        failed: why it has failed, in words; "": it has not.
        moves: whether a command of somebody else interrupts it.
        needs_power: whether it is interrupted if the drive leaves closed loop.
        references: whether the motor knows where its position 0 is after it.
    """

    moves = True
    needs_power = True
    references = False

    def __init__(self, sent: "Sent | None" = None) -> None:
        self.ended_ns: int | None = None
        self.failed = ""
        self.sent = sent
        self._seen_ns = 0

    @property
    def started_ns(self) -> int | None:
        """When the command was on the wire; None: it was not yet."""
        return None if self.sent is None else self.sent.time_ns

    def is_over(self) -> bool:
        """Whether it was seen to be over."""
        return self.ended_ns is not None

    def see(self, heartbeat: "Heartbeat", estimate: "Estimate") -> None:
        """One of the two is new."""

    def _is_new(self, time_ns: int) -> bool:
        """Whether what came then came since the command, and was not seen before."""
        started_ns = self.started_ns
        if started_ns is None or time_ns <= max(started_ns, self._seen_ns):
            return False
        self._seen_ns = time_ns
        return True


@final
class Armed(Watch):
    """Nothing has begun yet; `before` is what was going on."""

    def __init__(self, before: Watch | None) -> None:
        super().__init__()
        self.before = before


class _Trapezoid(Watch):
    """Whether the trapezoid that was commanded is done."""

    def __init__(self, sent: "Sent") -> None:
        super().__init__(sent)
        self._heard = 0
        self._was_denied = False
        self._is_done = False

    def is_answered(self) -> bool:
        """Whether the drive has shown what it makes of the command."""
        return self._was_denied or self._heard >= _ENOUGH

    def _take(self, heartbeat: "Heartbeat") -> None:
        if self._is_new(heartbeat.time_ns):
            self._heard += 1
            self._was_denied |= not heartbeat.is_done
            self._is_done = heartbeat.is_done and self.is_answered()


@final
class Arrival(_Trapezoid):
    """A motion: over when it is done and the motor is within the window of its target [rev]."""

    def __init__(self, sent: "Sent", target: float, window: float, start: float) -> None:
        super().__init__(sent)
        self._target = target
        self._window = window
        self._start = start

    def see(self, heartbeat: "Heartbeat", estimate: "Estimate") -> None:
        """One of the two is new."""
        self._take(heartbeat)
        is_there = abs(estimate.position - self._target) <= self._window
        if self._is_done and is_there and self.ended_ns is None:
            self.ended_ns = max(heartbeat.time_ns, estimate.time_ns)

    def was_ignored(self, estimate: "Estimate") -> bool:
        """Whether the drive says that it is done, and never left where it was."""
        is_there = abs(estimate.position - self._target) <= 2 * self._window
        has_left = abs(estimate.position - self._start) > self._window
        return not (is_there or has_left or self._was_denied)


@final
class Rest(_Trapezoid):
    """Any way of stopping: over when its trapezoid is done and the motor stands still."""

    moves = False
    needs_power = False

    def __init__(self, sent: "Sent", still: float) -> None:
        super().__init__(sent)
        self._still = still
        self._rests = 0
        self._estimated_ns = 0

    def see(self, heartbeat: "Heartbeat", estimate: "Estimate") -> None:
        """One of the two is new."""
        self._take(heartbeat)
        if estimate.time_ns != self._estimated_ns:
            self._estimated_ns = estimate.time_ns
            self._rests = self._rests + 1 if abs(estimate.velocity) <= self._still else 0
        if self._is_done and self._rests >= _STILL and self.ended_ns is None:
            self.ended_ns = estimate.time_ns


@final
class Reached(Watch):
    """Set-points that are streamed: over when the last is out, and a velocity was seen [rev/s]."""

    def __init__(self, velocity: float | None, window: float) -> None:
        super().__init__()
        self._last: Sent | None = None
        self._velocity = velocity
        self._window = window

    def arrive(self, last: "Sent") -> None:
        """This is the last set-point."""
        self._last = last

    def see(self, heartbeat: "Heartbeat", estimate: "Estimate") -> None:
        """One of the two is new."""
        last_ns = None if self._last is None else self._last.time_ns
        if last_ns is None or estimate.time_ns <= last_ns or self.ended_ns is not None:
            return
        if self._velocity is None or abs(estimate.velocity - self._velocity) <= self._window:
            self.ended_ns = estimate.time_ns


@final
class Called(Watch):
    """Position 0 is here: over when an estimate says so."""

    references = True

    def __init__(self, sent: "Sent", window: float) -> None:
        super().__init__(sent)
        self._window = window

    def see(self, heartbeat: "Heartbeat", estimate: "Estimate") -> None:
        """One of the two is new."""
        is_there = abs(estimate.position) <= self._window
        if self._is_new(estimate.time_ns) and is_there and self.ended_ns is None:
            self.ended_ns = estimate.time_ns


@final
class Homed(Watch):
    """The drive's own homing: over when it has left that state, one way or another."""

    needs_power = False  # a refused one ends in IDLE, and says why
    references = True

    def __init__(self, sent: "Sent") -> None:
        super().__init__(sent)
        self._heard = 0
        self._began = False

    def see(self, heartbeat: "Heartbeat", estimate: "Estimate") -> None:
        """One of the two is new."""
        if not self._is_new(heartbeat.time_ns) or self.ended_ns is not None:
            return
        self._heard += 1
        if heartbeat.state == HOMING:
            self._began = True
        elif self._began or self._heard >= _ENOUGH:
            self.ended_ns = heartbeat.time_ns
            self.failed = "" if heartbeat.result == 0 else result_text(heartbeat.result)
