"""Received messages of an ODrive, and their effect on the last command."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple, final

from motorhil.motorapi.errors import LinkError
from motorhil.motorapi.runtime.api import ChangeCounter
from motorhil.motorapi.state import Fault

from motorhil_odrive.host import messages as m

if TYPE_CHECKING:
    from motorhil_odrive.host.messages import Message
    from motorhil_odrive.host.watch import Watch
    from motorhil_odrive.host.wire import Wire

_AGE_MAX_S: Final = 0.1


class Heartbeat(NamedTuple):
    """The values of a heartbeat, and when it was complete on the bus [ns]."""

    error: int
    state: int
    result: int
    is_done: bool
    time_ns: int


class Estimate(NamedTuple):
    """Position [rev], velocity [rev/s] and their time on the bus [ns]."""

    position: float
    velocity: float
    time_ns: int


@final
class Heard:
    """The received messages of one drive; written by frame handlers only.

    Attributes:
        news: counts changes that may end a motion.
        heartbeat, estimate: the last ones, or None.
        version: the drive's versions, with the protocol's first; None: not received yet.
        answers: the last values of other messages, by command.
        lost_since_ns: the time of its loss; None while it is heard.
        blind_since_ns: the time since which its estimates are missing; None while they come.
        is_homed: whether its position 0 is known; False after a loss, as it may have booted.
        watch: follows the last command, or None.
    """

    def __init__(self, wire: "Wire", label: str, timeout_ms: float) -> None:
        self.news: Final = ChangeCounter()
        self.heartbeat: Heartbeat | None = None
        self.estimate: Estimate | None = None
        self.version: tuple[float, ...] | None = None
        self.answers: dict[int, tuple[float, ...]] = {}
        self.lost_since_ns: int | None = None
        self.blind_since_ns: int | None = None
        self.is_homed = False
        self.watch: Watch | None = None
        self._label = label
        self._wire = wire
        self._timeout_ms = timeout_ms
        self._before: Estimate | None = None
        self._fault_since_ns = 0
        wire.handle(m.HEARTBEAT, self._on_heartbeat)
        wire.handle(m.ESTIMATES, self._on_estimates)
        for message in (m.VERSION, m.ERRORS, m.CURRENT, m.TEMPERATURE, m.SUPPLY, m.TORQUES):
            wire.handle(message, self._on_answer(message))

    def is_up(self) -> bool:
        """Return whether the drive is heard, with all values that commands need."""
        known = self.heartbeat is not None and self.estimate is not None
        return known and self.version is not None and self.lost_since_ns is None

    def check(self) -> None:
        """Raise LinkError if the drive was lost, or if the bus is off."""
        self._wire.status.check()
        if self.lost_since_ns is not None:
            reason = f"no heartbeat for {self._timeout_ms:g} ms"
            raise LinkError(link=self._label, reason=reason, since_ns=self.lost_since_ns)
        if self.blind_since_ns is not None:
            reason = f"no encoder estimate for {self._timeout_ms:g} ms"
            raise LinkError(link=self._label, reason=reason, since_ns=self.blind_since_ns)

    @property
    def is_lost(self) -> bool:
        """True if the drive cannot be heard now."""
        return self.lost_since_ns is not None or self._wire.status.is_off

    def is_in(self, *states: int) -> bool:
        """Return whether the last heartbeat has one of these axis states."""
        return self.heartbeat is not None and self.heartbeat.state in states

    def fault(self) -> Fault | None:
        """Return the error of the last heartbeat, or None."""
        heartbeat = self.heartbeat
        if heartbeat is None or not heartbeat.error:
            return None
        return Fault(heartbeat.error, m.error_text(heartbeat.error), self._fault_since_ns)

    def at(self, now_ns: int, acceleration_max: float) -> tuple[float, float]:
        """Return position [rev] and velocity [rev/s] now, from the last two estimates."""
        last, before = self.estimate, self._before
        if last is None:
            return 0.0, 0.0
        age_s = max(0.0, min(_AGE_MAX_S, (now_ns - last.time_ns) / 1e9))
        change = 0.0
        if before is not None and last.time_ns > before.time_ns:
            change = (last.velocity - before.velocity) * 1e9 / (last.time_ns - before.time_ns)
            change = max(-acceleration_max, min(acceleration_max, change))
        velocity = last.velocity + change * age_s
        return last.position + 0.5 * (last.velocity + velocity) * age_s, velocity

    def look(self, now_ns: int) -> bool:
        """Return whether the drive has just been lost; to be called periodically."""
        heard, estimate, timeout_ns = self.heartbeat, self.estimate, self._timeout_ms * 1e6
        is_stale = estimate is not None and now_ns - estimate.time_ns > timeout_ns
        if is_stale and self.blind_since_ns is None:
            self.blind_since_ns = now_ns
            self.news.grow()
        if heard is None or self.lost_since_ns is not None:
            return False
        if now_ns - heard.time_ns <= timeout_ns:
            return False
        self.lost_since_ns = now_ns
        self.is_homed = False
        self.news.grow()
        return True

    def follow(self, watch: "Watch | None") -> None:
        """Show all messages from now on to `watch`."""
        self.watch = watch
        self.news.grow()

    # --- helpers -----------------------------------------------------------------------------

    def _on_heartbeat(self, values: tuple[float, ...], time_ns: int) -> None:
        error, state, result, done = (int(value) for value in values)
        before, now = self.heartbeat, Heartbeat(error, state, result, bool(done), time_ns)
        self.heartbeat = now
        if error and not (before is not None and before.error):
            self._fault_since_ns = time_ns
        is_news = self.lost_since_ns is not None or before is None or before[:4] != now[:4]
        self.lost_since_ns = None
        if self._show() or is_news:
            self.news.grow()

    def _on_estimates(self, values: tuple[float, ...], time_ns: int) -> None:
        self._before, self.estimate = self.estimate, Estimate(values[0], values[1], time_ns)
        self.blind_since_ns = None
        if self._show():
            self.news.grow()

    def _on_answer(self, message: "Message") -> Callable[[tuple[float, ...], int], None]:
        def take(values: tuple[float, ...], time_ns: int) -> None:
            if message is m.VERSION:
                self.version = values
            self.answers[message.command] = values

        return take

    def _show(self) -> bool:
        """Update the watch; return whether its command has just ended."""
        watch, heartbeat, estimate = self.watch, self.heartbeat, self.estimate
        if watch is None or heartbeat is None or estimate is None or watch.is_over():
            return False
        watch.see(heartbeat, estimate)
        if not watch.is_over():
            return False
        if watch.references and not watch.failed:
            self.is_homed = True
        return True
