"""A lock between processes, and between the threads of each, that says who has it.

First come, first served, in the order of asking. The kernel lets go of what a process had, or of
its place in the queue, when it dies; nothing has to be tidied up. `motorapi.lock_file` says how.

Every ownership has a *token*, which grows; it is kept in the lock's file. Whoever takes the lock is
told whether it has *changed hands* since this object had it last: what it remembers of the thing
that is locked may then be true no more.

Waiting is the runtime's, so that a deadline, a broken bus or Ctrl-C ends it. The wall's runtime can
be woken from outside (`wake`). One that cannot lives in a time of its own, which no other process
shares: there, what another process has is refused, not waited for.
"""

import os
import threading
import time
import weakref
from collections.abc import Callable
from typing import Final, Protocol, final, runtime_checkable

from motorapi.errors import MotorBusyError, UsageError
from motorapi.hold import Hold
from motorapi.lock_directory import LockDirectory
from motorapi.lock_file import LockFile, pack_record, pack_words
from motorapi.lock_view import LockView, Occupant, ThisProcess, look
from motorapi.lock_watch import QueueWatcher
from motorapi.runtime import Runtime

__all__ = ["Hold", "ProcessLock", "can_share_time", "this_process"]

_WORDS_MAX: Final = 64
"""So many purposes of a lock are kept packed."""


Wait = Callable[[Runtime, Callable[[], bool], float | None], bool]
"""As `Runtime.wait_until`, with the runtime in front."""


@runtime_checkable
class _Wakeable(Protocol):
    def wake(self) -> None: ...


def can_share_time(runtime: Runtime) -> bool:
    """Whether another process can end a wait in this runtime: it is the wall's."""
    return isinstance(runtime, _Wakeable)


def _plain_wait(runtime: Runtime, done: Callable[[], bool], timeout_s: float | None) -> bool:
    return runtime.wait_until(done, timeout_s)


