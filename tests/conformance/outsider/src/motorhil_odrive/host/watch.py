"""End of the last command: one class for each kind.

A heartbeat has a flag for the end of the trapezoid, and keeps it for the last one. A heartbeat that
was queued before the drive received a new command may come after it. So *done* counts only after a
heartbeat without this flag, or from the second heartbeat on.
"""

from typing import TYPE_CHECKING, Final, final

from motorhil_odrive.host.messages import HOMING, result_text

if TYPE_CHECKING:
    from motorhil.motorapi.api import Estimate, SentFrame

    from motorhil_odrive.host.heard import Heartbeat

_ENOUGH: Final = 2
_STILL: Final = 3  # estimates in a row


class Watch:
    """Follows one command.

    Args:
        sent: its frame; None: not known yet.

    Attributes:
        ended_ns: when its end was seen; None: not yet.
        failed: why it has failed; "" if it has not.
        moves: whether a command of another program interrupts it.
        needs_power: whether it is interrupted if the drive leaves closed loop.
        references: whether the motor is referenced after it.
    """

    moves = True
    needs_power = True
    references = False

    def __init__(self, sent: "SentFrame | None" = None) -> None:
        self.ended_ns: int | None = None
        self.failed = ""
        self.sent = sent
        self._seen_ns = 0

    @property
    def started_ns(self) -> int | None:
        """When the command was on the bus, or None."""
        return None if self.sent is None else self.sent.time_ns

    def is_over(self) -> bool:
        """Return whether its end was seen."""
        return self.ended_ns is not None

    def see(self, heartbeat: "Heartbeat", estimate: "Estimate") -> None:
        """Handle a new heartbeat or estimate."""

    def _is_new(self, time_ns: int) -> bool:
        """Return whether a message of this time is new, and later than the command."""
        started_ns = self.started_ns
        if started_ns is None or time_ns <= max(started_ns, self._seen_ns):
            return False
        self._seen_ns = time_ns
        return True


@final
class Armed(Watch):
    """A motion that has not begun; `before` is the previous command's watch."""

    def __init__(self, before: Watch | None) -> None:
        super().__init__()
        self.before = before


class _Trapezoid(Watch):
    """A command whose trapezoid must be done."""

    def __init__(self, sent: "SentFrame") -> None:
        super().__init__(sent)
        self._heard = 0
        self._was_denied = False
        self._is_done = False

    def is_answered(self) -> bool:
        """Return whether the drive has shown its reaction to the command."""
        return self._was_denied or self._heard >= _ENOUGH

    def _take(self, heartbeat: "Heartbeat") -> None:
        if self._is_new(heartbeat.time_ns):
            self._heard += 1
            self._was_denied |= not heartbeat.is_done
            self._is_done = heartbeat.is_done and self.is_answered()


@final
class Arrival(_Trapezoid):
    """A motion, which ends when done with the motor within the window of its target [rev]."""

    def __init__(self, sent: "SentFrame", target: float, window: float, start: float) -> None:
        super().__init__(sent)
        self._target = target
        self._window = window
        self._start = start

    def see(self, heartbeat: "Heartbeat", estimate: "Estimate") -> None:
        """Handle a new heartbeat or estimate."""
        self._take(heartbeat)
        is_there = abs(estimate.position - self._target) <= self._window
        if self._is_done and is_there and self.ended_ns is None:
            self.ended_ns = max(heartbeat.time_ns, estimate.time_ns)

    def was_ignored(self, estimate: "Estimate") -> bool:
        """Return whether the drive reports done without having moved."""
        is_there = abs(estimate.position - self._target) <= 2 * self._window
        has_left = abs(estimate.position - self._start) > self._window
        return not (is_there or has_left or self._was_denied)


@final
class Rest(_Trapezoid):
    """A stop, which ends when its trapezoid is done and the motor is at rest."""

    moves = False
    needs_power = False

    def __init__(self, sent: "SentFrame", still: float) -> None:
        super().__init__(sent)
        self._still = still
        self._rests = 0
        self._estimated_ns = 0

    def see(self, heartbeat: "Heartbeat", estimate: "Estimate") -> None:
        """Handle a new heartbeat or estimate."""
        self._take(heartbeat)
        if estimate.time_ns != self._estimated_ns:
            self._estimated_ns = estimate.time_ns
            self._rests = self._rests + 1 if abs(estimate.velocity) <= self._still else 0
        if self._is_done and self._rests >= _STILL and self.ended_ns is None:
            self.ended_ns = estimate.time_ns


@final
class Reached(Watch):
    """A stream, which ends after its last set-point, when a velocity [rev/s] was reached."""

    def __init__(self, velocity: float | None, window: float) -> None:
        super().__init__()
        self._last: SentFrame | None = None
        self._velocity = velocity
        self._window = window

    def arrive(self, last: "SentFrame") -> None:
        """Note the frame of the last set-point."""
        self._last = last

    def see(self, heartbeat: "Heartbeat", estimate: "Estimate") -> None:
        """Handle a new heartbeat or estimate."""
        last_ns = None if self._last is None else self._last.time_ns
        if last_ns is None or estimate.time_ns <= last_ns or self.ended_ns is not None:
            return
        if self._velocity is None or abs(estimate.velocity - self._velocity) <= self._window:
            self.ended_ns = estimate.time_ns


@final
class Called(Watch):
    """A change of the position reference, which ends when an estimate shows position 0."""

    references = True

    def __init__(self, sent: "SentFrame", window: float) -> None:
        super().__init__(sent)
        self._window = window

    def see(self, heartbeat: "Heartbeat", estimate: "Estimate") -> None:
        """Handle a new heartbeat or estimate."""
        is_there = abs(estimate.position) <= self._window
        if self._is_new(estimate.time_ns) and is_there and self.ended_ns is None:
            self.ended_ns = estimate.time_ns


@final
class Homed(Watch):
    """The drive's own homing, which ends when the drive leaves that state."""

    needs_power = False  # a refused homing ends in IDLE, with the reason
    references = True

    def __init__(self, sent: "SentFrame") -> None:
        super().__init__(sent)
        self._heard = 0
        self._began = False

    def see(self, heartbeat: "Heartbeat", estimate: "Estimate") -> None:
        """Handle a new heartbeat or estimate."""
        if not self._is_new(heartbeat.time_ns) or self.ended_ns is not None:
            return
        self._heard += 1
        if heartbeat.state == HOMING:
            self._began = True
        elif self._began or self._heard >= _ENOUGH:
            self.ended_ns = heartbeat.time_ns
            self.failed = "" if heartbeat.result == 0 else result_text(heartbeat.result)
