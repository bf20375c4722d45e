"""Acquisition of a lock between processes: immediate, queued, or by takeover."""

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
"""The maximum wait for the end of a write before a takeover on demand is given up [s]."""

Wait = Callable[[Runtime, Callable[[], bool], float | None], bool]
"""As `Runtime.wait_until`, with the runtime as the first argument."""


@runtime_checkable
class Wakeable(Protocol):
    """A runtime that other threads can wake: the wall runtime."""

    def wake(self) -> None:
        """Wake the waiting thread, which then checks its condition."""


def plain_wait(runtime: Runtime, done: Callable[[], bool], timeout_s: float | None) -> bool:
    """Wait as `Runtime.wait_until`."""
    return runtime.wait_until(done, timeout_s)


@final
@dataclass(frozen=True, slots=True)
class Wish:
    """A lock request; see the arguments of `ProcessLock.acquire`."""

    runtime: Runtime
    timeout_s: float | None
    asker: str
    wait: Wait
    lease_ns: int
    on_demand: bool
    describe: Callable[[int, str | None], bytes]
    """The record for a number; or that of a takeover, for the lost token and the reason."""


@final
class Taking:
    """The execution of a lock request through one open file.

    Attributes: takeover (the takeover from a living holder, or None).
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
        self._mutex: Final = mutex  # of all that take a place
        self._look: Final = look
        self._pid: Final = pid
        self._blocked: Attempt | None = None

    def take(self) -> None:
        """Acquire the lock.

        Raises:
            MotorBusyError: another process holds it; names the process.
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
        """Take the lock if it is the turn of this place, by takeover if its lease has expired."""
        file = self._file
        return file.take(place) or (file.is_first(place) and self._take_lapsed())

    # ---- takeover ----

    def _take_lapsed(self) -> bool:
        """Take over the lock if the lease of its holder has expired. Return True on success."""
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
            if watch.is_first:  # first, but not our turn: a quicker process got a place before us
                watch = watcher.watch(place, wake)
            return False

        try:
            return self._wish.wait(self._wish.runtime, is_taken, self._wish.timeout_s)
        finally:
            watcher.forget(watch)

    def _has_strangers(self, place: int) -> bool:
        """Return True if the holder or an earlier waiter is of another process."""
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
    Attempt.TAKING: ", during a takeover by another process",
    Attempt.FULL: " (too many live processes have lost the lock: end the paused ones)",
}


def _remedy(who: Occupant) -> str:
    """Return the advice against a paused holder, which cannot release the lock by itself."""
    if who.record is None or not who.is_paused:
        return ""
    pid = who.record.pid
    return f"continue it (kill -CONT {pid}), or end it (kill -9 {pid})"


def busy_error(runtime: Runtime | None, asker: str, who: Occupant, doing: str) -> MotorBusyError:
    """Return the error for a refused request; `doing` describes the activity of the holder."""
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
