"""How a patient one waits for a motor, and keeps one while a motion goes on."""

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
    """How a patient one waits for the motor.

    Args:
        timeout_s: how long [s].
        in_the_way: what keeps a free motor from being taken, as an error; neither waits nor sends.
        refresh: what `in_the_way` looks at is fresh; after how long to call it again [s], if at
            all.
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
        """As `runtime.wait_until`, with everything fresh.

        Args:
            runtime: where to wait.
            done: as there.
            timeout_s: as there.
            soonest_s: after how long to look again though nothing has happened [s], if at all.
            of: the ownership that is waited for.
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
    """Keeps a claim while a run goes on; looks at every news.

    Args:
        claim: what is kept.
        goes_on: whether the run does; neither waits nor sends.
        news: tell when to ask that.
        is_over: is called when nothing goes on any more.
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
        """It looks from now on."""
        self._listeners.append(self.look)
        if not counts:
            self._timer = runtime.every(LOOK_PERIOD_S, self.look)
        self.look()

    def look(self) -> None:
        """The motor is given away if it was lost, or nothing goes on any more."""
        if self.claim.is_held and self._goes_on():
            return
        try:
            self._listeners.remove(self.look)
        except ValueError:
            return  # another thread was quicker
        if self._timer is not None:
            self._timer.cancel()
        self._is_over(self)
