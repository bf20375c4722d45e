"""Virtual time: one event queue, and parties that take turns.

Time passes only while parties wait. A waiting party runs the world's events one by one, in the
order (time, order of scheduling). It stops when the condition of some party holds or its timeout
expires. Then that party continues, and all others stand still. So ordinary blocking code is
deterministic.

The rules of turn:
    1. At any moment exactly one thread runs: the party that has the baton.
    2. The baton changes hands only in `wait_until`, and when a party ends.
    3. Of several waiting parties that could continue at one time, the one that waits longest does;
       in an interleaved world the first one in an order that is drawn.
    4. Events at the very time of a timeout still count: events first, then the timeout.

With `pace`, the wall clock is a brake: the same events happen in the same order, but none earlier
than its wall time. A pace may schedule events of its own while it brakes (`Pace`).
"""

import threading
from _thread import LockType, allocate_lock  # the real one, never the replacement for programs
from collections.abc import Callable
from operator import attrgetter
from time import (  # real ones, too: calls of compiled code look like its caller's
    monotonic_ns,
    sleep,
)
from typing import TYPE_CHECKING, Final, Protocol, final

from motorhil.emulators.simulation.event_queue import UNSET, Alarm, EventQueue
from motorhil.motorapi.bus_context import BusContext
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.runtime.can_sources import CAN_FRAME_BYTES, require_fd

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.runtime.api import FrameListener, Registration

Pace = Callable[[int], bool | None]
"""Waits until the next event, or the end of the next timeout, is due [ns].

True: look again, because an event was scheduled before it, or a wait may have ended.
"""
UNKNOWN: Final = 0
_NEVER: Final = -1
END_NS: Final = 2 * 10**18  # 63 years: controllers treat later times (2**61 ns) as never
_STUCK_NS: Final = 3600 * 10**9  # limit for parties that wait only for one another
_POLLS_MAX: Final = 1_000_000
_SIGNAL_TURNS: Final = 256  # compiled code must check for signals now and then
_TURNS_MAX: Final = 1 << 18  # at one instant, without polls
GRACE_S: Final = 1.0  # wall time for a party to reach its next wait, or to end


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
        self.party: VirtualParty = party
        self.done: Callable[[], bool] = done
        self.deadline_ns: int = deadline_ns
        self.on_parties: bool = on_parties  # it waits for other parties, not for frames
        self.result: bool = False
        self.error: BaseException | None = None


@final
class VirtualParty:
    """One thread of execution of the application, in virtual time.

    Attributes:
        name: as given to `spawn`.
        error: the exception of the function once it has ended, else None.
        is_ending: True once it has been asked to end.
        is_first: True for the first party of a program, in which Ctrl-C is raised.
        thread: its thread; None for the first party.
        ident: thread identifier, as in threading.get_ident(); UNKNOWN before it runs.
        take_turn: runs its turn, if it is a party of another process; None in this one.
        looked_ns, owed_ns, read_ns: time of its last clock reading, cost of its readings then,
            and the clock value returned [ns].
        held_up_by: the party that holds the lock it waits for.
        is_waiting: True in `wait_until`.
        calls: signal handlers that run at the end of its wait.
    """

    def __init__(self, name: str, runtime: "VirtualRuntime") -> None:
        self.name = name
        self.error: BaseException | None = None
        self.finished = False
        self.is_ending = False
        self.is_first = False
        self.joined: bool = False
        self.baton: LockType = allocate_lock()
        self.baton.acquire()
        self.thread: threading.Thread | None = None
        self.ident = UNKNOWN
        self.held_up_by: VirtualParty | None = None
        self.take_turn: Callable[[Waiter], None] | None = None
        self.looked_ns = self.owed_ns = self.read_ns = 0
        self.is_waiting = False
        self.calls: list[Callable[[], None]] = []
        self._runtime = runtime

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait up to `timeout_s` [s]; return True if it has ended. Its exception is in `error`."""
        self.joined = True
        return self._runtime.wait_until(self.has_finished, timeout_s)

    def has_finished(self) -> bool:
        """Return True if it has ended."""
        return self.finished

    def owes_error(self) -> bool:
        """Return True if it raised an exception that no `join` has seen."""
        return self.error is not None and not self.joined


PartyThread: Final[type[threading.Thread]] = type("PartyThread", (threading.Thread,), {})
"""The thread of a party that `spawn` started.

