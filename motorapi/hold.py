"""A lock between processes, while somebody has it; and how it was lost.

Whoever has it may lose it: it is taken over on demand, or because its lease was over. Nothing tells
the process; it finds out when it looks, at the latest when it is about to write.
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
"""How long somebody may be in the middle of taking it over; it takes him some 20 us."""
_RENEWALS_IN_USE: Final = 8
"""A lease in use is renewed so many times in its time, not with every use."""


@final
@dataclass(frozen=True, slots=True)
class Loss:
    """How a motor was lost.

    Attributes:
        who: has taken it over, in words.
        purpose: what for, in words.
        reason: why he could, in words ("its lease of 0.5 s was over", "on demand").
        since_ns, since: when, of the runtime's time and in words.
        pid, program: the process, if another one did.
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
        """What the loser is told who goes on as if he still had it."""
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
    """A lock that was taken, until `release`; also a context manager.

    Attributes: owner, token (greater than that of anybody before), changed_hands (whether another
    lock object, of whatever process, had it in between, or this one has it for the first time),
    was_abandoned (whether the one before died with it), was_taken_over (whether it was taken from
    one who lives), taken_from (from whom, in words; "": not known).
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
        self._end_ns = time.monotonic_ns() + lease_ns  # of the lease
        self._renew_ns = 0  # when to renew it; the first use does
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

    # ---- is it still ours ----

    @property
    def is_held(self) -> bool:
        """Whether it was neither let go nor lost. Never in a forked child: it is the parent's."""
        return self._depth > 0 and not self._file.is_closed and self.loss is None

    @property
    def loss(self) -> Loss | None:
        """How it was lost; None: it was not, before it was let go."""
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
        """Who took it over, and why, in words; None: nobody did."""
        loss = self.loss
        return None if loss is None else str(loss)

    # ---- leases ----

    @property
    def lease_s(self) -> float | None:
        """The lease [s]; None: there is none."""
        return self._lease_ns / 1e9 if self._lease_ns else None

    @property
    def left_s(self) -> float | None:
        """How long the lease lasts [s]; 0: it is over; None: there is none."""
        if not self._lease_ns:
            return None
        return max(0, self._end_ns - time.monotonic_ns()) / 1e9

    def renew(self) -> None:
        """The lease begins anew.

        Raises:
            MotorBusyError: it was taken over meanwhile; says by whom.
        """
        self.begin_write("")
        try:
            if self._lease_ns:
                self._tell_lease()
        finally:
            self.end_write()

    def use(self) -> None:
        """As `renew`, as often as is good for the lease; without a lease nothing is done."""
        if self._lease_ns and time.monotonic_ns() >= self._renew_ns:
            self.renew()

    def set_lease(self, lease_s: float | None) -> None:
        """It has another lease, which begins now. Raises as `renew`."""
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
        """Nobody can take it over until `end_write`. Raises as `ProcessLock.begin_write`."""
        with self._counting:
            if self._writers == 0:
                self._enter(asker)
            self._writers += 1

    def end_write(self) -> None:
        """What was begun is over, if it was begun as often."""
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
        """Whoever is in the middle of taking it over is done with that; it is ours to write."""
        end_ns = time.monotonic_ns() + _TAKER_PATIENCE_NS
        while not self._file.try_write():
            if not self._file.is_current:
                raise self._refused(asker)
            if time.monotonic_ns() > end_ns:
                raise self._lock.being_taken(self.token, asker)
            os.sched_yield()

    def _is_replaced(self) -> bool:
        """Somebody removed the lock's file: whether somebody has it by another one."""
        if self._loss is None:
            self._loss = self._lock.loss_by_removal()
        return self._loss is not None

    def _refused(self, asker: str) -> MotorBusyError:
        loss = self.loss
        return self._lock.not_ours(asker) if loss is None else loss.busy(asker or self._lock.label)

    # ---- letting go ----

    def again(self) -> None:
        """It takes one more `release` to let go."""
        with self._counting:
            self._depth += 1

    def keep_for(self, runtime: "Runtime", time_s: float) -> None:
        """It is kept for so long [s] after now, whoever releases it meanwhile."""
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
        """It was taken once less; after the last time the next one has it. More do nothing."""
        with self._counting:
            self._depth -= 1
            is_last = self._depth == 0
        if is_last:
            self._file.tell_release(self.token)
            self._lock.give_back(self._file)
