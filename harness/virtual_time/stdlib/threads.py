"""Threads and locks in virtual time: each thread is a party.

A lock waits in virtual time if one party waits for another, otherwise in wall time. All other
synchronization objects (conditions, events, semaphores, barriers, queues, futures) are the standard
library's own, built from these two locks. Polling a clock costs a party a little virtual time, so
that polling loops make progress.

All stand-ins for the standard library call `party_here` first. A thread that is not a party (a test
runner's, a C library's) gets the wall clocks and plain locks. So do callers from the packages in
`OUTSIDE`: this project's own, and those that run and measure tests.
"""

import sys
import threading
from _thread import LockType, get_ident
from _thread import allocate_lock as _allocate_lock
from _thread import start_new_thread as _start_new_thread
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import thread as executors
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from threading import TIMEOUT_MAX, Event, Thread, current_thread
from types import MappingProxyType, TracebackType
from typing import Any, Final, Protocol, final

from motorhil.harness.virtual_time.runtime import (
    Cancelled,
    PartyThread,
    VirtualParty,
    VirtualRuntime,
)
from motorhil.motorapi.errors import UsageError

OUTSIDE: Final = frozenset(
    {
        "motorhil",
        *("_pytest", "pytest", "pytest_timeout", "pluggy", "xdist", "execnet", "hypothesis"),
        *("coverage", "subprocess"),
    }
)
_LOOK_NS: Final = 1_000
_SPIN_LOOK_NS: Final = 10_000
_BILL_NS: Final = 1_000_000
_SPIN_BILLS: Final = 10
_REPORTED_BILLS: Final = 1_000
_FOR_EVER: Final = -1
_ROUNDS: Final = 3  # attempts to end a thread that continues
_GRACE_S: Final = 10.0  # in the rig's time, for each attempt


class ChildClock(Protocol):
    """The clock that the children of a program join."""

    def invite(self, environment: Mapping[str, str]) -> dict[str, str]:
        """Return this environment with what the next child needs to join."""

    def admit(self, pid: int) -> str:
        """Wait until that child has joined; return "", or why it has not."""

    def has_relatives(self) -> bool:
        """Return whether a child has joined, or this program is one."""

    def watching(self) -> AbstractContextManager[None]:
        """Let waits of this party look again after each turn of another process."""


@final
class Program:
    """A program in virtual time: its runtime, and the lead of its clocks.

    A look at a clock, an event or a taken lock advances the clock by 1 us, and lets no time pass.
    At its thousandth look a party waits until time has caught up. So a program that polls until
    something changes makes progress, and other parties have their turns meanwhile.
    """

    def __init__(self, runtime: VirtualRuntime, children: ChildClock | None = None) -> None:
        self.runtime = runtime
        self.children = children
        self.ahead_ns: int = 0  # the last value of a clock
        self.parties: list[VirtualParty] = []  # running threads when the last was added
        self._bills = 0  # consecutive waits for time to catch up, with nothing in between
        self._paid_ns = -1
        self._reported: list[VirtualParty] = []

    def add(self, party: VirtualParty) -> None:
        """Add a started thread to the program."""
        self.parties = [other for other in self.parties if not other.finished]
        self.parties.append(party)
        self.runtime.enrol(party)

    def look(self, party: VirtualParty) -> int:
        """Return the value of a clock [ns], a little more at each look; this may wait."""
        now_ns = self.runtime.queue.now_ns
        step_ns = _LOOK_NS if self._bills < _SPIN_BILLS else _SPIN_LOOK_NS
        self.ahead_ns = max(now_ns, self.ahead_ns) + step_ns
        if party.looked_ns != now_ns:
            party.looked_ns, party.owed_ns = now_ns, 0
        party.owed_ns += step_ns
        party.read_ns = self.ahead_ns
        if party.owed_ns >= _BILL_NS and not self.runtime.is_in_callback():
            self._pay(party)
        return party.read_ns

    def from_now_s(self, party: VirtualParty, duration_s: float) -> float:
        """Return the wait in the rig's time [s] until `duration_s` after the party's last look."""
        return duration_s + max(0, party.read_ns - self.runtime.queue.now_ns) / 1e9

    def _pay(self, party: VirtualParty) -> None:
        queue = self.runtime.queue
        self._bills = self._bills + 1 if queue.now_ns == self._paid_ns else 0
        if self._bills >= _REPORTED_BILLS and party not in self._reported:
            self._reported.append(party)
            print(
                f"{whereabouts(party)}: polls without sleeping; each poll "
                f"takes {_SPIN_LOOK_NS / 1e3:g} us of the rig's time; add a time.sleep()",
                file=sys.stderr,
            )
        self.runtime.run_for((self.ahead_ns - queue.now_ns) / 1e9)
        self._paid_ns = queue.now_ns


