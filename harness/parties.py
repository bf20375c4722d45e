"""Who takes turns in virtual time: parties, what they wait for, and actions that repeat."""

import threading
from _thread import allocate_lock  # never what stands in for it in a program's own threads
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from emulators.event_queue import Alarm

if TYPE_CHECKING:
    from harness.virtual_time import VirtualRuntime


UNKNOWN: Final = 0


class Cancelled(BaseException):
    """The run is over; a party that still waits ends here."""


@final
class Waiter:
    """A party that waits: for what, until when, and how it ended."""

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
        self.on_parties = on_parties  # it is for other parties, not for frames
        self.result = False
        self.error: BaseException | None = None


@final
class VirtualParty:
    """One line of execution of the application, in virtual time.

    Attributes:
        name: as given to `spawn`.
        error: what the function raised, once it has ended; else None.
        is_ending: it was told to end.
        thread: None of the first party.
        ident: of its thread, as in threading.get_ident(); UNKNOWN before it runs.
        looked_ns, owed_ns, read_ns: when it last looked at a clock, what its looks then cost, and
            what the clock said [ns].
        held_up_by: who holds the lock that it waits for.
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
        """Whether it has ended within `timeout_s` [s]; what it raised is in `error`."""
        self.joined = True
        return self._runtime.wait_until(self.has_finished, timeout_s)

    def has_finished(self) -> bool:
        """Whether it has ended."""
        return self.finished


@final
class PartyThread(threading.Thread):
    """The thread of a party that `spawn` started."""


@final
class Periodic:
    """An action that repeats, at start + k * period, until it is cancelled."""

    def __init__(self, runtime: "VirtualRuntime", period_ns: int, action: Callable[[], None]):
        self._period_ns = period_ns
        self._action = action
        self._alarm: Alarm = runtime.queue.alarm(self._expire)
        self._alarm.set(runtime.queue.now_ns + period_ns)

    def _expire(self, now_ns: int) -> None:
        self._alarm.set(now_ns + self._period_ns)
        self._action()

    def cancel(self) -> None:
        """It does not run again."""
        self._alarm.set(None)
