"""Acquisition policy, and ownership keep-alive during a motion."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from motorapi.errors import MotorBusyError
from motorapi.leases import use_leases
from motorapi.runtime import wait_until
from motorapi.waiting import LOOK_PERIOD_S

if TYPE_CHECKING:
    from motorapi.claim import Claim
    from motorapi.runtime import Registration, Runtime
    from motorapi.waiting import News


@final
class Patience:
    """The policy of a request that waits for the motor.

    Args:
        timeout_s: timeout [s].
        in_the_way: returns the obstacle to the acquisition of a free motor, as an error, or None;
            neither waits nor sends.
        refresh: refreshes the data of `in_the_way`; returns the polling interval [s], or None.
    """

    def __init__(
        self,
        timeout_s: float,
        in_the_way: Callable[[], MotorBusyError | None],
        refresh: Callable[[], float | None],
    ) -> None:
        self.timeout_s: Final = timeout_s
        self.in_the_way: Final = in_the_way
        self._refresh: Final = refresh

    def until(
        self,
        runtime: "Runtime",
        done: Callable[[], bool],
        timeout_s: float | None,
        soonest_s: Callable[[], float | None] = lambda: None,
        of: object = None,
    ) -> bool:
        """Wait as `runtime.wait_until`, with all data refreshed.

        Args:
            runtime: the runtime of the wait.
            done: as in `wait_until`.
            timeout_s: as in `wait_until`.
            soonest_s: returns the maximum time until the next check [s], or None.
            of: the awaited ownership.
        """
        end_ns = runtime.now_ns() + round(min(timeout_s or 0.0, 1e9) * 1e9)
        while True:
            left_s = max(0, end_ns - runtime.now_ns()) / 1e9
            for pause_s in (self._refresh(), soonest_s(), use_leases(of)):
                left_s = left_s if pause_s is None else min(left_s, pause_s)
            if wait_until(runtime, done, left_s):
                return True
            if runtime.now_ns() >= end_ns:
                return False


@final
class Keeper:
    """Keep-alive of a claim during a motion, which examines every change.

    Args:
        claim: the claim to be kept.
        goes_on: returns True while the motion is active; neither waits nor sends.
        news: the counter of changes.
        is_over: called when no motion is active any more.
    """

    def __init__(
        self,
        claim: "Claim",
        goes_on: Callable[[], bool],
        news: "News",
        is_over: "Callable[[Keeper], None]",
    ) -> None:
        self.claim: Final = claim
        self._goes_on = goes_on
        self._is_over = is_over
        self._listeners = news.listeners
        self._timer: Registration | None = None

    def begin(self, runtime: "Runtime", counts: bool) -> None:
        """Begin to examine changes."""
        self._listeners.append(self.look)
        if not counts:
            self._timer = runtime.every(LOOK_PERIOD_S, self.look)
        self.look()

    def look(self) -> None:
        """Release the motor if it was lost, or no motion is active any more."""
        if self.claim.is_held and self._goes_on():
            return
        try:
            self._listeners.remove(self.look)
        except ValueError:
            return  # another thread was quicker
        if self._timer is not None:
            self._timer.cancel()
        self._is_over(self)
