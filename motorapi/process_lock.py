"""A named lock between processes, and between the threads of each process.

The order is first come, first served. When a process dies, the kernel releases its lock, or its
place in the queue; no cleanup is necessary. `motorapi.lock_file` describes the mechanism.

Every ownership has a *token*, which grows and is kept in the file of the lock. An acquisition
reports whether the lock has *changed hands* since this object held it last: its knowledge of the
locked object may then be out of date.

Waits use the runtime, so that a deadline, a broken bus or Ctrl-C ends them. The wall runtime can be
woken from outside (`wake`). A runtime without it has its own virtual time, which no other process
shares: there, a lock of another process is refused without a wait.
"""

import os
import threading
import time
import weakref
from typing import Final, final

from motorapi.errors import MotorBusyError, UsageError
from motorapi.hold import Hold, Loss
from motorapi.lock_directory import LockDirectory
from motorapi.lock_file import LockFile
from motorapi.lock_layout import LEASE, pack_record, pack_words
from motorapi.lock_takeover import TakeoverAttempt
from motorapi.lock_taking import Taking, Wait, Wish, busy_error, plain_wait
from motorapi.lock_view import LockView, Occupant, ThisProcess, find_takeover, look
from motorapi.lock_watch import QueueWatcher
from motorapi.runtime import Runtime

__all__ = ["Hold", "ProcessLock", "Wait", "can_share_time", "this_process"]

_WORDS_MAX: Final = 64
"""The maximum number of packed purposes of a lock."""
_NO_LEASE: Final = LEASE.pack(0, 0)


def can_share_time(runtime: Runtime) -> bool:
    """Return True if another process can end a wait in this runtime: the wall runtime."""
    return hasattr(runtime, "wake")  # as Wakeable; isinstance would take 40 us


@final
class ProcessLock:
    """A lock known to all processes by its name, in one directory.

    Args:
        name: name of its file; see `motorapi.lock_names`.
        label: the locked object in words, for errors and lists ("can0 node 3").
        directory: its directory; None: that of the user, or from MOTORHIL_LOCK_DIR.
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
        """Reset to the initial state without a lock, as in a forked child."""
        self._identity = os.urandom(16)
        self._mutex = threading.Lock()
        self._watcher = QueueWatcher(self._open)
        self._spare: LockFile | None = None
        self._hold: Hold | None = None
        self._writing: dict[int, list[Hold]] = {}  # by thread

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
    ) -> Hold:
        """Acquire the lock, until as many releases as acquisitions.

        Args:
            runtime: the runtime of the wait.
            purpose: in words; others can read it.
            timeout_s: timeout for processes before us [s]; None: no timeout.
            owner: the party that may acquire it repeatedly; None: the thread.
            asker: name of the refused party in the error; "": the label.
            wait: wait function of the runtime; None: its `wait_until`.
            lease_s: others may take it over after this time without renewal [s]; None: never,
                except with `take_over`.
            take_over: take it from its holder, ahead of all waiters.

        Raises:
            MotorBusyError: another process holds it; names the process. The place in the queue is
                released.
            UsageError: the file of the lock is not safe, or no wait is possible here.
        """
        if owner is None:
            owner = threading.current_thread()
        hold = self.hold
        if hold is not None and hold.owner is owner:
            hold.again()
            return hold
        lease_ns = 0 if lease_s is None else round(lease_s * 1e9)
        while True:
            file = self._take_file()
            try:
                takeover: TakeoverAttempt | None = None
                if take_over or not file.take_at_once():
                    wish = Wish(
                        runtime,
                        timeout_s,
                        asker or self.label,
                        wait or plain_wait,
                        lease_ns,
                        take_over,
                        lambda number, reason: self._record(number, purpose, reason),
                    )
                    takeover = self._take(file, wish)
                if not file.is_gone:
                    hold = self._publish(file, purpose, lease_ns, takeover, owner)
                    if hold is not None:
                        return hold
                    continue
            except OSError as error:
                file.close()
                raise UsageError(f"{file.name}: {error.strerror}") from error
            except BaseException:
                self.give_back(file)
                raise
            file.close()  # the file was removed: new requests use a new file

    def _take(self, file: LockFile, wish: Wish) -> TakeoverAttempt | None:
        """Acquire by waiting; return the takeover, if any. Raise MotorBusyError on timeout."""
        pid = this_process().pid
        taking = Taking(file, wish, self._watcher, self._mutex, self.look, pid)
        taking.take()
        return taking.takeover

    @property
    def hold(self) -> Hold | None:
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
            return busy_error(None, asker or self.label, holder, "")
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
        return busy_error(None, asker or self.label, who, ", during its takeover")

    def loss_of(self, token: int) -> Loss:
        """Return the loss of a token."""
        takeover = find_takeover(self._directory, self.name, token)
        if takeover is None:
            return Loss("an unknown process", "", "the reason is no longer known")
        return _loss(Occupant(takeover.by), takeover.reason)

    def loss_by_removal(self) -> Loss | None:
        """Return the loss to a process with a new file, after the old file was removed, or None."""
        holder = self.look().holder
        return None if holder is None else _loss(holder, "its lock file had been removed")

    def give_back(self, file: LockFile) -> None:
        """Release all locks of this open file; it is kept for the next acquisition."""
        file.let_go()
        with self._mutex:
            if self._spare is None and not file.is_closed:
                self._spare = file
                return
        file.close()

    def close(self) -> None:
        """Close the spare file; a held lock is not released."""
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

    def _publish(
        self,
        file: LockFile,
        purpose: str,
        lease_ns: int,
        takeover: TakeoverAttempt | None,
        owner: object,
    ) -> Hold | None:
        """Publish an acquired lock and return its handle; None: it is lost again already."""
        if takeover is not None:
            token, identity, was_abandoned = takeover.token, takeover.from_identity, False
        else:
            last = file.last()
            if last is None:  # greater than any token in a removed file
                last = time.time_ns() // 1000, b"", False
            token, identity, was_abandoned = last
            token += 1
            lease = _NO_LEASE
            if lease_ns:
                lease = LEASE.pack(lease_ns, time.monotonic_ns() + lease_ns)
            file.tell_holder(token, self._record(token, purpose, None), lease)
            if not identity and not file.is_current:  # taken over, by a token that may be smaller
                self.give_back(file)
                return None
        hold = self._hold = Hold(
            self,
            file,
            owner,
            token,
            changed_hands=identity != self._identity,
            was_abandoned=was_abandoned,
            taken_from=None if takeover is None else takeover.taken_from,
            lease_ns=lease_ns,
        )
        return hold

    def _record(self, number: int, purpose: str, reason: str | None) -> bytes:
        process = this_process()
        if reason is not None:
            words = pack_words(process.program, purpose, reason)
        else:
            words = self._words.get(purpose, b"")
        if not words:
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
