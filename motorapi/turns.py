"""Turns: one party at a time, first come, first served. What transactions and triggers are made of.

A turn is short; an *exclusive* one is kept as long as its holder likes (low-level access).
"""

import threading
import weakref
from collections import deque
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final, final

from motorapi.errors import MotorBusyError, UsageError
from motorapi.runtime import Runtime, wait_until

TRANSACTION_TIMEOUT_S: Final = 10.0
"""How long an operation waits for the one before it; far longer than any drive takes."""

LOW_LEVEL: Final = "low-level access"


@final
class Ticket:
    """A place in a queue. `exclusive`: it is kept as long as its holder likes."""

    __slots__ = ("exclusive", "since_ns", "thread", "who")

    def __init__(self, who: str, thread: int, since_ns: int) -> None:
        self.who: Final = who
        self.thread: Final = thread
        self.since_ns = since_ns
        self.exclusive = False

    def busy(self, motor: str) -> MotorBusyError:
        """The error that names it as the holder."""
        purpose = LOW_LEVEL if self.exclusive else ""
        return MotorBusyError(motor=motor, holder=self.who, since_ns=self.since_ns, purpose=purpose)


@final
class Turns:
    """Who may use something that one party at a time may use: first come, first served."""

    def __init__(self, label: str) -> None:
        self.label: Final = label
        self._queue: deque[Ticket] = deque()
        self._mutex = threading.Lock()  # of the queue; never held while anything is waited for

    @contextmanager
    def turn(self, runtime: Runtime, who: str, timeout_s: float | None = None) -> Iterator[Ticket]:
        """Nobody else has it inside the block; in order of asking.

        Args:
            runtime: where to wait.
            who: what others are told of the holder.
            timeout_s: how long to wait, also for an exclusive holder [s]; None: for short ones
                only, and no longer than `TRANSACTION_TIMEOUT_S`.

        Raises:
            UsageError: this thread has it already.
            MotorBusyError: an exclusive holder has it, or somebody for longer than that.
        """
        ticket = Ticket(who, threading.get_ident(), runtime.now_ns())
        with self._mutex:
            for other in self._queue:
                if other.thread == ticket.thread:
                    if other.exclusive:
                        raise other.busy(self.label)
                    raise UsageError(f"{who}: {other.who} is still at work in this very thread")
            self._queue.append(ticket)
        try:
            if self._queue[0] is not ticket:
                self._wait(runtime, ticket, timeout_s)
            yield ticket
        finally:
            with self._mutex:
                self._queue.remove(ticket)

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


_triggers: Final["weakref.WeakValueDictionary[tuple[Runtime, Hashable], Turns]"] = (
    weakref.WeakValueDictionary()  # each as long as somebody has it or waits for it
)
_triggers_lock: Final = threading.Lock()


def trigger_turns(runtime: Runtime, groups: Sequence[Hashable]) -> list[Turns]:
    """Turns for arming and firing by the triggers `groups`, in the order to take them.

    A signal that starts whatever is armed would start another group's motors too early.
    """
    wanted: list[Turns] = []
    with _triggers_lock:
        for group in dict.fromkeys(groups):
            turns = _triggers.get((runtime, group))
            if turns is None:
                turns = _triggers[runtime, group] = Turns(f"the trigger {group}")
            wanted.append(turns)
    return sorted(wanted, key=lambda turns: turns.label)
