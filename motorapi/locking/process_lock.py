"""Process lock: a named lock between processes, and between the threads of each.

The order is first come, first served. When a process dies, the kernel releases its lock, or its
place in the queue; no cleanup is necessary. `motorhil.motorapi.locking.lock_file` describes the
mechanism.

Every ownership has a *token*, which grows and is kept in the file of the lock. An acquisition
reports whether the lock has *changed hands* since this object held it last: its knowledge of the
locked object may then be out of date.

The holder may lose the lock: another process takes it over on demand, or because its lease has
expired. The holder is not notified; it notices the loss at its next check, at the latest before its
next write.

Waits use the runtime, so that a deadline, a broken bus or Ctrl-C ends them. The wall runtime can be
woken from outside (`wake`). A runtime whose virtual time several processes share looks again after
their turns, and gives leases its own time. A runtime with neither has its own virtual time: there,
a lock of another process is refused without a wait.
"""

import os
import threading
import time
import weakref
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from types import TracebackType
from typing import Final, NamedTuple, Protocol, final, runtime_checkable

from motorhil.frozen import frozen
from motorhil.motorapi.errors import MotorBusyError, UsageError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.lock_file import (
    LEASE,
    NO_LEASE,
    LockFile,
    pack_record,
    pack_words,
)
from motorhil.motorapi.locking.lock_status import (
    LockView,
    Occupant,
    ThisProcess,
    find_takeover,
    look,
    read_rival,
)
from motorhil.motorapi.locking.takeover import Attempt, TakeoverAttempt
from motorhil.motorapi.locking.unused_files import remove_unused
from motorhil.motorapi.locking.waiter_thread import QueueWatcher
from motorhil.motorapi.locking.witness import Rival
from motorhil.motorapi.runtime.api import Runtime

_TAKER_PATIENCE_NS: Final = 50_000_000
"""The maximum duration of a takeover [ns]; in practice it takes about 20 us."""
_RENEWALS_IN_USE: Final = 8
"""The number of renewals per lease period during use."""
_WRITE_PATIENCE_S: Final = 0.25
"""The maximum wait for the end of a write before a takeover on demand is given up [s]."""
_WORDS_MAX: Final = 64
"""The maximum number of packed purposes of a lock."""
_DOING: Final[dict[Attempt | None, str]] = {
    Attempt.WRITING: ", in the middle of a write",
    Attempt.TAKING: ", during a takeover by another process",
    Attempt.FULL: " (too many live processes have lost the lock: end the paused ones)",
}


@final
@frozen
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
            process=None if self.pid is None else (self.pid, self.program),
            taken_over=self.reason,
        )


@final
class LockHandle:
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
        file: LockFile,
        owner: object,
        token: int,
        changed_hands: bool,
        was_abandoned: bool,
        taken_from: str | None,
        lease_ns: int,
    ) -> None:
        self._lock = lock
        self._file = file
        self._depth = 1
        self._counting = threading.Lock()
        self._writers = 0
        self._lease_ns = lease_ns
        self._end_ns = lock.clock() + lease_ns if lease_ns else 0  # end of the lease
        self._renew_ns = 0  # time of the next renewal; the first use renews
        self._loss: Loss | None = None
        self.owner: Final = owner
        self.token: Final = token
        self.changed_hands: Final = changed_hands
        self.was_abandoned: Final = was_abandoned
        self.was_taken_over: Final = taken_from is not None
        self.taken_from: Final = taken_from or ""

    def __enter__(self) -> "LockHandle":
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
            self._file.drop_witness()
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
        return max(0, self._end_ns - self._lock.clock()) / 1e9

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
        """Restart the lease if it is due; notice the removal of the lock file.

        Raises:
            MotorBusyError: the lock was taken over, or acquired in a new file after a removal.
        """
        file = self._file
        if self._depth > 0 and not file.is_closed and file.is_gone and self._is_replaced():
            raise self._refused("")
        if self._lease_ns and self._lock.clock() >= self._renew_ns:
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
        now_ns, lease_ns = self._lock.clock(), self._lease_ns
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
        if self._lease_ns and self._lock.clock() >= self._renew_ns:
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
        """Return True if another process has acquired the lock in a new file after a removal."""
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

    def keep_for(self, runtime: Runtime, time_s: float) -> None:
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


Wait = Callable[[Runtime, Callable[[], bool], float | None], bool]
"""As `Runtime.wait_until`, with the runtime as the first argument."""


