"""Received messages of an ODrive, and their effect on the last command."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple, final

from motorhil.motorapi.api import Estimate, Fault, texts_of

from motorhil_odrive.host import messages as m

if TYPE_CHECKING:
    from motorhil.motorapi.api import CanDrive

    from motorhil_odrive.host.messages import Message
    from motorhil_odrive.host.watch import Watch

_AGE_MAX_S: Final = 0.1


class Heartbeat(NamedTuple):
    """The values of a heartbeat, and when it was complete on the bus [ns]."""

    error: int
    state: int
    result: int
    is_done: bool
    time_ns: int


@final
class Heard:
    """The received messages of one drive; written by frame handlers only.

    Attributes:
        heartbeat, estimate: the last ones, or None; in turns of the motor.
        version: the drive's versions, with the protocol's first; None: not received yet.
        answers: the last values of other messages, by command.
        is_homed: whether its position 0 is known; False after a loss, as it may have booted.
        watch: follows the last command, or None.
    """

    def __init__(self, drive: "CanDrive", timeout_s: float, on_loss: Callable[[], None]) -> None:
        self.heartbeat: Heartbeat | None = None
        self.estimate: Estimate | None = None
        self.version: tuple[float, ...] | None = None
        self.answers: dict[int, tuple[float, ...]] = {}
        self.is_homed = False
        self.watch: Watch | None = None
        self._drive = drive
        self._on_loss = on_loss
        self._heartbeats = drive.expect("heartbeat", timeout_s, self._lose)
        self._estimates = drive.expect("encoder estimate", timeout_s)
        self._before: Estimate | None = None
        self._fault_since_ns = 0

    def is_up(self) -> bool:
        """Return whether the drive is heard, with all values that commands need."""
        known = self.heartbeat is not None and self.estimate is not None
        return known and self.version is not None and self._heartbeats.lost_since_ns is None

    def hear(self, message: "Message", values: tuple[float, ...], time_ns: int) -> None:
        """Take a message of the drive."""
        if message is m.HEARTBEAT:
            self._on_heartbeat(values, time_ns)
        elif message is m.ESTIMATES:
            self._on_estimates(values, time_ns)
        else:
            if message is m.VERSION:
                self.version = values
            self.answers[message.command] = values

    def is_in(self, *states: int) -> bool:
        """Return whether the last heartbeat has one of these axis states."""
        return self.heartbeat is not None and self.heartbeat.state in states

    def fault(self) -> Fault | None:
        """Return the error of the last heartbeat, or None."""
        heartbeat = self.heartbeat
        if heartbeat is None or not heartbeat.error:
            return None
        return Fault(
            heartbeat.error, texts_of(heartbeat.error, m.ERROR_TEXTS), self._fault_since_ns
        )

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

    def follow(self, watch: "Watch | None") -> None:
        """Show all messages from now on to `watch`."""
        self.watch = watch
        self._drive.news.grow()

    # --- helpers -----------------------------------------------------------------------------

    def _lose(self) -> None:
        self.is_homed = False
        self._on_loss()

    def _on_heartbeat(self, values: tuple[float, ...], time_ns: int) -> None:
        error, state, result, done = (int(value) for value in values)
        before, now = self.heartbeat, Heartbeat(error, state, result, bool(done), time_ns)
        self.heartbeat = now
        if error and not (before is not None and before.error):
            self._fault_since_ns = time_ns
        self._heartbeats.came(time_ns)
        self._show()

    def _on_estimates(self, values: tuple[float, ...], time_ns: int) -> None:
        self._before, self.estimate = self.estimate, Estimate(values[0], values[1], time_ns)
        self._estimates.came(time_ns)
        self._show()

    def _show(self) -> None:
        """Update the watch, and what its end tells."""
        watch, heartbeat, estimate = self.watch, self.heartbeat, self.estimate
        if watch is None or heartbeat is None or estimate is None or watch.is_over():
            return
        watch.see(heartbeat, estimate)
        if watch.is_over() and watch.references and not watch.failed:
            self.is_homed = True
