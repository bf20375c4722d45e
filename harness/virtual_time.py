"""Virtual time: one queue of events, and parties that take turns under one baton.

Waiting is what lets time pass. Whoever waits runs the world's events, one by one in the order
(time, order of asking), until somebody's condition holds or somebody's time is up; then that party
goes on, and everybody else stands still. So ordinary blocking code is deterministic.

The rules of turn:
    1. At any moment exactly one thread runs: the party that has the baton.
    2. The baton changes hands only in `wait_until`, and when a party ends.
    3. Of several waiting parties that could go on at one time, the one that asked first does.
    4. What happens at the very time a timeout ends still counts: events first, then the timeout.
With `pace`, the same events happen in the same order, but none earlier than its wall time.
"""

import threading
from collections.abc import Callable
from operator import attrgetter
from typing import TYPE_CHECKING, Final, Protocol, final

from emulators.event_queue import UNSET, EventQueue
from harness.parties import Cancelled, PartyThread, Periodic, VirtualParty, Waiter
from motorapi.errors import UsageError

if TYPE_CHECKING:
    import can

    from motorapi.runtime import FrameListener, Registration

_NEVER: Final = -1
_END_NS: Final = 2 * 10**18  # 63 years: to controllers, what is later (2**61 ns) never comes
_STUCK_NS: Final = 3600 * 10**9  # so long parties wait for one another while events go on
_POLLS_MAX: Final = 1_000_000
_LOOK_UP_TURNS: Final = 256  # compiled code must look for signals now and then
GRACE_S: Final = 1.0  # wall time that a party has to wait next, or to end, once the run is over


class _Port(Protocol):
    """What a bus of this rig offers (harness.can_plugin.EmulatedBus)."""

    def subscribe(self, on_frame: "FrameListener") -> "Registration": ...
    def transmit(self, frame: bytes) -> None: ...