No class statement: a compiled class keeps its own fields where Thread keeps its weak references.
"""


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


class _Port(Protocol):
    """Interface of a bus of this rig (EmulatedBus)."""

    def subscribe(self, on_frame: "FrameListener", fd: bool = False) -> "Registration": ...
    def transmit(self, frame: bytes) -> None: ...


class VirtualRuntime:
    """The Runtime of a rig in virtual time. The thread that creates it is the first party.

    `_run_to_next_turn` lets time pass; a runtime whose rig is in another process overrides it.

    A switch between parties costs about 15 us. An event with one waiting party costs no switch.
    """

    def __init__(self, queue: EventQueue, pace: Pace | None = None) -> None:
        self.queue = queue
        self.context: Final = BusContext()  # compiled classes have no weak references
        self._pace = pace
        self._waiters: list[Waiter] = []
        self._draw: Callable[[int], int] | None = None
        first = VirtualParty("main", self)
        first.is_first = True
        first.ident = threading.get_ident()
        self._parties: dict[int, VirtualParty] = {first.ident: first}
        self._spawned: list[VirtualParty] = []
        self._in_callback = self._pumping = False
        self._closing = self._interrupted = False
        self._polls = self._turns = 0
        self._instant_ns = self._turns_before = 0  # as seen at the last check for signals
        self._had_parties = False
        self.on_poll: Callable[[], None] | None = None  # called before polls
        self.on_yield: Callable[[], None] | None = None  # called before a party gives up its turn
        self.whereabouts: Callable[[VirtualParty], str] = attrgetter("name")

    # --- Runtime ---------------------------------------------------------------------------

    def now_ns(self) -> int:
        """Return the virtual time [ns] since the rig was switched on."""
        return self.queue.now_ns

    def wait_until(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait up to `timeout_s` [s] for `done()`, by the rules of turn; return True if it held.

        Raises:
            UsageError: called in a callback, or in a thread that this runtime did not start; or no
                event
                can ever end the wait, or only after the end of virtual time; or a million polls let
                no
                time pass.
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
            if deadline_ns > END_NS:
                raise UsageError(f"timeout_s = {timeout_s}: virtual time ends at {END_NS / 1e9} s")
            if deadline_ns == self.queue.now_ns:
                self._count_poll()
        while True:
            if self.on_yield is not None:
                self.on_yield()
            waiter = Waiter(party, done, deadline_ns, on_parties)
            self._line_up(waiter)
            party.is_waiting = True
            try:
                self._pump(waiter)
            except BaseException:  # an event failed, or Ctrl-C: this wait is over
                if waiter in self._waiters:
                    self._waiters.remove(waiter)
                raise
            finally:
                party.is_waiting = False
            if waiter.error is not None:
                raise waiter.error
            while party.calls:
                party.calls.pop(0)()
            if waiter.done is not _signalled:
                return waiter.result

    def every(self, period_s: float, action: Callable[[], None]) -> "Registration":
        """Call `action` every `period_s` [s], first after one period; it must not wait."""
        if not 1e-9 <= period_s <= 1e9:
            raise UsageError(f"period_s = {period_s}: must be 1e-9 to 1e9 s")
        return Periodic(self, round(period_s * 1e9), action)

    def spawn(self, name: str, function: Callable[[], None]) -> VirtualParty:
        """Run `function` as a further party, from the next wait of this one on."""
        self._party_here()
        party = VirtualParty(name, self)
        party.thread = PartyThread(
            target=self.run_party, args=(party, function), name=f"party {name}", daemon=True
        )
        party.thread.start()  # first, so that its thread exists when it gets a turn
        self._spawned = [one for one in self._spawned if not one.finished or one.owes_error()]
        self._spawned.append(party)
        self.enrol(party)
        return party

    def listen(
        self, bus: "can.BusABC", on_frame: "FrameListener", *, fd: bool = False
    ) -> "Registration":
        """Call `on_frame` for every frame on `bus`; own frames count when they were transmitted.

        Raises:
            UsageError: fd=True, and the bus object was opened for classical CAN.
        """
        port = _port_of(bus)
        if not fd:
            return port.subscribe(on_frame)
        require_fd(bus)
        return port.subscribe(on_frame, fd=True)

    def send(self, bus: "can.BusABC", frame: bytes) -> None:
        """Queue the can_frame or canfd_frame for transmission on `bus`.

        Raises:
            UsageError: a canfd_frame, and the bus object was opened for classical CAN.
        """
        if len(frame) != CAN_FRAME_BYTES:
            require_fd(bus)
        transmit = getattr(bus, "transmit", None)
        if transmit is None:
            transmit = _port_of(bus).transmit
        transmit(frame)

    # --- a program's own threads -----------------------------------------------------------------

    def party_of_thread(self) -> VirtualParty | None:
        """Return the party of this thread, or None."""
        return self._parties.get(threading.get_ident())

    def is_in_callback(self) -> bool:
        """Return True while an event's action runs, in which waiting is not possible."""
        return self._in_callback

    def wait_for_parties(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait as `wait_until` does, but for another party; raise if no party can act."""
        return self._wait_until(done, timeout_s, on_parties=True)

    def enrol(self, party: VirtualParty) -> None:
        """Give the party a turn at the next wait of this one; its thread is in `run_party`."""
        self._had_parties = True
        self._line_up(Waiter(party, _at_once, _NEVER))

    def wait_elsewhere(
        self, party: VirtualParty, done: Callable[[], bool], deadline_ns: int, on_parties: bool
    ) -> Waiter:
        """Let a party of another process wait for its turn, which is `party.take_turn`.

        `deadline_ns` is -1 without a timeout. Returns the wait, which `take_turn` is called with.
        """
        self._had_parties = True
        waiter = Waiter(party, done, deadline_ns, on_parties)
        self._line_up(waiter)
        return waiter

    def withdraw(self, waiter: Waiter) -> None:
        """End a wait of `wait_elsewhere` without a turn."""
        if waiter in self._waiters:
            self._waiters.remove(waiter)

    def abandon(self, party: VirtualParty) -> None:
        """Remove the party's turn for good."""
        self._waiters = [waiter for waiter in self._waiters if waiter.party is not party]

    def run_party(self, party: VirtualParty, function: Callable[[], None]) -> None:
        """Run `function` in this thread as the party, once it has its turn."""
        party.ident = threading.get_ident()
        self._parties[party.ident] = party
        party.baton.acquire()
        try:
            if not (self._closing or party.is_ending):
                function()
        except Cancelled:
            pass
        except BaseException as error:  # raised by join() or close()
            party.error = error
        finally:
            party.finished = True
            del self._parties[party.ident]
        if not self._closing:
            self._leave(party)

    # --- the rig's side --------------------------------------------------------------------

    def run_for(self, duration_s: float) -> None:
        """Let `duration_s` [s] pass."""
        self.wait_until(never, duration_s)

    def interrupt(self) -> bool:
        """Raise KeyboardInterrupt in the first party after this event; for signal handlers.

        Returns:
            True if that will happen; False if no event is running, or it was requested before.
        """
        if not self._pumping or self._interrupted:
            return False
        self._interrupted = True
        return True

    def is_interrupted(self) -> bool:
        """Return True from `interrupt` until the first party has been told."""
        return self._interrupted

    def waits(self) -> list[tuple[str, int | None]]:
        """Return who waits, the longest first, and until when [ns]; None without a timeout."""
        return [
            (self.whereabouts(one.party), None if one.deadline_ns == _NEVER else one.deadline_ns)
            for one in self._waiters
        ]

    def call_in_turn(self, handler: Callable[[], None]) -> bool:
        """Call a signal handler in the next turn of this thread's party, whose wait continues then.

        Returns:
            False if the party does not wait, or there is none: nothing was done.
        """
        party = self._parties.get(threading.get_ident())
        if party is None or not party.is_waiting:
            return False
        party.calls.append(handler)
        for waiter in self._waiters:
            if waiter.party is party and waiter.error is None:
                waiter.done = _signalled
        return True

    def progress(self) -> tuple[int, int]:
        """Return the time [ns] and a count of turns: equal twice, nothing has happened between."""
        return self.queue.now_ns, self._turns

    def running(self) -> VirtualParty | None:
        """Return the party that runs its own code; None while the world runs, or all wait."""
        if self._pumping:
            return None
        waiting = [waiter.party for waiter in self._waiters]
        running = [party for party in list(self._parties.values()) if party not in waiting]
        return running[0] if running else None

    def end(self, party: VirtualParty) -> None:
        """End the party in its present wait, as all parties end when the run is over."""
        party.is_ending = True
        for waiter in self._waiters:
            if waiter.party is party:
                waiter.done, waiter.error = _at_once, Cancelled()

    def close(self) -> None:
        """End all waiting parties; raise the error of a party that was not joined."""
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
                    f"party {waiter.party.name!r} does not end with the run: it does not wait, "
                    "or catches the exception that ends it; catch Exception, never "
                    "BaseException"
                )
        for party in self._spawned:
            if party.error is not None and party.owes_error():
                raise party.error

    def follow(self, pace: Pace) -> None:
        """Follow this pace from the next event on."""
        self._pace = pace

    def had_parties(self) -> bool:
        """Return True if a second party has ever been given turns."""
        return self._had_parties

    def interleave(self, draw: Callable[[int], int]) -> None:
        """Draw the order of waiting parties from now on; `draw(n)` returns 0 to n - 1."""
        self._draw = draw

    # --- turns -----------------------------------------------------------------------------

    def _line_up(self, waiter: Waiter) -> None:
        """Add a wait behind all others, or at a drawn place among them."""
        if self._draw is None or not self._waiters:
            self._waiters.append(waiter)
        else:
            self._waiters.insert(self._draw(len(self._waiters) + 1), waiter)

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
        """Run events until it is the turn of `mine` (None: of any party)."""
        self._pumping = True
        try:
            while True:
                self._in_callback = True
                try:
                    ready = self._run_to_next_turn(self._first_deadline_ns())
                finally:
                    self._in_callback = False
                self._waiters.remove(ready)
                turn = ready.party.take_turn
                if turn is None:
                    break
                turn(ready)
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

    def _run_to_next_turn(self, deadline_ns: int) -> Waiter:  # noqa: C901 -- hot loop: every event passes here
        """Run events until a party can continue; no timeout expires before `deadline_ns`."""
        queue = self.queue
        stuck_ns = queue.now_ns + _STUCK_NS
        while True:
            self._turns += 1
            if self._turns % _SIGNAL_TURNS == 0:
                threading.current_thread()  # interpreted code: signal handlers run there
                if queue.now_ns != self._instant_ns:
                    self._instant_ns, self._turns_before = queue.now_ns, self._turns
                elif self._turns - self._turns_before > _TURNS_MAX + self._polls:
                    self._end_chain()
            if self._interrupted:
                self._interrupted = False
                for waiter in self._waiters:
                    if waiter.party.is_first:
                        waiter.done, waiter.error = _at_once, KeyboardInterrupt()
            for waiter in self._waiters:  # in the order of their waits; the result is in the waiter
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
                    self._nothing_will_happen("all parties have waited for one another for an hour")
                    continue
                stuck_ns = END_NS
            if due_ns > now_ns or not is_event:
                self._polls = 0
            if self._pace is not None:
                self._pumping = False  # while asleep, an interrupt takes effect at once
                is_early = self._pace(due_ns)
                self._pumping = True
                if is_early:
                    self._turns -= 1  # time may stand still for days
                    continue
            if is_event:
                queue.run_next()
            else:
                queue.run_until(due_ns)

    def _await_baton(self, mine: Waiter) -> None:
        try:
            # Not without a timeout: a signal just before the wait would be handled only after it.
            while not mine.party.baton.acquire(timeout=GRACE_S):
                threading.current_thread()  # as in _run_to_next_turn: signal handlers run there
        except KeyboardInterrupt as interrupt:
            # Another party is running: take the turn at its next wait, never in parallel.
            mine.done, mine.error = _at_once, interrupt
            if not mine.party.baton.acquire(timeout=GRACE_S):
                self._closing = True  # it does not wait; it ends at its next wait
                raise

    def _nothing_will_happen(self, why: str) -> None:
        names = ", ".join(self.whereabouts(waiter.party) for waiter in self._waiters)
        for waiter in self._waiters:
            waiter.done = _at_once
            waiter.error = UsageError(
                f"party {waiter.party.name!r} waits without a timeout, but nothing can end the "
                f"wait: {why} (waiting: {names}); give the wait a timeout"
            )

    def _end_chain(self) -> None:
        """End all waits, since events or parties follow one another while no time passes."""
        queue = self.queue
        now_ns, self._turns_before = queue.now_ns, self._turns
        first = queue.first if queue.next_ns() == now_ns else None
        if first is None:
            what = "parties " + ", ".join(self.whereabouts(one.party) for one in self._waiters)
        else:
            what = f"callback {_name_of(first.action)}"
        for waiter in self._waiters:
            waiter.done = _at_once
            waiter.error = UsageError(
                f"{what}: {_TURNS_MAX} turns at t = {now_ns / 1e9} s, and no time passes; expected "
                "an end of the chain; let a delay pass before the next call"
            )

    def _leave(self, party: VirtualParty) -> None:
        """Pass the baton on to the next party; run events until there is one."""
        try:
            if self.on_yield is not None:
                self.on_yield()
            if self._waiters:
                self._pump(None)
        except BaseException as error:  # an event failed: raise it in the longest-waiting party
            waiter = self._waiters.pop(0)
            waiter.error = error
            waiter.party.baton.release()


