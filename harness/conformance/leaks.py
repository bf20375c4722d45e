"""Leaks of a check: threads, buses, descriptors and processes that it leaves behind.

No library records where a thread was started or a bus was opened; inside `watched` both calls
record their callers.
"""

import gc
import inspect
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, final

import can

from motorhil.harness.conformance.places import called_at
from motorhil.motorapi import UsageError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.lock_status import look

_SETTLE_S: Final = 0.25
_POLL_S: Final = 0.01
_DESCRIPTORS: Final = Path("/proc/self/fd")
_TASKS: Final = Path("/proc/self/task")


@final
class Watch:
    """Compares resources before and after a clause; use it through `watched`."""

    def __init__(self) -> None:
        self._threads = _thread_ids()
        self._descriptors = _descriptors()
        self._children = _children()
        self._folder = os.getcwd()
        self.started: dict[int | None, str] = {}
        self.opened: list[tuple[can.BusABC, str]] = []

    def left(self) -> list[str]:
        """Return descriptions of new resources; shut down new buses, kill new processes."""
        buses = list(self._open_buses())
        end_s = time.monotonic() + _SETTLE_S
        while self._is_ending() and time.monotonic() < end_s:
            time.sleep(_POLL_S)  # a thread needs a moment to end
        self.opened.clear()
        return [
            *map(self._thread, self._new_threads()),
            *buses,
            *self._new_descriptors(),
            *self._new_children(),
            *self._new_folder(),
        ]

    def _is_ending(self) -> bool:
        """Return whether new threads exist, or descriptors that a thread may still close."""
        return bool(self._new_threads() or set(_descriptors()) - set(self._descriptors))

    def _new_threads(self) -> list[int]:
        return sorted(_thread_ids() - self._threads - {threading.get_ident()})

    def _thread(self, ident: int) -> str:
        names = {thread.ident: thread.name for thread in threading.enumerate()}
        frame = sys._current_frames().get(ident)  # noqa: SLF001 -- documented, despite its name
        at = self.started.get(ident) or called_at(frame)
        return f"thread {names.get(ident, 'without a name')!r}, started at {at}"

    def _open_buses(self) -> Iterator[str]:
        for bus, at in self.opened:
            if not getattr(bus, "_is_shutdown", True):
                yield f"a bus not shut down ({bus.channel_info}), opened at {at}"
                with suppress(Exception):
                    bus.shutdown()

    def _new_descriptors(self) -> Iterator[str]:
        if set(_descriptors()) - set(self._descriptors):
            gc.collect()  # closes what is no longer referenced
        for number, target in _descriptors().items():
            if self._descriptors.get(number) != target:
                yield _lock_held(target) or f"a descriptor not closed ({target})"

    def _new_children(self) -> Iterator[str]:
        for pid in sorted(_children() - self._children):
            yield f"a process ({_program(pid)})"
            with suppress(OSError):
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)

    def _new_folder(self) -> Iterator[str]:
        now = os.getcwd()
        if now != self._folder:
            os.chdir(self._folder)  # relative paths of others start here
            yield f"another current folder ({now})"


@contextmanager
def watched() -> Iterator[Watch]:
    """Record where threads are started and buses are opened within the block."""
    watch = Watch()
    thread: Any = threading.Thread
    bus: Any = can.BusABC
    start, open_ = thread.start, bus.__init__

    def start_noted(self: threading.Thread) -> None:
        here = inspect.currentframe()
        at = called_at(here and here.f_back)
        start(self)
        watch.started[self.ident] = at

    def open_noted(self: can.BusABC, *args: Any, **kwargs: Any) -> None:
        watch.opened.append((self, _opened_at()))
        open_(self, *args, **kwargs)

    thread.start, bus.__init__ = start_noted, open_noted
    try:
        yield watch
    finally:
        thread.start, bus.__init__ = start, open_


def _opened_at() -> str:
    """Return where a bus was opened: the first caller outside constructors and python-can."""
    frame = inspect.currentframe()
    for _ in range(2):
        frame = None if frame is None else frame.f_back
    own = os.path.dirname(can.__file__) + os.sep
    while frame is not None and (
        frame.f_code.co_name == "__init__" or frame.f_code.co_filename.startswith(own)
    ):
        frame = frame.f_back
    return called_at(frame)


def _thread_ids() -> set[int]:
    """Return all threads, also those that the threading module has not started."""
    return set(sys._current_frames())  # noqa: SLF001 -- documented, despite its name


def _descriptors() -> dict[int, str]:
    """Return the targets of all open descriptors of this process."""
    found = {}
    for entry in _DESCRIPTORS.iterdir():
        with suppress(OSError):  # the listing's own descriptor is closed by now
            found[int(entry.name)] = os.readlink(entry)
    return found


def _lock_held(target: str) -> str:
    """Describe a lock file held by this process; "" if it is not a lock file, or free."""
    folder, name = os.path.split(target)
    with suppress(UsageError):
        directory = LockDirectory()
        holder = look(directory, name).holder if str(directory.path) == folder else None
        if holder is not None and holder.record is not None and holder.record.pid == os.getpid():
            return f"an inter-process lock not released ({name}, for {holder.record.purpose})"
    return ""


def _program(pid: int) -> str:
    """Return the command line of a process, or its name if it has ended."""
    words = b""
    end_s = time.monotonic() + _POLL_S
    with suppress(OSError):
        while not words and time.monotonic() < end_s:  # empty while the process starts
            words = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").strip()
        words = words or Path(f"/proc/{pid}/comm").read_bytes().strip()
    return words.decode(errors="replace")


def _children() -> set[int]:
    """Return the process ids of all child processes."""
    pids: set[int] = set()
    for task in _TASKS.iterdir():
        with suppress(OSError):
            pids.update(map(int, (task / "children").read_text().split()))
    return pids
