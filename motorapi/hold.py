"""Handle of a held lock between processes, and its loss.

The holder may lose the lock: another process takes it over on demand, or because its lease has
expired. The holder is not notified; it notices the loss at its next check, at the latest before its
next write.
"""

import os
import threading
import time
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Final, final

from motorapi.errors import MotorBusyError

if TYPE_CHECKING:
    from motorapi.lock_file import LockFile
    from motorapi.process_lock import ProcessLock
    from motorapi.runtime import Runtime

_TAKER_PATIENCE_NS: Final = 50_000_000
"""The maximum duration of a takeover [ns]; in practice it takes about 20 us."""
_RENEWALS_IN_USE: Final = 8
"""The number of renewals per lease period during use."""


@final
@dataclass(frozen=True, slots=True)
class Loss:
    """The loss of a motor.

    Attributes:
        who: the new owner, in words.
        purpose: its purpose, in words.
        reason: the reason for the takeover, in words ("its lease of 0.5 s was over", "on demand").
        since_ns, since: time of the takeover, in the time of the runtime and in words.
        pid, program: the process, if another one took it over.
    """

    who: str
    purpose: str
    reason: str
    since_ns: int = 0
    since: str = ""
    pid: int | None = None
    program: str = ""

    def __str__(self) -> str:
        purpose = f" for {self.purpose}" if self.purpose else ""
        return f"{self.who}{purpose}, which took it over ({self.reason})"

    def busy(self, motor: str) -> MotorBusyError:
        """Return the error for a former owner that continues to use the motor."""
        return MotorBusyError(
            motor=motor,
            holder=self.who,
            since_ns=self.since_ns,
            since=self.since,
            purpose=self.purpose,
            pid=self.pid,
            program=self.program,
            taken_over=self.reason,
        )