@runtime_checkable
class Wakeable(Protocol):
    """A runtime that other threads can wake: the wall runtime."""

    def wake(self) -> None:
        """Wake the waiting thread, which then checks its condition."""


@runtime_checkable
class SharedTime(Protocol):
    """A runtime whose virtual time several processes share."""

    def now_ns(self) -> int:
        """Return the time [ns]."""

    def watching_processes(self) -> AbstractContextManager[None]:
        """Let waits within the block look again after each turn of another process."""


def _plain_wait(runtime: Runtime, done: Callable[[], bool], timeout_s: float | None) -> bool:
    """Wait as `Runtime.wait_until`."""
    return runtime.wait_until(done, timeout_s)


def _watching(wait: Wait) -> Wait:
    """Return the wait, which in a shared time looks again after turns of other processes."""

    def watching_wait(runtime: Runtime, done: Callable[[], bool], timeout_s: float | None) -> bool:
        if not isinstance(runtime, SharedTime):
            return wait(runtime, done, timeout_s)
        with runtime.watching_processes():
            return wait(runtime, done, timeout_s)

    return watching_wait


@final
class LockRequest(NamedTuple):
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
class _Acquisition:
    """The execution of a lock request through one open file.

    Attributes: takeover (the takeover from a living holder, or None).
    """

    def __init__(
        self,
        file: LockFile,
        request: LockRequest,
        watcher: QueueWatcher,
        mutex: threading.Lock,
        look: Callable[[], LockView],
        clock: Callable[[], int],
    ) -> None:
        self.takeover: TakeoverAttempt | None = None
        self._file: Final = file
        self._request: Final = request
        self._watcher: Final = watcher
        self._mutex: Final = mutex  # of all that take a place
        self._look: Final = look
        self._clock: Final = clock
        self._blocked: Attempt | None = None

    def take(self) -> None:
        """Acquire the lock.

        Raises:
            MotorBusyError: another process holds it; names the process.
        """
        request = self._request
        if request.on_demand:
            self._take_on_demand()
            return
        with self._mutex:
            mine = self._file.queue_up(1 + self._watcher.busy_before)
        if self._is_mine(mine):
            return
        runtime, timeout_s = request.runtime, request.timeout_s
        if timeout_s is None or timeout_s > 0.0:
            self._file.tell_waiter(mine, request.describe(mine, None))
            if isinstance(runtime, Wakeable):
                if self._wait_woken(mine, runtime.wake):
                    return
            elif (can_share_time(runtime) or not self._has_strangers(mine)) and request.wait(
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
        now_ns = self._clock()
        return 0 < self._file.line().lease_end_ns <= now_ns and self._take_over(now_ns)

    def _take_on_demand(self) -> None:
        request = self._request

        def is_taken() -> bool:
            return self._file.take_in_front() or self._take_over(None)

        if is_taken():
            return
        timeout_s = request.timeout_s
        if timeout_s is not None:
            timeout_s = max(timeout_s, _WRITE_PATIENCE_S)
        if not _watching(_plain_wait)(request.runtime, is_taken, timeout_s):
            raise self._busy(None)

    def _take_over(self, now_ns: int | None) -> bool:
        lease_ns = self._request.lease_ns
        end_ns = self._clock() + lease_ns if lease_ns else 0
        attempt = TakeoverAttempt(self._file, now_ns, self._request.describe, lease_ns, end_ns)
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
            return self._request.wait(self._request.runtime, is_taken, self._request.timeout_s)
        finally:
            watcher.forget(watch)

    def _has_strangers(self, place: int) -> bool:
        """Return True if the holder or an earlier waiter is of another process."""
        view, pid = self._look(), this_process().pid
        ahead = [one for there, one in view.waiters if there < place]
        if view.holder is not None:
            ahead.append(view.holder)
        return any(one.record is None or one.record.pid != pid for one in ahead)

    def _busy(self, place: int | None) -> MotorBusyError:
        if self._blocked is Attempt.RIVAL:
            rival = _find_rival(self._file, self._request)
            if rival is not None:
                return rival
        view = self._look()
        ahead = [one for there, one in view.waiters if place is None or there < place]
        who = view.holder or (ahead[0] if ahead else Occupant(None))
        return _busy_error(
            self._request.runtime, self._request.asker, who, _DOING.get(self._blocked, "")
        )


def _remedy(who: Occupant) -> str:
    """Return the advice against a paused holder, which cannot release the lock by itself."""
    if who.record is None or not who.is_paused:
        return ""
    pid = who.record.pid
    return f"continue it (kill -CONT {pid}), or end it (kill -9 {pid})"


def _busy_error(
    runtime: Runtime | None, asker: str, who: Occupant, doing: str, remedy: str = ""
) -> MotorBusyError:
    """Return the error for a refused request; `doing` describes the activity of the holder."""
    record = who.record
    now_ns = 0 if runtime is None else runtime.now_ns()
    return MotorBusyError(
        motor=asker,
        holder=f"{who.who}{doing}",
        since_ns=now_ns - round(who.age_s * 1e9),
        since=who.since,
        purpose="" if record is None else record.purpose,
        process=None if record is None else (record.pid, record.program),
        remedy=remedy or _remedy(who),
    )


def _removed_error(runtime: Runtime, asker: str, rival: Rival, who: Occupant) -> MotorBusyError:
    """Return the error for a lock that is held in another file of the same name."""
    doing = ", whose lock file was removed or moved,"
    if who.record is not None:
        how = _remedy(who) or f"release the motor there, or end the program (kill {rival.pid})"
        return _busy_error(runtime, asker, who, doing, how)
    if rival.pid:
        holder, how = f"pid {rival.pid}", f"end it (kill {rival.pid})"
    else:
        holder = "a process of another user or container"
        how = f"as root, find it (grep -l {rival.byte} /proc/[0-9]*/fdinfo/*)"
    return MotorBusyError(
        motor=asker, holder=holder + doing, since_ns=0, since="an unknown time", remedy=how
    )


def _find_rival(file: LockFile, request: LockRequest) -> MotorBusyError | None:
    """Return the refusal that names the holder of another file; None: the witness is set."""
    refusals: list[MotorBusyError] = []

    def is_live(rival: Rival) -> bool:
        who = read_rival(rival)
        if who is not None:
            refusals.append(_removed_error(request.runtime, request.asker, rival, who))
        return who is not None

    return None if file.witness(is_live) else refusals[-1]


def can_share_time(runtime: Runtime) -> bool:
    """Return True if another process can end a wait in this runtime."""
    # as Wakeable and SharedTime; isinstance would take 40 us
    return hasattr(runtime, "wake") or hasattr(runtime, "watching_processes")


@final
class ProcessLock:
    """A lock known to all processes by its name, in one directory.

    Args:
        name: name of its file; see `motorhil.motorapi.locking.directory`.
        label: the locked object in words, for errors and lists ("can0 node 3").
        directory: its directory; None: that of the user, or from MOTORHIL_LOCK_DIR.
        runtime: where its users wait; leases are in its time if processes share that.

    Attributes:
        runtime: see above.
    """

    def __init__(
        self,
        name: str,
        label: str,
        directory: LockDirectory | None = None,
        runtime: Runtime | None = None,
    ) -> None:
        if not name or "/" in name or name.startswith(".") or len(name.encode()) > 200:
            raise UsageError(f"lock {name!r}: must be 1 to 200 characters, no '/', no '.' in front")
        self.name: Final = name
        self.label: Final = label
        self.runtime: Final = runtime
        self._directory: Final = LockDirectory() if directory is None else directory
        self.clock: Final[Callable[[], int]] = (
            runtime.now_ns if isinstance(runtime, SharedTime) else time.monotonic_ns
        )
        self._words: dict[str, bytes] = {}
        self.begin_anew()
        with _all_lock:
            _all.add(self)

    def begin_anew(self) -> None:
        """Reset to the initial state without a lock, as in a forked child."""
        self._identity = os.urandom(16)
        self._mutex = threading.Lock()
        self._watcher = QueueWatcher(self._open)
        self._spares: list[LockFile] = []  # free files; its operations are atomic
        self._files: weakref.WeakSet[LockFile] = weakref.WeakSet()  # all open ones
        self._hold: LockHandle | None = None
        self._writing: dict[int, list[LockHandle]] = {}  # by thread

    # ---- acquisition ----

    def acquire(
        self,
        runtime: Runtime,
        purpose: str,
        timeout_s: float | None = 0.0,
        owner: object = None,
        *,
        asker: str = "",
        wait: Wait | None = None,
        lease_s: float | None = None,
        take_over: bool = False,
    ) -> LockHandle:
        """Acquire the lock, until as many releases as acquisitions.

        Args:
            runtime: the runtime of the wait.
            purpose: in words; others can read it.
            timeout_s: timeout for processes before us [s]; None: no timeout.
            owner: the party that may acquire it repeatedly; None: the thread.
            asker: name of the refused party in the error; "": the label.
            wait: wait function of the runtime; None: its `wait_until`.
            lease_s: others may take it over after this time without renewal [s]; None: no lease.
            take_over: take it from its holder, ahead of all waiters.

        Raises:
            MotorBusyError: another process holds it; names the process.
            UsageError: the file of the lock is not safe, or no wait is possible here.
        """
        owner = threading.current_thread() if owner is None else owner
        hold = self._hold
        if hold is not None and hold.owner is owner and hold.is_held:
            hold.again()
            return hold
        lease_ns = 0 if lease_s is None else round(lease_s * 1e9)
        asked = runtime, purpose, timeout_s, asker, wait, lease_ns, take_over
        while True:
            file = self._take_file()
            try:
                takeover: TakeoverAttempt | None = None
                if take_over or not file.take_at_once():
                    takeover = self._take(file, self._request(*asked))
                if not file.witness():
                    self._await_rival(file, self._request(*asked), takeover)
                if not file.is_gone:
                    return self._publish(file, purpose, lease_ns, takeover, owner)
            except OSError as error:
                file.close()
                raise UsageError(f"{file.name}: {error.strerror}") from error
            except BaseException:
                self.give_back(file)
                raise
            file.close()  # the file was removed: new requests use a new file

    def _request(
        self,
        runtime: Runtime,
        purpose: str,
        timeout_s: float | None,
        asker: str,
        wait: Wait | None,
        lease_ns: int,
        take_over: bool,
    ) -> LockRequest:
        return LockRequest(
            runtime,
            timeout_s,
            asker or self.label,
            _watching(wait or _plain_wait),
            lease_ns,
            take_over,
            lambda number, reason: self._record(number, purpose, reason),
        )

    def _take(self, file: LockFile, request: LockRequest) -> TakeoverAttempt | None:
        """Acquire by waiting; return the takeover, if any. Raise MotorBusyError on timeout."""
        acquisition = _Acquisition(file, request, self._watcher, self._mutex, self.look, self.clock)
        acquisition.take()
        return acquisition.takeover

    def _await_rival(
        self, file: LockFile, request: LockRequest, takeover: TakeoverAttempt | None
    ) -> None:
        """Wait until no other file of this name is held, or this one is removed too.

        Raises:
            MotorBusyError: the file of the holder was removed or moved; names the holder.
        """
        runtime, timeout_s = request.runtime, request.timeout_s

        def is_alone() -> bool:
            return file.is_gone or file.witness()

        def refused() -> MotorBusyError | None:
            return None if file.is_gone else _find_rival(file, request)

        if refused() is None:
            return
        if can_share_time(runtime) and (timeout_s is None or timeout_s > 0.0):
            request.wait(runtime, is_alone, timeout_s)
        refusal = refused()
        if refusal is None:
            return
        if takeover is not None:
            file.tell_release(takeover.token)
        raise refusal

    @property
    def directory(self) -> Path:
        """The directory of its file."""
        return self._directory.path

    @property
    def hold(self) -> LockHandle | None:
        """The handle of this lock object in this process, or None."""
        hold = self._hold
        return hold if hold is not None and hold.is_held else None

    def begin_write(self, asker: str = "") -> int:
        """Block takeovers until `end_write`. Return the token of this process.

        Any thread may call it, also nested. The code in between must be short, and not wait.

        Raises:
            MotorBusyError: this process does not hold it, or has lost it; names holder and reason.
        """
        thread = threading.get_ident()
        stack = self._writing.get(thread)
        if stack is None:
            stack = self._writing[thread] = []
        hold = stack[-1] if stack else self._hold
        if hold is None:
            raise self.not_ours(asker)
        hold.begin_write(asker)
        stack.append(hold)
        return hold.token

    def end_write(self) -> None:
        """End the write begun by this thread with `begin_write`."""
        self._writing[threading.get_ident()].pop().end_write()

    def not_ours(self, asker: str) -> MotorBusyError:
        """Return the error for writing without holding the lock."""
        holder = self.look().holder
        if holder is not None:
            return _busy_error(None, asker or self.label, holder, "")
        return MotorBusyError(
            motor=asker or self.label,
            holder="no process, and must be acquired before a command,",
            since_ns=0,
            since="its release",
        )

    def being_taken(self, token: int, asker: str) -> MotorBusyError:
        """Return the error for writing during a takeover."""
        takeover = find_takeover(self._directory, self.name, token, is_done=False)
        who = Occupant(None if takeover is None else takeover.by)
        return _busy_error(None, asker or self.label, who, ", during its takeover")

    def loss_of(self, token: int) -> Loss:
        """Return the loss of a token."""
        takeover = find_takeover(self._directory, self.name, token)
        if takeover is None:
            return Loss("an unknown process", "", "the reason is no longer known")
        return _loss(Occupant(takeover.by), takeover.reason)

    def loss_by_removal(self) -> Loss | None:
        """Return the loss to a process with a new file, after the old file was removed, or None."""
        view, reason = self.look(), "its lock file had been removed"
        if view.holder is not None and view.holder.record is not None:
            return _loss(view.holder, reason)  # another one waits until this process releases it
        return Loss("a process that has released it", "", reason) if view.token else None

    def give_back(self, file: LockFile) -> None:
        """Release all locks of this open file; it is kept for the next acquisition."""
        file.let_go()
        if self._spares or file.is_closed:
            file.close()
        else:
            self._spares.append(file)

    def close(self) -> None:
        """Close the spare files; a held lock is not released."""
        with suppress(IndexError):
            while True:
                self._spares.pop().close()

    def abandon(self) -> None:
        """Close all files without a release, as the kernel does when a process dies."""
        for file in tuple(self._files):
            file.close()

    def _open(self) -> LockFile:
        file = LockFile(self._directory, self.name)
        self._files.add(file)
        if file.is_new:  # the directory grows
            remove_unused(self._directory)
        return file

    def _take_file(self) -> LockFile:
        try:
            return self._spares.pop()
        except IndexError:
            return self._open()

    def _publish(
        self,
        file: LockFile,
        purpose: str,
        lease_ns: int,
        takeover: TakeoverAttempt | None,
        owner: object,
    ) -> LockHandle:
        """Publish an acquired lock and return its handle."""
        if takeover is not None:
            token, identity, was_abandoned = takeover.token, takeover.from_identity, False
            taken_from: str | None = takeover.taken_from
        else:
            token, taken_from = file.token, None
            _, identity, was_abandoned = file.last() or (0, b"", False)
            lease = LEASE.pack(lease_ns, self.clock() + lease_ns) if lease_ns else NO_LEASE
            file.tell_holder(self._record(token, purpose, None), lease)
        changed_hands = identity != self._identity
        hold = self._hold = LockHandle(
            self, file, owner, token, changed_hands, was_abandoned, taken_from, lease_ns
        )
        return hold

    def _record(self, number: int, purpose: str, reason: str | None) -> bytes:
        process = this_process()
        words = self._words.get(purpose)
        if reason is not None:
            words = pack_words(process.program, purpose, reason)
        elif words is None:
            if len(self._words) >= _WORDS_MAX:
                self._words.clear()
            words = self._words[purpose] = pack_words(process.program, purpose, self.label)
        since = time.monotonic_ns(), time.time_ns()
        return pack_record(number, self._identity, process.facts, since, words)

    def look(self) -> LockView:
        """Return the present holder and waiters, without taking or delaying the lock."""
        return look(self._directory, self.name)


def _loss(who: Occupant, reason: str) -> Loss:
    record = who.record
    return Loss(
        who.who,
        "" if record is None else record.purpose,
        reason,
        since=who.since,
        pid=None if record is None else record.pid,
        program="" if record is None else record.program,
    )


_all_lock: Final = threading.Lock()
_all: Final["weakref.WeakSet[ProcessLock]"] = weakref.WeakSet()
_process: list[ThisProcess] = []


def close_spare_files(directory: Path) -> None:
    """Close the spare files of all locks in this directory, which no object uses any more."""
    with _all_lock:
        locks = tuple(_all)
    for lock in locks:
        if lock.directory == directory:
            lock.close()


def abandon_locks(runtime: Runtime) -> None:
    """Abandon all locks whose users wait in this runtime, as if their process had died."""
    with _all_lock:
        locks = tuple(_all)
    for lock in locks:
        if lock.runtime is runtime:
            lock.abandon()


def this_process() -> ThisProcess:
    """Return the published identity of this process."""
    if not _process:
        _process.append(ThisProcess())
    return _process[0]


def _in_child() -> None:
    _all_lock.release()
    _process.clear()
    for lock in tuple(_all):
        lock.begin_anew()


os.register_at_fork(
    before=_all_lock.acquire, after_in_parent=_all_lock.release, after_in_child=_in_child
)
