"""Threads as parties, which start, join and end in virtual time."""

import sys
import threading
import weakref
from _thread import start_new_thread as _start_new_thread
from collections.abc import Callable, Mapping
from concurrent.futures import thread as executors
from functools import partial
from threading import Event, Thread
from types import MappingProxyType
from typing import Any, Final

from harness.parties import Cancelled, PartyThread, VirtualParty
from harness.virtual_program.turn import (
    Program,
    caller_is_outside,
    on_wall,
    party_here,
    program_here,
)

_ROUNDS: Final = 3  # attempts to end a thread that continues
_GRACE_S: Final = 10.0  # in the rig's time, for each attempt
_parties: "weakref.WeakKeyDictionary[Thread, VirtualParty]" = weakref.WeakKeyDictionary()
_start = Thread.start
_join = Thread.join
_is_alive = Thread.is_alive
_is_set = Event.is_set
_enumerate = threading.enumerate


def start(thread: Thread) -> None:
    """Start a thread as a party, which runs when the current party next waits.

    Threads of our own packages are started on the wall clock: they wait for it, or are parties
    already.
    """
    program = program_here()
    if program is None or thread in _parties:
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
    _parties[thread] = party
    program.add(party)


def join_executors() -> None:
    """Finish the work of all thread pools and end their threads, as Python does at exit."""
    with executors._global_shutdown_lock:  # noqa: SLF001 -- what Python's own end does
        executors._shutdown = True  # noqa: SLF001
    try:
        for thread, queue in list(executors._threads_queues.items()):  # noqa: SLF001
            party = _parties.get(thread)
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
    program, party, me = program_here(), _parties.get(thread), party_here()
    if program is None or party is None or me is None or party is me:
        _join(thread, timeout)  # raises if a thread joins itself
        return
    left_s = None if timeout is None else program.from_now_s(me, max(timeout, 0.0))
    if program.runtime.wait_for_parties(party.has_finished, left_s):
        with on_wall():  # the thread needs no more turns
            _join(thread)


def is_alive(thread: Thread) -> bool:
    """Return whether the thread has begun and not ended."""
    program, party, me = program_here(), _parties.get(thread), party_here()
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
    party = _parties.get(thread)
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
