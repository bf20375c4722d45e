"""FIFO queues: turns of parties, the basis of transactions and triggers.

A turn is short; an *exclusive* one may last as long as its holder likes (low-level access). Some
objects are shared with other processes (the SYNC of a bus): then a turn also takes a lock between
processes.
"""

import threading
import weakref
from collections import deque
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final, final

from motorhil.motorapi.bus_context import context_of
from motorhil.motorapi.errors import MotorBusyError, UsageError
from motorhil.motorapi.locking.process_lock import LockHandle, ProcessLock
from motorhil.motorapi.runtime.api import Runtime, wait_until

TRANSACTION_TIMEOUT_S: Final = 10.0
"""The timeout of an operation for the one before it [s], far longer than any drive needs."""

LOW_LEVEL: Final = "low-level access"


@final
class Ticket:
    """A place in a queue. `exclusive`: its holder may keep it for any time."""

    __slots__ = ("exclusive", "since_ns", "thread", "who")

    def __init__(self, who: str, thread: int, since_ns: int) -> None:
        self.who: Final = who
        self.thread: Final = thread
        self.since_ns: int = since_ns
        self.exclusive: bool = False

    def busy(self, motor: str) -> MotorBusyError:
        """Return the error that names it as the holder."""
        purpose = LOW_LEVEL if self.exclusive else ""
        return MotorBusyError(motor=motor, holder=self.who, since_ns=self.since_ns, purpose=purpose)


@final
class FifoQueue:
    """The FIFO queue of an object used by one party at a time.

    Args:
        label: its name for users.
        lock: between processes; None: no other process uses it.

    Attributes:
        number: of the present or last turn; it grows with every turn, of any process.
        died: True if a process died during its turn; the reader of this flag clears it.
    """

    def __init__(self, label: str, lock: ProcessLock | None = None) -> None:
        self.label: Final = label
        self.lock: Final = lock
        self.number: int = 0
        self.died: bool = False
        self._queue: deque[Ticket] = deque()
        self._mutex = threading.Lock()  # of the queue; never held during a wait

    @contextmanager
    def turn(self, runtime: Runtime, who: str, timeout_s: float | None = None) -> Iterator[Ticket]:
        """Take a turn inside the block, in the order of requests.

        Args:
            runtime: the runtime of the wait.
            who: description of the holder for others.
            timeout_s: timeout, also for an exclusive holder [s]; None: wait for short turns only,
                up to `TRANSACTION_TIMEOUT_S`.

        Raises:
            UsageError: this thread already has a turn.
            MotorBusyError: an exclusive holder has it, or the timeout is over.
        """
        ticket = Ticket(who, threading.get_ident(), runtime.now_ns())
        with self._mutex:
            for other in self._queue:
                if other.thread == ticket.thread:
                    if other.exclusive:
                        raise other.busy(self.label)
                    raise UsageError(f"{who}: {other.who} is still active in this thread")
            self._queue.append(ticket)
        try:
            if self._queue[0] is not ticket:
                self._wait(runtime, ticket, timeout_s)
            hold = self._take_lock(runtime, ticket, timeout_s)
            try:
                yield ticket
            finally:
                if hold is not None:
                    hold.release()
        finally:
            with self._mutex:
                self._queue.remove(ticket)

    @property
    def is_mine(self) -> bool:
        """True if the calling thread has the turn; callbacks may run in threads of others."""
        with self._mutex:
            return bool(self._queue) and self._queue[0].thread == threading.get_ident()

    @contextmanager
    def at_once(self, runtime: Runtime, who: str) -> Iterator[bool]:
        """Try to take a turn without waiting, as in a callback; yield True on success."""
        ticket = Ticket(who, 0, runtime.now_ns())  # no thread: that of a callback is irrelevant
        with self._mutex:
            is_first = not self._queue
            if is_first:
                self._queue.append(ticket)
        if not is_first:
            yield False
            return
        hold: LockHandle | None = None
        try:
            try:
                hold = self._take_lock(runtime, ticket, 0.0)
            except MotorBusyError:
                is_first = False
            yield is_first
        finally:
            if hold is not None:
                hold.release()
            with self._mutex:
                self._queue.remove(ticket)

    def _take_lock(
        self, runtime: Runtime, ticket: Ticket, timeout_s: float | None
    ) -> LockHandle | None:
        if self.lock is None:
            self.number += 1
            return None
        wait_s = TRANSACTION_TIMEOUT_S if timeout_s is None else timeout_s
        hold = self.lock.acquire(runtime, ticket.who, wait_s, ticket, asker=self.label)
        self.number = hold.token
        self.died = self.died or hold.was_abandoned
        ticket.since_ns = runtime.now_ns()
        return hold

    def _wait(self, runtime: Runtime, ticket: Ticket, timeout_s: float | None) -> None:
        queue, patient = self._queue, timeout_s is not None

        def is_over() -> bool:
            first = queue[0]
            return first is ticket or (first.exclusive and not patient)

        wait_until(runtime, is_over, TRANSACTION_TIMEOUT_S if timeout_s is None else timeout_s)
        first = queue[0]
        if first is not ticket:
            raise first.busy(self.label)
        ticket.since_ns = runtime.now_ns()


@final
class _Triggers:
    """The turns for the triggers in one runtime, by group."""

    def __init__(self) -> None:
        self.lock: Final = threading.Lock()
        self.turns: Final[weakref.WeakValueDictionary[Hashable, FifoQueue]] = (
            weakref.WeakValueDictionary()  # each exists while a party has it or waits for it
        )


def share_trigger(runtime: Runtime, group: Hashable, turns: FifoQueue) -> None:
    """Use `turns` for the trigger `group`, while they exist."""
    triggers = context_of(runtime).medium.part(_Triggers)
    with triggers.lock:
        triggers.turns[group] = turns


def trigger_turns(runtime: Runtime, groups: Sequence[Hashable]) -> list[FifoQueue]:
    """Return the turns for the triggers `groups`, in the order of acquisition.

    A signal that starts all armed motors would start those of another group too early. The order is
    the same in all processes.
    """
    wanted: list[FifoQueue] = []
    triggers = context_of(runtime).medium.part(_Triggers)
    with triggers.lock:
        for group in dict.fromkeys(groups):
            turns = triggers.turns.get(group)
            if turns is None:
                turns = triggers.turns[group] = FifoQueue(f"the trigger {group}")
            if turns not in wanted:
                wanted.append(turns)
    return sorted(wanted, key=_place_in_order)


def _place_in_order(turns: FifoQueue) -> tuple[str, str]:
    return ("" if turns.lock is None else turns.lock.name, turns.label)
