"""Wall-clock loop that reads all buses and passes their frames on.

After each round the loop pauses for a moment, so that a busy bus is read in batches. The sockets
buffer the frames that arrive meanwhile.
"""

import select
import time
from collections.abc import Callable, Sequence
from typing import Final, final

from motorhil.harness.recording.sources import POLLED, BusDownError, BusEndedError, Tap
from motorhil.harness.recording.writer import Pump
from motorhil.traces.mcap.chunk import Entry
from motorhil.traces.schema import Level

IDLE_S: Final = 0.25
_POLL_S: Final = 0.01
_PAUSE_S: Final = 0.003
_QUIET_S: Final = 0.05  # after this silence the hub holds nothing back for this connection
_LAST_S: Final = 1.0
_ROUND_FRAMES: Final = 8192  # of one bus, before the other buses have their turn


@final
class RecordingLoop:
    """Reader of taps until it is stopped or every bus has ended.

    Attributes:
        problems: messages about bus problems, in order of occurrence.
        ended: True if every bus has ended by itself.
    """

    def __init__(
        self,
        taps: Sequence[Tap],
        pump: Pump,
        own_times: bool,
        report: Callable[[str], None] | None = None,
        idle_s: float = IDLE_S,
    ) -> None:
        """Set up the loop without reading anything.

        Args:
            taps: in the order of the pump's buses.
            pump: receives the frames.
            own_times: the log times are not wall time, so events are stamped like frames.
            report: called immediately with the text of each problem.
            idle_s: longest time between two rounds [s].
        """
        self.problems: list[str] = []
        self._taps = list(taps)
        self._alive = list(taps)
        self._pump = pump
        self._own_times = own_times
        self._report = report
        self._idle_s = idle_s
        self._woken_by: list[int] = []

    @property
    def ended(self) -> bool:
        """True if every bus has ended by itself."""
        return not self._alive

    def wake_on(self, descriptor: int) -> None:
        """Wake the loop also when this descriptor becomes readable."""
        self._woken_by.append(descriptor)

    def forget(self, descriptor: int) -> None:
        """Stop waking the loop for this descriptor."""
        self._woken_by.remove(descriptor)

    def run(
        self, stopped: Callable[[], bool], duration_s: float | None, tell: Callable[[int], None]
    ) -> None:
        """Record until `stopped()` returns True, or for `duration_s` [s].

        Args:
            stopped: polled at least four times a second.
            duration_s: None: no limit; the loop ends with the last bus.
            tell: called equally often with a monotonic time [ns].

        Raises:
            TraceError: the recording cannot be written.
        """
        end_s = None if duration_s is None else time.monotonic() + duration_s
        while self._alive and not stopped():
            wait_s = self._idle_s
            if any(tap.fileno() == POLLED for tap in self._alive):
                wait_s = _POLL_S
            if end_s is not None:
                left_s = end_s - time.monotonic()
                if left_s <= 0.0:
                    break
                wait_s = min(wait_s, left_s)
            self._wait(wait_s)
            if self._round() and not stopped():
                select.select(self._woken_by, (), (), _PAUSE_S)
            tell(time.monotonic_ns())
        self._catch_up()

    def _catch_up(self) -> None:
        """Read what arrived before the stop, including frames that a hub still held back."""
        stop_ns = time.time_ns()
        end_s = time.monotonic() + _LAST_S
        while self._round() or self._is_readable():
            if (self._pump.last_ns or 0) >= stop_ns or time.monotonic() > end_s:
                break

    def _is_readable(self) -> bool:
        """Return whether a tap becomes readable within a moment; polled taps are not considered."""
        descriptors = self._descriptors()
        return bool(descriptors and select.select(descriptors, (), (), _QUIET_S)[0])

    def _wait(self, longest_s: float) -> None:
        select.select([*self._woken_by, *self._descriptors()], (), (), longest_s)

    def _descriptors(self) -> list[int]:
        return [tap.fileno() for tap in self._alive if tap.fileno() != POLLED]

    def _round(self) -> int:
        """Read every bus until it is empty, within bounds, and return the number of frames."""
        now_ns = time.time_ns()
        came: list[list[Entry]] = []
        for tap in self._taps:
            frames = self._read(tap, now_ns) if tap in self._alive else []
            more = frames
            while more and len(frames) < _ROUND_FRAMES:
                more = self._read(tap, now_ns)
                frames += more
            came.append(frames)
        count = self._pump.take(came, now_ns)
        for number, tap in enumerate(self._taps):
            if tap.dropped != self._pump.dropped[number]:
                self._pump.lost(number, tap.dropped, self._log_time_ns(now_ns))
        self._pump.tick(now_ns)
        return count

    def _read(self, tap: Tap, now_ns: int) -> list[Entry]:
        """Read the frames of one bus; report and record its problem if there is one."""
        try:
            return tap.read(now_ns)
        except (BusDownError, BusEndedError) as problem:
            if isinstance(problem, BusEndedError):
                self._alive.remove(tap)
            self.problems.append(str(problem))
            if self._report is not None:
                self._report(str(problem))
            time_ns = self._log_time_ns(now_ns)
            self._pump.event(time_ns, Level.ERROR, tap.default_name, str(problem))
            return []

    def _log_time_ns(self, now_ns: int) -> int:
        """Return the present time by the recording's clock [ns]."""
        return now_ns if not self._own_times else self._pump.last_ns or 0