@final
class VirtualRuntime:
    """The Runtime of a rig in virtual time. The thread that makes it is the first party.

    A switch between parties costs some 15 us, an event with one party waiting no switch at all.
    """

    def __init__(self, queue: EventQueue, pace: Callable[[int], None] | None = None) -> None:
        self.queue = queue
        self._pace = pace
        self._waiters: list[Waiter] = []
        first = VirtualParty("main", self)
        first.ident = threading.get_ident()
        self._parties: dict[int, VirtualParty] = {first.ident: first}
        self._spawned: list[VirtualParty] = []
        self._in_callback = self._pumping = False
        self._closing = self._interrupted = False
        self._polls = self._turns = 0
        self.on_poll: Callable[[], None] | None = None  # before one that lets no time pass
        self.whereabouts: Callable[[VirtualParty], str] = attrgetter("name")

    # --- Runtime ---------------------------------------------------------------------------

    def now_ns(self) -> int:
        """The virtual time [ns] since the rig was switched on."""
        return self.queue.now_ns

    def wait_until(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Whether `done()` became true within `timeout_s` [s]; see the rules of turn above.

        Raises:
            UsageError: in a callback, or in a thread that this runtime did not start; or nothing
                will ever happen that could end the wait, or only beyond the end of virtual time;
                or a million polls let no time pass.
        """
        return self._wait_until(done, timeout_s)

    def _wait_until(
        self, done: Callable[[], bool], timeout_s: float | None, on_parties: bool = False
    ) -> bool:
        party = self._party_here()
        self._in_callback = True
        try:
            if done():
                return True
        finally:
            self._in_callback = False
        deadline_ns = _NEVER
        if timeout_s is not None:
            if not timeout_s >= 0.0:
                raise UsageError(f"timeout_s = {timeout_s}: must be a number of seconds >= 0")
            if timeout_s == 0.0 and self.on_poll is not None:
                self.on_poll()
            deadline_ns = self.queue.now_ns + round(min(timeout_s, 1e9) * 1e9)
            if deadline_ns > _END_NS:
                raise UsageError(f"timeout_s = {timeout_s}: virtual time ends at {_END_NS / 1e9} s")
            if deadline_ns == self.queue.now_ns:
                self._count_poll()
        waiter = Waiter(party, done, deadline_ns, on_parties)
        self._waiters.append(waiter)
        try:
            self._pump(waiter)
        except BaseException:  # an event failed, or Ctrl-C: this wait is over
            if waiter in self._waiters:
                self._waiters.remove(waiter)
            raise
        if waiter.error is not None:
            raise waiter.error
        return waiter.result

    def every(self, period_s: float, action: Callable[[], None]) -> Periodic:
        """`action` runs every `period_s` [s], first one period from now; it must not wait."""
        if not 1e-9 <= period_s <= 1e9:
            raise UsageError(f"period_s = {period_s}: must be 1e-9 to 1e9 s")
        return Periodic(self, round(period_s * 1e9), action)

    def spawn(self, name: str, function: Callable[[], None]) -> VirtualParty:
        """`function` runs as a further party, from when this one next waits."""
        self._party_here()
        party = VirtualParty(name, self)
        party.thread = PartyThread(
            target=self.run_party, args=(party, function), name=f"party {name}", daemon=True
        )
        party.thread.start()  # first: whoever has a turn must be there to take it
        self._spawned.append(party)
        self.enrol(party)
        return party

    def listen(self, bus: "can.BusABC", on_frame: "FrameListener") -> "Registration":
        """`on_frame` is told every frame on `bus`, own ones when they were transmitted."""
        return _port_of(bus).subscribe(on_frame)

    def send(self, bus: "can.BusABC", frame: bytes) -> None:
        """The can_frame (16 bytes) waits its turn on `bus`."""
        transmit = getattr(bus, "transmit", None)
        if transmit is None:
            transmit = _port_of(bus).transmit
        transmit(frame)

    # --- a program's own threads (harness.virtual_program) ------------------------------------

    def party_of_thread(self) -> VirtualParty | None:
        """The party that this thread is; None if it is none."""
        return self._parties.get(threading.get_ident())

    def is_in_callback(self) -> bool:
        """Whether an event's action runs: no wait is possible."""
        return self._in_callback

    def wait_for_parties(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """As `wait_until`, for what another party has to do: if none can, that is told."""
        return self._wait_until(done, timeout_s, on_parties=True)

    def enrol(self, party: VirtualParty) -> None:
        """The party has a turn from when this one next waits; its thread is in `run_party`."""
        self._waiters.append(Waiter(party, _at_once, _NEVER))

    def abandon(self, party: VirtualParty) -> None:
        """The party has no turn any more, ever."""
        self._waiters = [waiter for waiter in self._waiters if waiter.party is not party]

    def run_party(self, party: VirtualParty, function: Callable[[], None]) -> None:
        """`function` has run in this thread, as the party, once that had its turn."""
        party.ident = threading.get_ident()
        self._parties[party.ident] = party
        party.baton.acquire()
        try:
            if not (self._closing or party.is_ending):
                function()
        except Cancelled:
            pass
        except BaseException as error:  # it is the joiner's, or close()'s, to raise
            party.error = error
        finally:
            party.finished = True
            del self._parties[party.ident]
        if not self._closing:
            self._leave(party)

    # --- the rig's side --------------------------------------------------------------------

    def run_for(self, duration_s: float) -> None:
        """`duration_s` [s] have passed."""
        self.wait_until(_never, duration_s)

    def interrupt(self) -> bool:
        """Whether the first party gets a KeyboardInterrupt after this event; for signal handlers.

        False: no event runs just now, or that was asked before.
        """
        if not self._pumping or self._interrupted:
            return False
        self._interrupted = True
        return True

    def end(self, party: VirtualParty) -> None:
        """The party ends in the wait that it is in, as all do when the run is over."""
        party.is_ending = True
        for waiter in self._waiters:
            if waiter.party is party:
                waiter.done, waiter.error = _at_once, Cancelled()

    def close(self) -> None:
        """Parties that still wait have ended; raises what a party raised and nobody joined."""
        self._closing = True
        me = self._parties.get(threading.get_ident())
        while self._waiters:
            waiter = self._waiters.pop(0)
            if waiter.party is me:
                continue
            waiter.error = Cancelled()
            waiter.party.baton.release()
            thread = waiter.party.thread
            if thread is not None:
                thread.join(GRACE_S)
            if thread is not None and thread.is_alive():
                raise UsageError(
                    f"party {waiter.party.name!r} does not end with the run: it works on, or "
                    "catches what ends it; catch Exception, never BaseException"
                )
        for party in self._spawned:
            if party.error is not None and not party.joined:
                raise party.error

    # --- turns -----------------------------------------------------------------------------

    def _party_here(self) -> VirtualParty:
        if self._in_callback:
            raise UsageError(
                "waiting inside a callback: time stands still until the callback returns; "
                "set a flag there and wait for it outside, or start a party with runtime.spawn"
            )
        party = self._parties.get(threading.get_ident())
        if self._closing and party is not None and party.thread is not None:
            raise Cancelled
        if party is None:
            raise UsageError(
                f"thread {threading.current_thread().name!r} was not started by this runtime and "
                "has no turn in virtual time; start it with runtime.spawn(name, function)"
            )
        return party

    def _count_poll(self) -> None:
        self._polls += 1
        if self._polls > _POLLS_MAX:
            self._polls = 0
            raise UsageError(
                f"{_POLLS_MAX} polls with timeout 0 in a row at t = {self.queue.now_ns / 1e9} s: "
                "time passes only while waiting; give the wait a timeout"
            )

    def _expired(self) -> Waiter | None:
        now_ns = self.queue.now_ns
        for waiter in self._waiters:
            if _NEVER != waiter.deadline_ns <= now_ns:
                return waiter
        return None

    def _pump(self, mine: Waiter | None) -> None:
        """Events run until it is the turn of `mine` (None: until anybody has the baton)."""
        self._pumping = True
        try:
            self._in_callback = True
            try:
                ready = self._run_to_next_turn(self._first_deadline_ns())
            finally:
                self._in_callback = False
            self._waiters.remove(ready)
            if ready is not mine:
                ready.party.baton.release()
        finally:
            self._pumping = False
        if ready is not mine and mine is not None:
            self._await_baton(mine)

    def _first_deadline_ns(self) -> int:
        deadline_ns = _NEVER
        for waiter in self._waiters:
            if waiter.deadline_ns != _NEVER and not 0 <= deadline_ns <= waiter.deadline_ns:
                deadline_ns = waiter.deadline_ns
        return deadline_ns

    def _run_to_next_turn(self, deadline_ns: int) -> Waiter:
        """Events have run until somebody can go on; nobody's time is up before `deadline_ns`."""
        queue = self.queue
        stuck_ns = queue.now_ns + _STUCK_NS
        while True:
            self._turns += 1
            if self._turns % _LOOK_UP_TURNS == 0:
                threading.current_thread()  # interpreted: there, handlers of signals run
            if self._interrupted:
                self._interrupted = False
                for waiter in self._waiters:
                    if waiter.party.thread is None:
                        waiter.done, waiter.error = _at_once, KeyboardInterrupt()
            for waiter in self._waiters:  # whoever asked first; the answer is in the waiter
                try:
                    if waiter.done():
                        waiter.result = True
                        return waiter
                except Exception as error:
                    waiter.error = error
                    return waiter
            next_ns = queue.next_ns()
            now_ns = queue.now_ns
            if _NEVER != deadline_ns <= now_ns != next_ns:
                expired = self._expired()
                if expired is not None:
                    return expired
            is_event = next_ns != UNSET and (deadline_ns == _NEVER or next_ns <= deadline_ns)
            if not is_event and deadline_ns == _NEVER:
                self._nothing_will_happen("no event is due in the whole rig")
                continue
            due_ns = next_ns if is_event else deadline_ns
            if due_ns > stuck_ns and all(waiter.on_parties for waiter in self._waiters):
                if deadline_ns == _NEVER:
                    self._nothing_will_happen("all wait for one another, since an hour")
                    continue
                stuck_ns = _END_NS
            if due_ns > now_ns or not is_event:
                self._polls = 0
            if self._pace is not None:
                self._pumping = False  # asleep: an interrupt counts at once
                self._pace(due_ns)
                self._pumping = True
            if is_event:
                queue.run_next()
            else:
                queue.run_until(due_ns)

    def _await_baton(self, mine: Waiter) -> None:
        try:
            # Not for ever: a signal that comes just before the wait is looked at only after it.
            while not mine.party.baton.acquire(timeout=GRACE_S):
                threading.current_thread()  # as in _run_to_next_turn: there, handlers run
        except KeyboardInterrupt as interrupt:
            # Another party runs just now: take the turn at its next wait, never beside it.
            mine.done, mine.error = _at_once, interrupt
            if not mine.party.baton.acquire(timeout=GRACE_S):
                self._closing = True  # it does not wait: it is over when it does
                raise

    def _nothing_will_happen(self, why: str) -> None:
        names = ", ".join(self.whereabouts(waiter.party) for waiter in self._waiters)
        for waiter in self._waiters:
            waiter.done = _at_once
            waiter.error = UsageError(
                f"party {waiter.party.name!r} waits without a timeout for what can never happen: "
                f"{why} (waiting: {names}); give the wait a timeout"
            )

    def _leave(self, party: VirtualParty) -> None:
        """The baton goes on to whoever is next; this thread runs events until there is one."""
        try:
            if self._waiters:
                self._pump(None)
        except BaseException as error:  # an event failed: tell whoever waits longest
            waiter = self._waiters.pop(0)
            waiter.error = error
            waiter.party.baton.release()


def _at_once() -> bool:
    return True


def _never() -> bool:
    return False


def _port_of(bus: "can.BusABC") -> _Port:
    if hasattr(bus, "subscribe") and hasattr(bus, "transmit"):
        port: _Port = bus
        return port
    raise UsageError(
        f"{bus!r} is not a bus of this rig: virtual time reaches only emulated buses; "
        "use rig.bus(name), or motorapi's WallRuntime on a real bus"
    )