def _name_of(action: Callable[[int], None]) -> str:
    """Return the name of a function or method, with its module."""
    names = [getattr(action, name, "") for name in ("__module__", "__qualname__")]
    return ".".join([name for name in names if name]) or repr(action)


def _at_once() -> bool:
    return True


def _signalled() -> bool:
    return True


def never() -> bool:
    """Return False: the condition of a wait that only time ends."""
    return False


def _port_of(bus: "can.BusABC") -> _Port:
    if hasattr(bus, "subscribe") and hasattr(bus, "transmit"):
        port: _Port = bus
        return port
    raise UsageError(
        f"{bus!r} is not a bus of this rig: virtual time reaches only emulated buses; "
        "use rig.bus(name), or motorapi's WallRuntime on a real bus"
    )


@final
class WallPace:
    """A callable that returns when wall time has reached the next event's time [ns].

    Time 0 is the first call. Late events are neither delayed further nor skipped.

    Attributes:
        late_ns_max: largest lateness of an event so far [ns].
    """

    def __init__(self, speed: float = 1.0) -> None:
        """Let `speed` seconds of the rig pass in one second of wall time."""
        self._speed: float = speed
        self._start_ns: int | None = None
        self.late_ns_max: int = 0

    def __call__(self, due_ns: int) -> None:
        """Sleep until wall time has reached `due_ns`."""
        now_ns = monotonic_ns()
        if self._start_ns is None:
            self._start_ns = now_ns
        wall_ns = due_ns if self._speed == 1.0 else int(due_ns / self._speed)
        left_ns = self._start_ns + wall_ns - now_ns
        if left_ns > 0:
            sleep(left_ns / 1e9)
        else:
            self.late_ns_max = max(self.late_ns_max, -left_ns)
