"""Unmodified programs for hardware, run in a rig's virtual time.

    with Rig.open("rig.toml") as rig, in_virtual_time(rig):
        main_of_the_program()

Inside the block `time`, `threading`, `queue`, `sched`, `asyncio` and thread pools use the rig's
clock. Each thread is a party, which runs while the others wait. Every name in every module that is
bound to an original is rebound, whenever the module was imported: `time.sleep`, and `sleep` in a
module with `from time import sleep`. Modules of the packages in `OUTSIDE` keep the originals.

Operations that block outside the rig raise UsageError: they could wait for something that this
program itself must do, or would create a second copy of the rig. `subprocess`, `input`, files,
sending on sockets and connecting are not refused. The rig's time stands still during such calls, as
during computations.
"""

import _thread
import queue
import random
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from queue import _PySimpleQueue  # type: ignore[attr-defined]  # typeshed does not know it
from sched import scheduler
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, Protocol, final

from motorhil.harness.virtual_time.stdlib import children as processes
from motorhil.harness.virtual_time.stdlib import (
    clocks,
    descriptors,
    lines,
    multiprocess,
    refusals,
    signals,
    threads,
)
from motorhil.harness.virtual_time.stdlib import clocks as dates
from motorhil.harness.virtual_time.stdlib import threads as locks
from motorhil.harness.virtual_time.stdlib.threads import (
    OUTSIDE,
    ChildClock,
    Lock,
    RLock,
    end_threads,
    program_on,
)
from motorhil.motorapi.errors import UsageError

if TYPE_CHECKING:
    from motorhil.harness.virtual_time.runtime import VirtualRuntime

_Names = Mapping[int, tuple[object, object]]
_Methods = list[tuple[type, str, object]]


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
    methods = [*_methods(), *_bound_in_classes(there)]
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
        *descriptors.stand_ins(),
        *lines.stand_ins(),
        *refusals.stand_ins(),
        *signals.stand_ins(),
        *multiprocess.stand_ins(),
    ]


def _methods() -> _Methods:
    return [
        (Thread, "start", threads.start),
        (Thread, "join", threads.join),
        (Thread, "is_alive", threads.is_alive),
        (Event, "is_set", threads.is_set),
        *descriptors.methods(),
        *lines.methods(),
        *processes.methods(),
        *multiprocess.methods(),
    ]


def _bound_in_classes(names: _Names) -> _Methods:
    """Return (class, name, stand-in) for a clock that a class of pyserial has bound at import."""
    timeout = getattr(sys.modules.get("serial.serialutil"), "Timeout", None)
    found = names.get(id(getattr(timeout, "TIME", None)))
    return [] if timeout is None or found is None else [(timeout, "TIME", found[1])]


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
def in_virtual_time(rig: TimedRig, children: ChildClock | None = None) -> Iterator[None]:
    """Run a program in the rig's virtual time: this thread and those that it starts.

    `random` is seeded from the rig's seed. At the end of the block everything is restored, and
    threads that still run are ended in their current wait.

    Args:
        rig: an open rig.
        children: the clock that child processes join; None: they run on the wall clock.

    Raises:
        UsageError: another program is in virtual time already, or this thread is not a party of the
            rig because it did not open the rig.
    """
    if rig.runtime.party_of_thread() is None:
        raise UsageError(
            f"thread {threading.current_thread().name!r} is not a party of this rig; enter "
            "in_virtual_time in the thread that opened the rig"
        )
    with (
        program_on(rig.runtime, children) as program,
        _seeded(rig.seed),
        lines.lines_of(rig, rig.runtime),
        standard_library_replaced(),
    ):
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