@final
class _Stage:
    """The active program, and whether its parties currently use the wall clock."""

    program: Program | None = None
    is_on_wall = False


def program_here() -> Program | None:
    """Return the program of which this thread is a party, or None."""
    program = _Stage.program
    if program is None or _Stage.is_on_wall or program.runtime.party_of_thread() is None:
        return None
    return program


def party_here() -> VirtualParty | None:
    """Return the party of this thread; None if it uses the wall's clocks and locks."""
    program = _Stage.program
    if program is None or _Stage.is_on_wall:
        return None
    return program.runtime.party_of_thread()


def has_children() -> bool:
    """Return whether processes that the program here starts can join the rig."""
    program = program_here()
    return program is not None and program.children is not None


def caller_is_outside(depth: int) -> bool:
    """Return whether the function `depth` calls up belongs to the packages in `OUTSIDE`."""
    name = sys._getframe(depth).f_globals.get("__name__", "")  # noqa: SLF001 -- no other is as fast
    return isinstance(name, str) and name.partition(".")[0] in OUTSIDE


def refuse_foreign(what: str) -> None:
    """Refuse an operation of a thread that is not a party of the active program.

    Raises:
        UsageError: this thread is not a party.
    """
    program = _Stage.program
    if program is None or _Stage.is_on_wall or program.runtime.party_of_thread() is not None:
        return
    raise UsageError(
        f"thread {current_thread().name!r} cannot {what}: it was not started by Python's threading "
        "while the program ran, so it has no virtual time; start it with threading.Thread, or "
        "run the program in wall time: motorhil serve RIG -- python SCRIPT"
    )


@contextmanager
def on_wall() -> Iterator[None]:
    """Treat no thread as a party within the block; waits are short and in wall time."""
    before, _Stage.is_on_wall = _Stage.is_on_wall, True
    try:
        yield
    finally:
        _Stage.is_on_wall = before


@contextmanager
def program_on(runtime: VirtualRuntime, children: ChildClock | None = None) -> Iterator[Program]:
    """Activate a program for the parties of this runtime within the block.

    Args:
        runtime: where it waits.
        children: the clock that its child processes join; None: they run on the wall clock.

    Raises:
        UsageError: another program is active in this process.
    """
    if _Stage.program is not None:
        raise UsageError(
            "another program of this process is already in virtual time; "
            "leave its in_virtual_time first"
        )
    program = _Stage.program = Program(runtime, children)
    runtime.whereabouts, named = whereabouts, runtime.whereabouts
    runtime.on_poll = lambda: _poll(program)
    try:
        yield program
    finally:
        _Stage.program = None
        runtime.on_poll, runtime.whereabouts = None, named


def _poll(program: Program) -> None:
    party = program.runtime.party_of_thread()
    if party is not None:
        program.look(party)


def whereabouts(party: VirtualParty) -> str:
    """Return a party's name and place in its own code: "worker (robot.py:12, in Queue.get)"."""
    frame = sys._current_frames().get(party.ident)  # noqa: SLF001 -- documented, for this
    words = [party.name]
    within = ""
    while frame is not None:
        package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if package not in OUTSIDE and package not in sys.stdlib_module_names:
            words.append(f" ({frame.f_code.co_filename}:{frame.f_lineno}{within})")
            break
        if package not in OUTSIDE:
            within = f", in {frame.f_code.co_qualname}"
        frame = frame.f_back
    if party.held_up_by not in (None, party):  # a party takes a condition's lock from itself
        words.append(f", held up by {party.held_up_by.name}")
    return "".join(words)


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
        return f"<{state} Lock in virtual time at {id(self):#x}>"


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
        return f"<RLock in virtual time, held {self._count} times, at {id(self):#x}>"


_PARTY: Final = "_motorhil_party"  # on the thread: both go together
_start = Thread.start
_join = Thread.join
_is_alive = Thread.is_alive
_is_set = Event.is_set
_enumerate = threading.enumerate


def _party_of(thread: Thread) -> VirtualParty | None:
    party: VirtualParty | None = vars(thread).get(_PARTY)
    return party


