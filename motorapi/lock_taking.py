"""One who wants a lock between processes, until it has it or gives up."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol, final, runtime_checkable

from motorapi.errors import MotorBusyError
from motorapi.lock_file import LockFile
from motorapi.lock_takeover import Attempt, TakeoverAttempt
from motorapi.lock_view import LockView, Occupant
from motorapi.lock_watch import QueueWatcher
from motorapi.runtime import Runtime

_WRITE_PATIENCE_S: Final = 0.25
"""How long somebody may be in the middle of a write, before a takeover on demand is given up."""

Wait = Callable[[Runtime, Callable[[], bool], float | None], bool]
"""As `Runtime.wait_until`, with the runtime in front."""


@runtime_checkable
class Wakeable(Protocol):
    """A runtime that can be woken from outside: the wall's."""

    def wake(self) -> None:
        """Whoever waits looks at once."""


def plain_wait(runtime: Runtime, done: Callable[[], bool], timeout_s: float | None) -> bool:
    """As `Runtime.wait_until`."""
    return runtime.wait_until(done, timeout_s)


@final
@dataclass(frozen=True, slots=True)
class Wish:
    """What one wants a lock for, and how much: as `ProcessLock.acquire` says."""

    runtime: Runtime
    timeout_s: float | None
    asker: str
    wait: Wait
    lease_ns: int
    on_demand: bool
    describe: Callable[[int, str | None], bytes]
    """Its record, by its number; or that of a takeover, by the token lost and the reason."""


@final
class Taking:
    """A wish, by way of one open file.

    Attributes: takeover (how it was taken from one who lives; None: it was not).
    """

    def __init__(
        self,
        file: LockFile,
        wish: Wish,
        watcher: QueueWatcher,
        mutex: threading.Lock,
        look: Callable[[], LockView],
        pid: int,
    ) -> None:
        self.takeover: TakeoverAttempt | None = None
        self._file: Final = file
        self._wish: Final = wish
        self._watcher: Final = watcher
        self._mutex: Final = mutex  # of whoever makes a place
        self._look: Final = look
        self._pid: Final = pid
        self._blocked: Attempt | None = None

    def take(self) -> None:
        """It is taken.

        Raises:
            MotorBusyError: somebody else has it; says who.
        """
        wish = self._wish
        if wish.on_demand:
            self._take_on_demand()
            return
        with self._mutex:
            mine = self._file.queue_up(1 + self._watcher.busy_before)
        if self._is_mine(mine):
            return
        runtime, timeout_s = wish.runtime, wish.timeout_s
        if timeout_s is None or timeout_s > 0.0:
            self._file.tell_waiter(mine, wish.describe(mine, None))
            if isinstance(runtime, Wakeable):
                if self._wait_woken(mine, runtime.wake):
                    return
            elif not self._has_strangers(mine) and wish.wait(
                runtime, lambda: self._is_mine(mine), timeout_s
            ):
                return
        raise self._busy(mine)

    def _is_mine(self, place: int) -> bool:
        """Whether it is the turn of this place, and it is taken, if need be from one who lives."""
        file = self._file
        return file.take(place) or (file.is_first(place) and self._take_lapsed())

    # ---- taking it over ----

    def _take_lapsed(self) -> bool:
        """Whether its holder's lease is over, and it is taken."""
        now_ns = time.monotonic_ns()
        return 0 < self._file.line().lease_end_ns <= now_ns and self._take_over(now_ns)

    def _take_on_demand(self) -> None:
        wish = self._wish

        def is_taken() -> bool:
            return self._file.take_in_front() or self._take_over(None)

        if is_taken():
            return
        timeout_s = wish.timeout_s
        if timeout_s is not None:
            timeout_s = max(timeout_s, _WRITE_PATIENCE_S)
        if not plain_wait(wish.runtime, is_taken, timeout_s):
            raise self._busy(None)

    def _take_over(self, now_ns: int | None) -> bool:
        lease_ns = self._wish.lease_ns
        end_ns = time.monotonic_ns() + lease_ns if lease_ns else 0
        attempt = TakeoverAttempt(self._file, now_ns, self._wish.describe, lease_ns, end_ns)
        result = attempt.make()
        if result is Attempt.TAKEN:
            self._file.let_go_of_places()
            self.takeover = attempt
            return True
        self._blocked = result
        return False

    # ---- waiting ----

    def _wait_woken(self, place: int, wake: Callable[[], None]) -> bool:
        file, watcher = self._file, self._watcher
        watch = watcher.watch(place, wake)

        def is_taken() -> bool:
            nonlocal watch
            if self._is_mine(place):
                return True
            watcher.move_on(file.epoch)
            if watch.is_first:  # and yet it is not our turn: somebody was quicker, and before us
                watch = watcher.watch(place, wake)
            return False

        try:
            return self._wish.wait(self._wish.runtime, is_taken, self._wish.timeout_s)
        finally:
            watcher.forget(watch)

    def _has_strangers(self, place: int) -> bool:
        """Whether anybody before us is of another process."""
        view = self._look()
        ahead = [one for there, one in view.waiters if there < place]
        if view.holder is not None:
            ahead.append(view.holder)
        return any(one.record is None or one.record.pid != self._pid for one in ahead)

    def _busy(self, place: int | None) -> MotorBusyError:
        view = self._look()
        ahead = [one for there, one in view.waiters if place is None or there < place]
        who = view.holder or (ahead[0] if ahead else Occupant(None))
        return busy_error(self._wish.runtime, self._wish.asker, who, _DOING.get(self._blocked, ""))


_DOING: Final[dict[Attempt | None, str]] = {
    Attempt.WRITING: ", in the middle of a write",
    Attempt.TAKING: ", from whom somebody is just taking it over",
    Attempt.FULL: " (too many processes live that have lost it: end those that are paused)",
}


def _remedy(who: Occupant) -> str:
    """What to do about one who is paused, and will not let go by himself."""
    if who.record is None or not who.is_paused:
        return ""
    pid = who.record.pid
    return f"let it go on (kill -CONT {pid}), or end it (kill -9 {pid})"


def busy_error(runtime: Runtime | None, asker: str, who: Occupant, doing: str) -> MotorBusyError:
    """What somebody is told who is refused; `doing` says what the holder is doing."""
    record = who.record
    now_ns = 0 if runtime is None else runtime.now_ns()
    return MotorBusyError(
        motor=asker,
        holder=f"{who.who}{doing}",
        since_ns=now_ns - round(who.age_s * 1e9),
        since=who.since,
        purpose="" if record is None else record.purpose,
        pid=None if record is None else record.pid,
        program="" if record is None else record.program,
        remedy=_remedy(who),
    )
