"""Progress of one commanded motion, from statuswords (sans-I/O).

A watch sees every statusword with the position received with it. Bits are ignored that belong to
the time before the command (an old target reached, an attained homing).
"""

from collections.abc import Callable
from typing import Final, Protocol, final

from motorhil.motorapi.adaptations.cia402.objects import (
    ACKNOWLEDGE,
    HOMING_ATTAINED,
    HOMING_ERROR,
    TARGET_REACHED,
    is_off,
)

SETTLE_NS: Final = 20_000_000
"""The time for which a drive may show old bits [ns]; longer than any servo tick and TPDO latency.
"""

STILL_INC: Final = 2
_SHORT_NS: Final = 500_000_000
_NEAR: Final = 4  # divisor of the distance: "most of the way"


class MotionWatch(Protocol):
    """An observer of the last command."""

    started_ns: int | None  # time of the drive's first sign of the motion; None: not yet
    ended_ns: int | None  # time of the drive's sign of its end; None: not yet
    failed: bool
    on_end: Callable[[], None] | None  # called once, when `ended_ns` has been set

    def see(self, statusword: int, position_inc: int, time_ns: int) -> None:
        """Evaluate a statusword, with the position sampled with it."""


@final
class SetpointWatch:
    """One set-point in pp, or (without acknowledge) one target velocity in pv.

    The motion is over when *target reached* rises after the start. The position must be most of the
    way there, as an old frame may be delayed. The bit may never be seen low: a move of zero length,
    a drive that shows it late, lost frames. As some drives show the old bit for a while, the motion
    is then over once its own duration has passed and the position is at the target.

    The ramp of a trajectory lasts for `lasts_ns`. The bit cannot shorten it: a drive sets the bit
    once velocity or torque is within its window, long before the end of a slow ramp.

    A drive that stands short of its target and shows *target reached* was halted, or its target
    limited. The motion has then `failed`.
    """

    def __init__(
        self,
        *,
        commanded_ns: int | None,
        expected_ns: int,
        acknowledged: bool,
        target_inc: int | None,
        tolerance_inc: int | None,
        distance_inc: int = 0,
        lasts_ns: int = 0,
        acknowledge_at_rest: int = 0,
    ) -> None:
        self.started_ns: int | None = None
        self.ended_ns: int | None = None
        self.failed: bool = False
        self.on_end: Callable[[], None] | None = None
        self.commanded_ns = commanded_ns
        self._expected_ns = expected_ns
        self._needs_acknowledge = acknowledged
        self._acknowledge_at_rest = acknowledge_at_rest
        self.target_inc: Final = target_inc
        self._tolerance_inc = tolerance_inc
        self._near_inc = max(STILL_INC, tolerance_inc or 0, abs(distance_inc) // _NEAR)
        self._lasts_ns = lasts_ns
        self._seen_low = False
        self._reached_ns: int | None = None  # since when the drive shows that it is there
        self._short_ns: int | None = None  # since when it stands elsewhere, with the bit
        self._short_inc = 0

    @property
    def is_under_way(self) -> bool:
        """True if the drive is on its way to a target position."""
        begun = self.started_ns is not None
        return begun and self.ended_ns is None and self.target_inc is not None

    def begin(self, time_ns: int) -> None:
        """Record the time when the command was on the wire."""
        if self.commanded_ns is None:
            self.commanded_ns = time_ns

    def see(self, statusword: int, position_inc: int, time_ns: int) -> None:
        """Evaluate a statusword, with the position sampled with it."""
        if self.started_ns is None:
            acknowledge = statusword & ACKNOWLEDGE
            if self._needs_acknowledge and acknowledge == self._acknowledge_at_rest:
                return
            if self.commanded_ns is None or time_ns <= self.commanded_ns:
                return
            self.started_ns = time_ns
        if self.ended_ns is not None:
            return
        if not statusword & TARGET_REACHED:
            self._seen_low = True
            self._reached_ns = self._short_ns = None
        elif self._seen_low:
            if self._is_within(self._near_inc, position_inc):
                self._reach(time_ns)
            else:
                self._fall_short(position_inc, time_ns)
        elif time_ns >= self.started_ns + self._expected_ns:
            within = self._tolerance_inc
            if within is None or self._is_within(within, position_inc):
                self._reach(time_ns)
            else:
                self._fall_short(position_inc, time_ns)

    def _fall_short(self, position_inc: int, time_ns: int) -> None:
        """Fail if the drive stands here with the bit, for a while after the end of its profile.

        Before that end it may be on its way: slowly, and with the bit if its window is off.
        """
        assert self.started_ns is not None
        if time_ns < self.started_ns + self._expected_ns:
            return
        if self._short_ns is None or abs(position_inc - self._short_inc) > STILL_INC:
            self._short_inc, self._short_ns = position_inc, time_ns
        elif time_ns - self._short_ns >= _SHORT_NS:
            self.failed = True
            self.ended_ns = time_ns
            if self.on_end is not None:
                self.on_end()

    def _reach(self, time_ns: int) -> None:
        """End the motion, but not before the end of its ramp."""
        if self._reached_ns is None:
            self._reached_ns = time_ns
        ramp_end_ns = (self.commanded_ns or 0) + self._lasts_ns
        if time_ns < ramp_end_ns:
            return
        self.ended_ns = max(self._reached_ns, ramp_end_ns)
        if self.on_end is not None:
            self.on_end()

    def _is_within(self, within_inc: int, position_inc: int) -> bool:
        target_inc = self.target_inc
        return target_inc is None or abs(position_inc - target_inc) <= within_inc


@final
class RestWatch:
    """Any stop: over when the drive reports it and the position stands still.

    A motor without power coasts. Then the drive has nothing to report, and only the position shows
    the end. If the motor `stands` already, its stop is over at once.
    """

    def __init__(self, *, commanded_ns: int, needs_bit: bool, stands: bool = False) -> None:
        self.started_ns: int | None = commanded_ns
        self.ended_ns: int | None = commanded_ns if stands else None
        self.failed = False
        self.on_end: Callable[[], None] | None = None
        self._commanded_ns = commanded_ns
        self._needs_bit = needs_bit
        self._position_inc: int | None = None
        self._still_since_ns = 0

    def see(self, statusword: int, position_inc: int, time_ns: int) -> None:
        """Evaluate a statusword, with the position sampled with it."""
        if time_ns < self._commanded_ns or self.ended_ns is not None:
            return
        before = self._position_inc
        if before is None or abs(position_inc - before) > STILL_INC:
            self._position_inc = position_inc
            self._still_since_ns = time_ns
        elif time_ns - self._still_since_ns >= SETTLE_NS and (
            statusword & TARGET_REACHED or not self._needs_bit or is_off(statusword)
        ):
            self.ended_ns = time_ns
            if self.on_end is not None:
                self.on_end()


@final
class StreamWatch:
    """A stream of set-points: its end shows in the position, as no bit reports it.

    The motion is over when the last set-point has been latched, its period has passed, and the
    position is within the tolerance of it (None: stands still). If the stream failed, it is over
    when the drive stands still.

    Attributes:
        error: the reason why the stream ended before its last set-point; the drive was then halted.
    """

    def __init__(self, *, period_ns: int, tolerance_inc: int | None) -> None:
        self.started_ns: int | None = None
        self.ended_ns: int | None = None
        self.failed: bool = False
        self.on_end: Callable[[], None] | None = None
        self.error: Exception | None = None
        self._period_ns = period_ns
        self._tolerance_inc = tolerance_inc
        self._target_inc: int | None = None
        self._arrival_ns: int | None = None
        self._position_inc: int | None = None
        self._still_since_ns = 0

    def begin(self, time_ns: int) -> None:
        """Record the time when the SYNC that began the stream was on the wire."""
        self.started_ns = time_ns

    def arrive(self, target_inc: int | None, time_ns: int) -> None:
        """Record the SYNC after the last set-point; `target_inc` None: the velocity continues."""
        if self._arrival_ns is None:
            self._target_inc = target_inc
            self._arrival_ns = time_ns + self._period_ns

    @property
    def has_arrived(self) -> bool:
        """True if `arrive` was called."""
        return self._arrival_ns is not None

    def fail(self, error: Exception) -> None:
        """Record that the stream has failed; the drive brakes."""
        if self.error is None and self.ended_ns is None:
            self.failed = True
            self.error = error
            self._position_inc = None  # standstill counts only from now on

    def see(self, statusword: int, position_inc: int, time_ns: int) -> None:
        """Evaluate a statusword, with the position sampled with it."""
        if self.ended_ns is not None:
            return
        before = self._position_inc
        if before is None or abs(position_inc - before) > STILL_INC:
            self._position_inc = position_inc
            self._still_since_ns = time_ns
        stands = time_ns - self._still_since_ns >= SETTLE_NS
        if self.error is not None:
            is_over = stands
        elif self._arrival_ns is None or time_ns < self._arrival_ns:
            return
        elif self._target_inc is None:
            is_over = True
        elif self._tolerance_inc is None:
            is_over = stands
        else:
            is_over = abs(position_inc - self._target_inc) <= self._tolerance_inc
        if is_over:
            self.ended_ns = time_ns
            if self.on_end is not None:
                self.on_end()


@final
class HomingWatch:
    """One homing (statusword bits 10, 12 and 13 in hm).

    A previous homing leaves *homing attained* set. The bit counts once it was seen low since the
    start, or has been shown for longer than a drive may show old bits.
    """

    def __init__(
        self,
        *,
        commanded_ns: int,
        method: int | None = None,
        on_success: Callable[[], None] | None = None,
    ) -> None:
        self.method = method
        self._on_success = on_success
        self.started_ns: int | None = None
        self.ended_ns: int | None = None
        self.failed: bool = False
        self.on_end: Callable[[], None] | None = None
        self._commanded_ns = commanded_ns
        self._fresh = False

    def see(self, statusword: int, position_inc: int, time_ns: int) -> None:
        """Evaluate a statusword, with the position sampled with it."""
        if time_ns < self._commanded_ns or self.ended_ns is not None:
            return
        if self.started_ns is None:
            self.started_ns = time_ns
        if not statusword & (HOMING_ATTAINED | HOMING_ERROR):
            self._fresh = True
        if not self._fresh and time_ns < self._commanded_ns + SETTLE_NS:
            return
        if statusword & HOMING_ERROR:
            self.failed = True
            self._end(time_ns)
        elif statusword & HOMING_ATTAINED and statusword & TARGET_REACHED:
            if self._on_success is not None:
                self._on_success()
            self._end(time_ns)

    def _end(self, time_ns: int) -> None:
        self.ended_ns = time_ns
        if self.on_end is not None:
            self.on_end()
