"""What stands in for the standard library while a program runs, and that it all goes again.

Replaced is every name of every module, imported before or meanwhile, that is bound to one of the
originals: `time.sleep`, and `sleep` in a module that has done `from time import sleep`.
Modules of the packages in `turn.OUTSIDE` keep theirs.
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
    """As queue.SimpleQueue, but in Python: made of locks."""


@contextmanager
def standard_library_replaced() -> Iterator[None]:
    """Within it, parties meet the rig's clock and baton in the standard library, not the wall's."""
    pairs = _pairs()
    there: _Names = {id(original): (original, own) for original, own in pairs}
    back: _Names = {id(own): (own, original) for original, own in pairs}
    methods = _methods()
    defaults = scheduler.__init__.__defaults__  # bound when somebody imported it
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
    """(original, what stands in for it): one for each, so that each finds back."""
    return [
        (_thread.allocate_lock, locks.allocate_lock),
        *([] if threading.Lock is _thread.allocate_lock else [(threading.Lock, Lock)]),
        (_thread.RLock, RLock),  # also what threading.RLock makes
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
        except AttributeError:  # what somebody put there in place of a module
            continue
        for name, value in list(namespace.items()):
            found = names.get(id(value))
            if found is not None and found[0] is value:
                namespace[name] = found[1]
