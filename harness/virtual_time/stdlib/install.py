"""Unmodified programs for hardware, run in a rig's virtual time.

    with Rig.open("rig.toml") as rig, in_virtual_time(rig):
        main_of_the_program()

Inside the block `time`, `threading`, `queue`, `sched` and thread pools use the rig's clock. Each
thread is a party, which runs while the others wait. Every name in every module that is bound to an
original is rebound, whenever the module was imported: `time.sleep`, and `sleep` in a module with
`from time import sleep`. Modules of the packages in `OUTSIDE` keep the originals.

Operations that block outside the rig raise UsageError: they could wait for something that this
program itself must do, or would create a second copy of the rig. `subprocess`, `input`, files,
sending on sockets and connecting are not refused. The rig's time stands still during such calls, as
during computations.
"""

import _thread
import asyncio
import multiprocessing
import os
import queue
import random
import select
import selectors
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from queue import _PySimpleQueue  # type: ignore[attr-defined]  # typeshed does not know it
from sched import scheduler
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, Final, Protocol, final

from motorhil.harness.virtual_time.stdlib import clocks, threads
from motorhil.harness.virtual_time.stdlib import clocks as dates
from motorhil.harness.virtual_time.stdlib import threads as locks
from motorhil.harness.virtual_time.stdlib.threads import (
    OUTSIDE,
    Lock,
    RLock,
    caller_is_outside,
    end_threads,
    party_here,
    program_here,
    program_on,
)
from motorhil.motorapi.errors import UsageError

if TYPE_CHECKING:
    from motorhil.harness.virtual_time.runtime import VirtualRuntime

_Names = Mapping[int, tuple[object, object]]
_Methods = list[tuple[type, str, object]]
_COPY: Final = "the new process would have its own copy of the rig, with its own time"
_SOCKET: Final = "it blocks in the operating system, and with it all threads of the program"
_PROCESSES: Final = "it is for processes, and blocks in the operating system"
_ALARM: Final = "it uses the wall clock, not the rig's clock"
_THREADS: Final = "use threads (concurrent.futures.ThreadPoolExecutor)"
_TIMER: Final = "use threading.Timer"
_POLL: Final = "poll with a timeout of 0, and sleep in between"
_FUNCTIONS: Final = (
    (os.fork, "os.fork", _COPY, _THREADS),
    (os.forkpty, "os.forkpty", _COPY, _THREADS),
    (select.poll, "select.poll", _SOCKET, _POLL),
    (select.epoll, "select.epoll", _SOCKET, _POLL),
    (signal.alarm, "signal.alarm", _ALARM, _TIMER),
    (signal.setitimer, "signal.setitimer", _ALARM, _TIMER),
    (signal.pause, "signal.pause", _SOCKET, "sleep until a flag is set"),
    (signal.sigwait, "signal.sigwait", _SOCKET, "sleep until a flag is set"),
    (signal.sigwaitinfo, "signal.sigwaitinfo", _SOCKET, "sleep until a flag is set"),
    (signal.sigtimedwait, "signal.sigtimedwait", _SOCKET, "sleep until a flag is set"),
)
_OF_PROCESSES: Final = (
    *("Barrier", "BoundedSemaphore", "Condition", "Event", "JoinableQueue", "Lock", "Manager"),
    *("Pipe", "Pool", "Queue", "RLock", "Semaphore", "SimpleQueue"),
)
_LOOPS: Final = (
    (asyncio.Runner, "__enter__"),  # by asyncio.run: before there is anything to close
    (asyncio.Runner, "run"),
    (asyncio.BaseEventLoop, "run_until_complete"),
    (asyncio.BaseEventLoop, "run_forever"),
)
_RECEIVING: Final = (
    *("accept", "recv", "recv_into", "recvfrom", "recvfrom_into", "recvmsg", "recvmsg_into"),
)


@final
class _SimpleQueue(_PySimpleQueue):  # type: ignore[misc]  # typeshed does not know it
    """Stand-in for queue.SimpleQueue, in Python and therefore built from our locks."""


@contextmanager
def standard_library_replaced() -> Iterator[None]:
    """Replace clocks, locks and threads of the standard library for parties."""
    with clocks.sleep_unwatched():
        yield from _replaced()


def _replaced() -> Iterator[None]:
    pairs = _pairs()
    there: _Names = {id(original): (original, own) for original, own in pairs}
    back: _Names = {id(own): (own, original) for original, own in pairs}
    methods = _methods()
    defaults = scheduler.__init__.__defaults__  # bound when sched was imported
    before = [(kind, name, vars(kind).get(name)) for kind, name, _ in methods]
    try:
        for kind, name, own in methods:
            setattr(kind, name, own)
        _rebind(there)
        scheduler.__init__.__defaults__ = (time.monotonic, time.sleep)
        yield
    finally:
        scheduler.__init__.__defaults__ = defaults
        _rebind(back)
        for kind, name, original in before:
            if original is None:
                delattr(kind, name)
            else:
                setattr(kind, name, original)


def _pairs() -> list[tuple[object, object]]:
    """Return pairs of (original, stand-in), each unique so that it can be reversed."""
    return [
        (_thread.allocate_lock, locks.allocate_lock),
        *([] if threading.Lock is _thread.allocate_lock else [(threading.Lock, Lock)]),
        (_thread.RLock, RLock),  # also the result of threading.RLock
        (_thread.start_new_thread, threads.start_new_thread),
        (threading.enumerate, threads.enumerate_threads),
        (threading.active_count, threads.active_count),
        (queue.SimpleQueue, _SimpleQueue),
        *clocks.stand_ins(),
        *dates.date_stand_ins(),
        *stand_ins(),
    ]


