"""Replacement of the standard library while a program runs.

Every name in every module that is bound to an original is rebound, whenever the module was
imported: `time.sleep`, and `sleep` in a module with `from time import sleep`. Modules of the
packages in `turn.OUTSIDE` keep the originals.
"""

import _thread
import queue
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from queue import _PySimpleQueue  # type: ignore[attr-defined]  # typeshed does not know it
from sched import scheduler
from threading import Event, Thread
from typing import Any, final

from harness.virtual_program import clocks, dates, locks, refusals, threads
from harness.virtual_program.locks import Lock, RLock
from harness.virtual_program.turn import OUTSIDE

_Names = Mapping[int, tuple[object, object]]
_Methods = list[tuple[type, str, object]]


@final
class SimpleQueue(_PySimpleQueue):  # type: ignore[misc]  # typeshed does not know it
    """Stand-in for queue.SimpleQueue, in Python and therefore built from our locks."""


@contextmanager
def standard_library_replaced() -> Iterator[None]:
    """Replace clocks, locks and threads of the standard library for parties."""
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
        (queue.SimpleQueue, SimpleQueue),
        *clocks.stand_ins(),
        *dates.stand_ins(),
        *refusals.stand_ins(),
    ]


def _methods() -> _Methods:
    return [
        (Thread, "start", threads.start),
        (Thread, "join", threads.join),
        (Thread, "is_alive", threads.is_alive),
        (Event, "is_set", threads.is_set),
        *refusals.methods(),
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
