"""Locks that wait in virtual time if one party waits for another.

Otherwise they wait in wall time. All other synchronization objects (conditions, events, semaphores,
barriers, queues, futures) are the standard library's own, built from these two locks.
"""

from _thread import LockType, get_ident
from _thread import allocate_lock as _allocate_lock
from threading import TIMEOUT_MAX
from types import TracebackType
from typing import Final, final

from harness.parties import VirtualParty
from harness.virtual_program.turn import party_here, program_here, refuse_foreign

_FOR_EVER: Final = -1


@final
class Lock:
    """Stand-in for threading.Lock; waiting parties get it in the order of their requests."""

    __slots__ = ("__weakref__", "_awaited", "_holder", "_lock")

    def __init__(self) -> None:
        self._lock: LockType = _allocate_lock()
        self._holder: VirtualParty | None = None  # also None for a thread that is not a party
        self._awaited = 0  # number of waiting parties

    def acquire(self, blocking: bool = True, timeout: float = _FOR_EVER) -> bool:
        """Acquire the lock; return whether that succeeded. Parties wait in the rig's time [s]."""
        party = party_here()
        if party is not None and self._lock.acquire(False):
            self._holder = party
            return True
        if party is None or (self._holder is None and blocking):
            # The holder does not wait for the rig: time stands still meanwhile.
            got = self._lock.acquire(blocking, timeout)
            if got:
                self._holder = party
            return got
        if timeout != _FOR_EVER and (not blocking or not 0 <= timeout <= TIMEOUT_MAX):
            return self._lock.acquire(blocking, timeout)  # raises as a plain lock does
        if not blocking or timeout == 0:
            self._look(party)
            return False
        return self._wait(party, None if timeout == _FOR_EVER else timeout)

    def _wait(self, party: VirtualParty, timeout_s: float | None) -> bool:
        program = program_here()
        assert program is not None
        took = False

        def take() -> bool:
            nonlocal took
            party.held_up_by = self._holder
            if self._lock.acquire(False):
                self._holder = party
                took = True
            return took

        self._awaited += 1
        try:
            left_s = None if timeout_s is None else program.from_now_s(party, timeout_s)
            return program.runtime.wait_for_parties(take, left_s)
        except BaseException:
            if took:  # interrupted just after the lock was acquired
                self.release()
            raise
        finally:
            self._awaited -= 1
            party.held_up_by = None

    @staticmethod
    def _look(party: VirtualParty) -> None:
        program = program_here()
        if program is not None:
            program.look(party)

    def release(self) -> None:
        """Release the lock.

        Raises:
            UsageError: a thread that is not a party would wake one, at a time that only the wall
                clock knows.
        """
        if self._awaited:
            refuse_foreign("wake a party")
        self._holder = None
        self._lock.release()

    def locked(self) -> bool:
        """Return whether any thread holds the lock."""
        locked = self._lock.locked()
        party = party_here() if locked else None
        if party is not None:
            self._look(party)
        return locked

    def _at_fork_reinit(self) -> None:
        self._lock, self._holder, self._awaited = _allocate_lock(), None, 0

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.release()

    def __repr__(self) -> str:
        state = "locked" if self._lock.locked() else "unlocked"
        return f"<{state} Lock of harness.virtual_program at {id(self):#x}>"


def allocate_lock() -> Lock:
    """Stand in for _thread.allocate_lock."""
    return Lock()


@final
class RLock:
    """Stand-in for threading.RLock."""

    __slots__ = ("__weakref__", "_block", "_count", "_owner")

    def __init__(self) -> None:
        self._block = Lock()
        self._owner: int | None = None
        self._count = 0

    def acquire(self, blocking: bool = True, timeout: float = _FOR_EVER) -> bool:
        """Acquire the lock once more; return whether that succeeded."""
        me = get_ident()
        if self._owner == me:
            self._count += 1
            return True
        if not self._block.acquire(blocking, timeout):
            return False
        self._owner = me
        self._count = 1
        return True

    def release(self) -> None:
        """Release the lock once."""
        if self._owner != get_ident():
            raise RuntimeError("cannot release un-acquired lock")
        self._count -= 1
        if not self._count:
            self._owner = None
            self._block.release()

    def _is_owned(self) -> bool:
        return self._owner == get_ident()

    def _release_save(self) -> tuple[int, int | None]:
        """Release the lock completely and return its state, for threading.Condition."""
        if not self._count:
            raise RuntimeError("cannot release un-acquired lock")
        saved = self._count, self._owner
        self._count, self._owner = 0, None
        self._block.release()
        return saved

    def _acquire_restore(self, saved: tuple[int, int | None]) -> None:
        self._block.acquire()
        self._count, self._owner = saved

    def _recursion_count(self) -> int:
        return self._count if self._is_owned() else 0

    def locked(self) -> bool:
        """Return whether any thread holds the lock."""
        return self._block.locked()

    def _at_fork_reinit(self) -> None:
        self._block, self._owner, self._count = Lock(), None, 0

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.release()

    def __repr__(self) -> str:
        return f"<RLock of harness.virtual_program, held {self._count} times, at {id(self):#x}>"