@final
class Hold:
    """A held lock, until `release`; also a context manager.

    Attributes: owner, token (greater than any earlier one), changed_hands (True if another lock
    object, of any process, held it in between, or this object holds it for the first time),
    was_abandoned (True if the previous holder died with it), was_taken_over (True if it was taken
    from a living holder), taken_from (that holder, in words; "": unknown).
    """

    __slots__ = (
        "_counting",
        "_depth",
        "_end_ns",
        "_file",
        "_lease_ns",
        "_lock",
        "_loss",
        "_renew_ns",
        "_writers",
        "changed_hands",
        "owner",
        "taken_from",
        "token",
        "was_abandoned",
        "was_taken_over",
    )

    def __init__(
        self,
        lock: "ProcessLock",
        file: "LockFile",
        owner: object,
        token: int,
        *,
        changed_hands: bool,
        was_abandoned: bool,
        taken_from: str | None = None,
        lease_ns: int = 0,
    ) -> None:
        self._lock = lock
        self._file = file
        self._depth = 1
        self._counting = threading.Lock()
        self._writers = 0
        self._lease_ns = lease_ns
        self._end_ns = time.monotonic_ns() + lease_ns  # end of the lease
        self._renew_ns = 0  # time of the next renewal; the first use renews
        self._loss: Loss | None = None
        self.owner: Final = owner
        self.token: Final = token
        self.changed_hands: Final = changed_hands
        self.was_abandoned: Final = was_abandoned
        self.was_taken_over: Final = taken_from is not None
        self.taken_from: Final = taken_from or ""

    def __enter__(self) -> "Hold":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.release()

    # ---- validity ----

    @property
    def is_held(self) -> bool:
        """True if it was neither released nor lost. Always False in a forked child."""
        return self._depth > 0 and not self._file.is_closed and self.loss is None

    @property
    def loss(self) -> Loss | None:
        """The loss of the lock before its release, or None."""
        if (
            self._loss is None
            and self._depth > 0
            and not self._file.is_closed
            and not self._file.is_current
        ):
            self._loss = self._lock.loss_of(self.token)
        return self._loss

    @property
    def lost_to(self) -> str | None:
        """The new owner and its reason in words, or None."""
        loss = self.loss
        return None if loss is None else str(loss)

    # ---- leases ----

    @property
    def lease_s(self) -> float | None:
        """The lease [s], or None."""
        return self._lease_ns / 1e9 if self._lease_ns else None

    @property
    def left_s(self) -> float | None:
        """The remaining time of the lease [s]; 0 if it has expired, None without a lease."""
        if not self._lease_ns:
            return None
        return max(0, self._end_ns - time.monotonic_ns()) / 1e9

    def renew(self) -> None:
        """Restart the lease.

        Raises:
            MotorBusyError: the lock was taken over meanwhile; names the new owner.
        """
        self.begin_write("")
        try:
            if self._lease_ns:
                self._tell_lease()
        finally:
            self.end_write()

    def use(self) -> None:
        """Restart the lease if it is due; without a lease do nothing."""
        if self._lease_ns and time.monotonic_ns() >= self._renew_ns:
            self.renew()

    def set_lease(self, lease_s: float | None) -> None:
        """Set another lease, which begins now. Raises as `renew`."""
        self._lease_ns = 0
        self.begin_write("")
        try:
            self._lease_ns = 0 if lease_s is None else round(lease_s * 1e9)
            self._tell_lease()
        finally:
            self.end_write()

    def _tell_lease(self) -> None:
        now_ns, lease_ns = time.monotonic_ns(), self._lease_ns
        self._renew_ns = now_ns + lease_ns // _RENEWALS_IN_USE
        self._end_ns = now_ns + lease_ns
        self._file.tell_lease(lease_ns, self._end_ns if lease_ns else 0)

    # ---- writing ----

    def begin_write(self, asker: str) -> None:
        """Block takeovers until `end_write`. Raises as `ProcessLock.begin_write`."""
        with self._counting:
            if self._writers == 0:
                self._enter(asker)
            self._writers += 1

    def end_write(self) -> None:
        """End one write section; the last one permits takeovers again."""
        with self._counting:
            if self._writers:
                self._writers -= 1
                if self._writers == 0 and self._depth > 0:
                    self._file.end_write()

    def _enter(self, asker: str) -> None:
        file = self._file
        if self._depth <= 0 or self._loss is not None or file.is_closed:
            raise self._refused(asker)
        if not file.try_write():
            self._await_taker(asker)
        if not file.is_current or (file.is_gone and self._is_replaced()):
            file.end_write()
            raise self._refused(asker)
        if self._lease_ns and time.monotonic_ns() >= self._renew_ns:
            self._tell_lease()

    def _await_taker(self, asker: str) -> None:
        """Wait until a takeover under way has ended and writing is permitted."""
        end_ns = time.monotonic_ns() + _TAKER_PATIENCE_NS
        while not self._file.try_write():
            if not self._file.is_current:
                raise self._refused(asker)
            if time.monotonic_ns() > end_ns:
                raise self._lock.being_taken(self.token, asker)
            os.sched_yield()

    def _is_replaced(self) -> bool:
        """Return True if another process holds the lock through a new file after a removal."""
        if self._loss is None:
            self._loss = self._lock.loss_by_removal()
        return self._loss is not None

    def _refused(self, asker: str) -> MotorBusyError:
        loss = self.loss
        return self._lock.not_ours(asker) if loss is None else loss.busy(asker or self._lock.label)

    # ---- release ----

    def again(self) -> None:
        """Require one more `release` call."""
        with self._counting:
            self._depth += 1

    def keep_for(self, runtime: "Runtime", time_s: float) -> None:
        """Keep the lock for `time_s` [s] from now, whatever is released meanwhile."""
        self.again()

        def over() -> None:
            timer.cancel()
            self.release()

        try:
            timer = runtime.every(max(time_s, 1e-6), over)
        except BaseException:
            self.release()
            raise

    def release(self) -> None:
        """Undo one acquisition; the last one releases the lock. Further calls do nothing."""
        with self._counting:
            self._depth -= 1
            is_last = self._depth == 0
        if is_last:
            self._file.tell_release(self.token)
            self._lock.give_back(self._file)
