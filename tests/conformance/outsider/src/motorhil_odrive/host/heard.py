"""What an ODrive was heard to say, and what follows from it for what it was commanded."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple, final

from motorapi.errors import LinkError
from motorapi.state import Fault
from motorapi.waiting import News
from motorhil_odrive.host import messages as m

if TYPE_CHECKING:
    from motorhil_odrive.host.messages import Message
    from motorhil_odrive.host.watch import Watch
    from motorhil_odrive.host.wire import Wire

_AGE_MAX_S: Final = 0.1


class Heartbeat(NamedTuple):
    """What a heartbeat said, and when it was complete on the bus [ns]."""

    error: int
    state: int
    result: int
    is_done: bool
    time_ns: int


class Estimate(NamedTuple):
    """Position [rev], velocity [rev/s] and when they were on the bus [ns]."""

    position: float
    velocity: float
    time_ns: int


@final
class Heard:
    """Of one drive. Written by frame handlers, read by everybody.

    Attributes:
        news: counts what may change whether a motion is over.
        heartbeat, estimate: the last ones; None: there was none.
        version: what it told of its versions, the protocol's first; None: not asked yet.
        answers: what else it told last, by command.
        lost_since_ns: since when it is not heard any more; None while it is.
        is_homed: whether its position 0 is known; no more once it was lost: it may have booted.
        watch: follows what was commanded last; None: nothing was.
    """

    def __init__(self, wire: "Wire", label: str, timeout_ms: float) -> None:
        self.news: Final = News()
        self.heartbeat: Heartbeat | None = None
        self.estimate: Estimate | None = None
        self.version: tuple[float, ...] | None = None
        self.answers: dict[int, tuple[float, ...]] = {}
        self.lost_since_ns: int | None = None
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
        """Whether it is heard, and all is known that is needed to command it."""
        known = self.heartbeat is not None and self.estimate is not None
        return known and self.version is not None and self.lost_since_ns is None

    def check(self) -> None:
        """Raises LinkError if it was heard, and is no more; or if the bus is off."""
        self._wire.status.check()
        if self.lost_since_ns is not None:
            reason = f"no heartbeat for {self._timeout_ms:g} ms"
            raise LinkError(link=self._label, reason=reason, since_ns=self.lost_since_ns)

    @property
    def is_lost(self) -> bool:
        """Whether it cannot be heard now."""
        return self.lost_since_ns is not None or self._wire.status.is_off

    def is_in(self, *states: int) -> bool:
        """Whether the last heartbeat told one of these axis states."""
        return self.heartbeat is not None and self.heartbeat.state in states

    def fault(self) -> Fault | None:
        """The error that the last heartbeat told."""
        heartbeat = self.heartbeat
        if heartbeat is None or not heartbeat.error:
            return None
        return Fault(heartbeat.error, m.error_text(heartbeat.error), self._fault_since_ns)

    def at(self, now_ns: int, acceleration_max: float) -> tuple[float, float]:
        """Position [rev] and velocity [rev/s] at this instant, from the last two estimates."""
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
        """Whether it has just fallen silent. To be called every now and then."""
        heard = self.heartbeat
        if heard is None or self.lost_since_ns is not None:
            return False
        if now_ns - heard.time_ns <= self._timeout_ms * 1e6:
            return False
        self.lost_since_ns = now_ns
        self.is_homed = False
        self.news.grow()
        return True

    def follow(self, watch: "Watch | None") -> None:
        """What is heard from now on is shown to `watch`."""
        self.watch = watch
        self.news.grow()

    # --- inside ------------------------------------------------------------------------------

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
        if self._show():
            self.news.grow()

    def _on_answer(self, message: "Message") -> Callable[[tuple[float, ...], int], None]:
        def take(values: tuple[float, ...], time_ns: int) -> None:
            if message is m.VERSION:
                self.version = values
            self.answers[message.command] = values

        return take

    def _show(self) -> bool:
        """Whether what was commanded is over by the latest news, and was not before."""
        watch, heartbeat, estimate = self.watch, self.heartbeat, self.estimate
        if watch is None or heartbeat is None or estimate is None or watch.is_over():
            return False
        watch.see(heartbeat, estimate)
        if not watch.is_over():
            return False
        if watch.references and not watch.failed:
            self.is_homed = True
        return True