def _methods() -> _Methods:
    return [
        (Thread, "start", threads.start),
        (Thread, "join", threads.join),
        (Thread, "is_alive", threads.is_alive),
        (Event, "is_set", threads.is_set),
        *methods(),
    ]


def _rebind(names: _Names) -> None:
    for module_name, module in list(sys.modules.items()):
        if module_name.partition(".")[0] in OUTSIDE:
            continue
        try:
            namespace: dict[str, Any] = object.__getattribute__(module, "__dict__")
        except AttributeError:  # an object that replaces a module
            continue
        for name, value in list(namespace.items()):
            found = names.get(id(value))
            if found is not None and found[0] is value:
                namespace[name] = found[1]


class TimedRig(Protocol):
    """A rig, in this process or in another one, as far as its time is concerned."""

    @property
    def runtime(self) -> "VirtualRuntime":
        """Where its programs wait."""

    @property
    def seed(self) -> int:
        """The seed of the run."""


@contextmanager
def in_virtual_time(rig: TimedRig) -> Iterator[None]:
    """Run a program in the rig's virtual time: this thread and those that it starts.

    `random` is seeded from the rig's seed. At the end of the block everything is restored, and
    threads that still run are ended in their current wait.

    Raises:
        UsageError: another program is in virtual time already, or this thread is not a party of the
            rig because it did not open the rig.
    """
    if rig.runtime.party_of_thread() is None:
        raise UsageError(
            f"thread {threading.current_thread().name!r} is not a party of this rig; enter "
            "in_virtual_time in the thread that opened the rig"
        )
    with program_on(rig.runtime) as program, _seeded(rig.seed), standard_library_replaced():
        try:
            yield
        finally:
            end_threads(program)


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    before = random.getstate()
    random.seed(f"{seed}:program")
    try:
        yield
    finally:
        random.setstate(before)


def _refuse(name: str, why: str, remedy: str) -> None:
    raise UsageError(
        f"{name} in virtual time: {why}; {remedy}, or run the program in wall time: "
        "motorhil serve RIG -- python SCRIPT"
    )


def _is_meant() -> bool:
    """Return whether a party calls from the program, two levels up."""
    return party_here() is not None and not caller_is_outside(3)


def _refused(
    original: Callable[..., Any],
    name: str,
    why: str,
    remedy: str,
    waits: Callable[..., bool] = lambda *_, **__: True,
) -> Callable[..., Any]:
    """Return a stand-in that refuses calls of parties if `waits(arguments)` is True."""

    @wraps(original)
    def stand_in(*arguments: Any, **named: Any) -> Any:
        if _is_meant():
            if waits(*arguments, **named):
                _refuse(name, why, remedy)
            program, party = program_here(), party_here()
            if program is not None and party is not None:
                program.look(party)  # lets time pass for a program that polls
        return original(*arguments, **named)

    return stand_in


def _select_waits(*arguments: Any) -> bool:
    return len(arguments) < 4 or arguments[3] is None or arguments[3] > 0


def _selector_waits(selector: object, timeout: float | None = None) -> bool:
    return timeout is None or timeout > 0


def _socket_waits(receiver: socket.socket, *_: Any, **__: Any) -> bool:
    return receiver.gettimeout() != 0


def _of_processes(place: object, name: str) -> Callable[..., Any]:
    """Return a stand-in for a waiting function of `multiprocessing`, also in its thread pool."""
    return _refused(getattr(place, name), f"multiprocessing.{name}", _PROCESSES, _THREADS)


def stand_ins() -> list[tuple[object, object]]:
    """Return (original, stand-in) for the functions that are refused."""
    return [
        (select.select, _refused(select.select, "select.select", _SOCKET, _POLL, _select_waits)),
        *(
            (original, _refused(original, name, why, remedy))
            for original, name, why, remedy in _FUNCTIONS
        ),
        *(
            (getattr(multiprocessing, name), _of_processes(multiprocessing, name))
            for name in _OF_PROCESSES
        ),
    ]


def methods() -> list[tuple[type, str, object]]:
    """Return (class, name, stand-in) for the methods that are refused."""
    found: list[tuple[type, str, object]] = [
        (BaseProcess, "start", _refused(BaseProcess.start, "multiprocessing", _COPY, _THREADS)),
        *((BaseContext, name, _of_processes(BaseContext, name)) for name in _OF_PROCESSES),
        *(
            (kind, name, _refused(getattr(kind, name), "asyncio", _SOCKET, "use threads"))
            for kind, name in _LOOPS
        ),
    ]
    for name, kind in vars(selectors).items():  # one class has a second name
        if isinstance(kind, type) and kind.__name__ == name and "select" in vars(kind):
            what = f"selectors.{name.lstrip('_')}.select"
            stand_in = _refused(vars(kind)["select"], what, _SOCKET, _POLL, _selector_waits)
            found.append((kind, "select", stand_in))
    for name in _RECEIVING:
        original = getattr(socket.socket, name)
        remedy = "make it non-blocking and sleep in between"
        stand_in = _refused(original, f"socket.{name}", _SOCKET, remedy, _socket_waits)
        found.append((socket.socket, name, stand_in))
    return found