def start(thread: Thread) -> None:
    """Start a thread as a party, which runs when the current party next waits.

    Threads of our own packages are started on the wall clock: they wait for it, or are parties
    already.
    """
    program = program_here()
    if program is None or _party_of(thread) is not None:
        _start(thread)  # raises for a second start
        return
    if isinstance(thread, PartyThread) or caller_is_outside(2):
        with on_wall():
            _start(thread)
        return
    _start_party(program, thread)


def _start_party(program: Program, thread: Thread) -> None:
    party = VirtualParty(thread.name, program.runtime)
    party.thread = thread
    run = thread.run
    work = partial(_run, thread, party, run)
    vars(thread)["run"] = partial(program.runtime.run_party, party, work)
    try:
        with on_wall():  # until the thread waits for its first turn
            _start(thread)
    except BaseException:
        del vars(thread)["run"]
        raise
    vars(thread)[_PARTY] = party
    program.add(party)


def join_executors() -> None:
    """Finish the work of all thread pools and end their threads, as Python does at exit."""
    with executors._global_shutdown_lock:  # noqa: SLF001 -- what Python's own end does
        executors._shutdown = True  # noqa: SLF001
    try:
        for thread, queue in list(executors._threads_queues.items()):  # noqa: SLF001
            party = _party_of(thread)
            if party is not None and not party.finished:
                queue.put(None)
                thread.join()
    finally:
        executors._shutdown = False  # noqa: SLF001


def end_threads(program: Program) -> None:
    """End the remaining threads in their current wait, or give them no more turns.

    Their `finally` blocks have some seconds of the rig's time. Python does not grant this to
    daemons.
    """
    runtime = program.runtime
    for _ in range(_ROUNDS):
        left = [party for party in program.parties if not party.finished]
        for party in left:
            runtime.end(party)
        if not left or runtime.wait_until(_all_of(left), _GRACE_S):
            return
    for party in program.parties:
        runtime.abandon(party)


def _all_of(parties: list[VirtualParty]) -> Callable[[], bool]:
    return lambda: all(party.finished for party in parties)


def _run(thread: Thread, party: VirtualParty, run: Callable[[], None]) -> None:
    """Run the thread; report its exception as Python does, before the next party's turn."""
    try:
        run()
    except (SystemExit, Cancelled):
        pass
    except BaseException:
        if not party.is_ending:
            kind, error, trace = sys.exc_info()
            threading.excepthook(threading.ExceptHookArgs((kind, error, trace, thread)))


def join(thread: Thread, timeout: float | None = None) -> None:
    """Wait until the thread has ended, or for `timeout` [s] of the rig's time."""
    program, party, me = program_here(), _party_of(thread), party_here()
    if program is None or party is None or me is None or party is me:
        _join(thread, timeout)  # raises if a thread joins itself
        return
    left_s = None if timeout is None else program.from_now_s(me, max(timeout, 0.0))
    if program.runtime.wait_for_parties(party.has_finished, left_s):
        with on_wall():  # the thread needs no more turns
            _join(thread)


def is_alive(thread: Thread) -> bool:
    """Return whether the thread has begun and not ended."""
    program, party, me = program_here(), _party_of(thread), party_here()
    if program is None or party is None or me is None:
        return _is_alive(thread)
    program.look(me)
    return not party.finished


def is_set(event: Event) -> bool:
    """Return whether the event is set."""
    answer = _is_set(event)
    if not answer:
        program, party = program_here(), party_here()
        if program is not None and party is not None:
            program.look(party)
    return answer


def enumerate_threads() -> list[Thread]:
    """Return the running threads, without those that are only leaving the operating system."""
    return [thread for thread in _enumerate() if not _has_finished(thread)]


def active_count() -> int:
    """Return the number of running threads."""
    return len(enumerate_threads())


def _has_finished(thread: Thread) -> bool:
    party = _party_of(thread)
    return party is not None and party.finished


def start_new_thread(
    function: Callable[..., object],
    args: tuple[Any, ...],
    kwargs: Mapping[str, Any] = MappingProxyType({}),
    /,
) -> int:
    """Stand in for _thread.start_new_thread by a daemon thread."""
    program = program_here()
    if program is None:
        return _start_new_thread(function, args, dict(kwargs))
    thread = Thread(target=function, args=args, kwargs=kwargs, daemon=True)
    _start_party(program, thread)
    assert thread.ident is not None
    return thread.ident
