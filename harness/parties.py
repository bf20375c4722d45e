"""Parties that take turns in virtual time, their waits, and periodic actions."""

import threading
from _thread import allocate_lock  # the real one, never the replacement for programs
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from emulators.event_queue import Alarm

if TYPE_CHECKING:
    from harness.virtual_time import VirtualRuntime


UNKNOWN: Final = 0


class Cancelled(BaseException):
    """The end of the run, raised in a party that still waits."""


@final
class Waiter:
    """A waiting party: its condition, its deadline and the result."""

    __slots__ = ("deadline_ns", "done", "error", "on_parties", "party", "result")

    def __init__(
        self,
        party: "VirtualParty",
        done: Callable[[], bool],
        deadline_ns: int,
        on_parties: bool = False,
    ) -> None:
        self.party = party
        self.done = done
        self.deadline_ns = deadline_ns
        self.on_parties = on_parties  # it waits for other parties, not for frames
        self.result = False
        self.error: BaseException | None = None


@final
class VirtualParty:
    """One thread of execution of the application, in virtual time.

    Attributes:
        name: as given to `spawn`.
        error: the exception of the function once it has ended, else None.
        is_ending: True once it has been asked to end.
        thread: its thread; None for the first party.
        ident: thread identifier, as in threading.get_ident(); UNKNOWN before it runs.
        looked_ns, owed_ns, read_ns: time of its last clock reading, cost of its readings then,
            and the clock value returned [ns].
        held_up_by: the party that holds the lock it waits for.
    """

    def __init__(self, name: str, runtime: "VirtualRuntime") -> None:
        self.name = name
        self.error: BaseException | None = None
        self.finished = False
        self.is_ending = False
        self.joined = False
        self.baton = allocate_lock()
        self.baton.acquire()
        self.thread: threading.Thread | None = None
        self.ident = UNKNOWN
        self.held_up_by: VirtualParty | None = None
        self.looked_ns = self.owed_ns = self.read_ns = 0
        self._runtime = runtime

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait up to `timeout_s` [s]; return True if it has ended. Its exception is in `error`."""
        self.joined = True
        return self._runtime.wait_until(self.has_finished, timeout_s)

    def has_finished(self) -> bool:
        """Return True if it has ended."""
        return self.finished


@final
class PartyThread(threading.Thread):
    """The thread of a party that `spawn` started."""


@final
class Periodic:
    """An action that repeats at start + k * period until it is cancelled."""

    def __init__(self, runtime: "VirtualRuntime", period_ns: int, action: Callable[[], None]):
        self._period_ns = period_ns
        self._action = action
        self._alarm: Alarm = runtime.queue.alarm(self._expire)
        self._alarm.set(runtime.queue.now_ns + period_ns)

    def _expire(self, now_ns: int) -> None:
        self._alarm.set(now_ns + self._period_ns)
        self._action()

    def cancel(self) -> None:
        """Stop the repetition."""
        self._alarm.set(None)