@final
class ProcessLock:
    """A lock that all processes know by its name, in one directory.

    Args:
        name: of its file; see `motorapi.lock_names`.
        label: what it locks, in words, for errors and lists ("can0 node 3").
        directory: where; None: the user's own, or as MOTORHIL_LOCK_DIR says.
    """

    def __init__(self, name: str, label: str, directory: LockDirectory | None = None) -> None:
        if not name or "/" in name or name.startswith(".") or len(name.encode()) > 200:
            raise UsageError(f"lock {name!r}: must be 1 to 200 characters, no '/', no '.' in front")
        self.name: Final = name
        self.label: Final = label
        self._directory: Final = LockDirectory() if directory is None else directory
        self._words: dict[str, bytes] = {}
        self.begin_anew()
        with _all_lock:
            _all.add(self)

    def begin_anew(self) -> None:
        """It has nothing, and knows of nobody: as a forked child begins."""
        self._identity = os.urandom(16)
        self._mutex = threading.Lock()
        self._watcher = QueueWatcher(self._open)
        self._spare: LockFile | None = None
        self._hold: Hold | None = None

    # ---- taking ----

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
    ) -> Hold:
        """The lock is ours, until the hold was released as often as it was acquired.

        Args:
            runtime: where to wait.
            purpose: what for, in words; others can read it.
            timeout_s: how long to wait for those before us [s]; None: as long as it takes.
            owner: who may take it again while it has it; None: the thread.
            asker: what the error calls the one who was refused; "": the label.
            wait: how to wait in the runtime; None: by its `wait_until`.
            lease_s: others may take it over once it was not renewed for so long [s]; None: never,
                but by `take_over`.
            take_over: take it from whoever has it, in front of all who wait.

        Raises:
            MotorBusyError: somebody else has it; says who. Our place in the queue is given up.
            UsageError: the lock's file is not safe, or no waiting is possible here.
        """
        if owner is None:
            owner = threading.current_thread()
        hold = self.hold
        if hold is not None and hold.owner is owner:
            hold.again()
            return hold
        while True:
            file = self._take_file()
            try:
                if not file.take_at_once():
                    self._wait(file, runtime, purpose, timeout_s, asker, wait or _plain_wait)
                if not file.is_gone:
                    return self._publish(file, purpose, owner)
            except OSError as error:
                file.close()
                raise UsageError(f"{file.name}: {error.strerror}") from error
            except BaseException:
                self.give_back(file)
                raise
            file.close()  # somebody has tidied up: who comes now uses a new file

    @property
    def hold(self) -> Hold | None:
        """The hold that this process has now through this object, if any."""
        hold = self._hold
        return hold if hold is not None and hold.is_held else None

    def begin_write(self, asker: str = "") -> int:
        """The token of this process's hold, which cannot be taken over until `end_write`.

        May be nested. What is written in between must be short, and must not wait.

        Raises:
            MotorBusyError: this process does not have it; says who, and why that is so.
        """
        hold = self.hold
        if hold is None:
            raise self._not_ours(asker or self.label)
        return hold.token

    def end_write(self) -> None:
        """What was begun by `begin_write` is over."""

    def _not_ours(self, asker: str) -> MotorBusyError:
        holder = self.look().holder
        who = "nobody of this process" if holder is None else holder.who
        record = None if holder is None else holder.record
        return MotorBusyError(
            motor=asker,
            holder=who,
            since_ns=0,
            since="" if holder is None else holder.since,
            purpose="" if record is None else record.purpose,
            pid=None if record is None else record.pid,
            program="" if record is None else record.program,
        )

    def give_back(self, file: LockFile) -> None:
        """Nothing is locked by way of this open file; it is kept for the next time."""
        file.let_go()
        with self._mutex:
            if self._spare is None and not file.is_closed:
                self._spare = file
                return
        file.close()

    def close(self) -> None:
        """What is kept open for the next time is closed; what is held is not let go."""
        with self._mutex:
            spare, self._spare = self._spare, None
        if spare is not None:
            spare.close()

    def _open(self) -> LockFile:
        return LockFile(self._directory, self.name)

    def _take_file(self) -> LockFile:
        with self._mutex:
            file, self._spare = self._spare, None
        return self._open() if file is None else file

    def _publish(self, file: LockFile, purpose: str, owner: object) -> Hold:
        token, identity, was_abandoned = file.last()
        token += 1
        file.tell_holder(token, self._record(token, purpose))
        hold = self._hold = Hold(
            self,
            file,
            owner,
            token,
            changed_hands=identity != self._identity,
            was_abandoned=was_abandoned,
        )
        return hold

    def _record(self, number: int, purpose: str) -> bytes:
        process = this_process()
        words = self._words.get(purpose)
        if words is None:
            if len(self._words) >= _WORDS_MAX:
                self._words.clear()
            words = self._words[purpose] = pack_words(process.program, purpose, self.label)
        since = time.monotonic_ns(), time.time_ns()
        return pack_record(number, self._identity, process.facts, since, words)

    # ---- waiting ----

    def _wait(
        self,
        file: LockFile,
        runtime: Runtime,
        purpose: str,
        timeout_s: float | None,
        asker: str,
        wait: Wait,
    ) -> None:
        """It is our turn, and it is taken; or MotorBusyError."""
        with self._mutex:
            place = file.queue_up(1 + self._watcher.busy_before)
        if file.take(place):
            return
        if timeout_s is None or timeout_s > 0.0:
            file.tell_waiter(place, self._record(place, purpose))
            if isinstance(runtime, _Wakeable):
                if self._wait_woken(file, place, runtime, timeout_s, wait):
                    return
            elif not self._has_strangers(place) and wait(
                runtime, lambda: file.take(place), timeout_s
            ):
                return
        raise self._busy(runtime, place, asker or self.label)

    def _wait_woken(
        self, file: LockFile, place: int, runtime: Runtime, timeout_s: float | None, wait: Wait
    ) -> bool:
        assert isinstance(runtime, _Wakeable)
        wake = runtime.wake
        watch = self._watcher.watch(place, wake)

        def is_taken() -> bool:
            nonlocal watch
            if file.take(place):
                return True
            if watch.is_first:  # and yet it is not our turn: somebody was quicker, and before us
                watch = self._watcher.watch(place, wake)
            return False

        try:
            return wait(runtime, is_taken, timeout_s)
        finally:
            self._watcher.forget(watch)

    def _has_strangers(self, place: int) -> bool:
        """Whether anybody before us is of another process."""
        view = self.look()
        ahead = [one for there, one in view.waiters if there < place]
        if view.holder is not None:
            ahead.append(view.holder)
        pid = this_process().pid
        return any(one.record is None or one.record.pid != pid for one in ahead)

    def _busy(self, runtime: Runtime, place: int, asker: str) -> MotorBusyError:
        view = self.look()
        ahead = [one for there, one in view.waiters if there < place]
        who = view.holder or (ahead[0] if ahead else Occupant(None))
        record = who.record
        return MotorBusyError(
            motor=asker,
            holder=who.who,
            since_ns=runtime.now_ns() - round(who.age_s * 1e9),
            since=who.since,
            purpose="" if record is None else record.purpose,
            pid=None if record is None else record.pid,
            program="" if record is None else record.program,
        )

    def look(self) -> LockView:
        """Who has it and who waits for it now. Looking takes nothing and delays nobody."""
        return look(self._directory, self.name)


_all_lock: Final = threading.Lock()
_all: Final["weakref.WeakSet[ProcessLock]"] = weakref.WeakSet()
_process: list[ThisProcess] = []


def this_process() -> ThisProcess:
    """Who we are, as others read it."""
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
