"""`multiprocessing` in virtual time, for processes that are started anew ("spawn").

Such a process joins the rig as a child does. Semaphores, and the pipes that carry queues, are the
library's own: a party looks whether it would have to wait, and waits in the rig's time.
"""

import fcntl
import multiprocessing
import os
import select
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial, wraps
from multiprocessing import util
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from multiprocessing.popen_fork import Popen
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import SemLock
from typing import Any, Final

from motorhil.harness.virtual_time.stdlib.children import await_here, death_awaited, is_ready
from motorhil.harness.virtual_time.stdlib.refusals import COPY, THREADS, is_meant, refuse
from motorhil.harness.virtual_time.stdlib.threads import (
    has_children,
    on_wall,
    party_here,
    program_here,
)

_PROCESSES: Final = "it is for processes, and blocks in the operating system"
_SPAWN: Final = 'use multiprocessing.get_context("spawn")'
_CHILD_MARK: Final = "--multiprocessing-fork"
_PIPE_BYTES: Final = 1 << 20  # for what a process gets at its start, which is written at once
_FOR_PROCESSES: Final = (
    *("Barrier", "BoundedSemaphore", "Condition", "Event", "JoinableQueue", "Lock", "Pipe"),
    *("Pool", "Queue", "RLock", "Semaphore", "SimpleQueue"),
)
_start, _popen_wait = BaseProcess.start, Popen.wait
_kill: Callable[[Popen, int], None] = Popen._send_signal  # type: ignore[attr-defined]  # noqa: SLF001 -- of terminate and kill
_spawnv = util.spawnv_passfds
_recv, _send = Connection._recv, Connection._send  # type: ignore[attr-defined]  # noqa: SLF001 -- where it blocks
_make_methods: Callable[[Any], None] = SemLock._make_methods  # type: ignore[attr-defined]  # noqa: SLF001 -- where it gets its functions
_enter = SemLock.__enter__


def stand_ins() -> list[tuple[object, object]]:
    """Return (original, stand-in) for functions of multiprocessing."""
    return [
        (_spawnv, _spawned),
        *(
            (getattr(multiprocessing, name), _guarded(multiprocessing, name))
            for name in (*_FOR_PROCESSES, "Manager")
        ),
    ]


def methods() -> list[tuple[type, str, object]]:
    """Return (class, name, stand-in) for methods of multiprocessing."""
    return [
        (BaseProcess, "start", _started),
        (Popen, "wait", _waited),
        (Popen, "_send_signal", _signalled),
        (Connection, "_recv", _received),
        (Connection, "_send", _sent),
        (SemLock, "_make_methods", _with_methods),
        (SemLock, "__enter__", _entered),
        *((BaseContext, name, _guarded(BaseContext, name)) for name in _FOR_PROCESSES),
        (BaseContext, "Manager", _guarded(BaseContext, "Manager")),
    ]


def _guarded(place: object, name: str) -> Callable[..., Any]:
    """Return a stand-in that refuses parties whose processes cannot join; Manager, all parties.

    A thread pool has a SimpleQueue to end, and reads it only when something is in it.
    """
    original = getattr(place, name)
    remedy = THREADS if name != "Manager" else "use a Queue of a spawn context"

    @wraps(original)
    def stand_in(*arguments: Any, **named: Any) -> Any:
        if name == "SimpleQueue" and not has_children() and _is_for_pool():
            with on_wall():
                return original(*arguments, **named)
        if is_meant() and (name == "Manager" or not has_children()):
            refuse(f"multiprocessing.{name}", _PROCESSES, remedy)
        return original(*arguments, **named)

    return stand_in


def _is_for_pool() -> bool:
    caller = sys._getframe(2).f_globals.get("__name__")  # noqa: SLF001 -- as in caller_is_outside
    return caller == "multiprocessing.pool"


@wraps(_start)
def _started(process: Any) -> None:
    """Stand in for Process.start."""
    if is_meant():
        method = process._start_method or multiprocessing.get_start_method()  # noqa: SLF001 -- not told otherwise
        if not has_children() or method != "spawn":
            remedy = _SPAWN if has_children() else THREADS
            refuse("multiprocessing", COPY, remedy)
    _start(process)


@wraps(_spawnv)
def _spawned(path: Any, words: list[Any], passfds: list[int]) -> int:
    """Stand in for the function that starts a process; it joins before it reads its work."""
    program = program_here()
    joins = program is not None and program.children is not None
    if not joins or _CHILD_MARK not in map(os.fsdecode, words):
        return _spawnv(path, words, passfds)
    assert program is not None
    assert program.children is not None
    for fd in passfds:
        if stat.S_ISFIFO(os.fstat(fd).st_mode):
            with suppress(OSError):  # a limit of the system: then it may be too small
                fcntl.fcntl(fd, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
    with _environment(program.children.invite(os.environ)):
        pid = _spawnv(path, words, passfds)
    reason = program.children.admit(pid)
    if reason:
        raise RuntimeError(f"multiprocessing: the new process {reason}")
    return pid


@contextmanager
def _environment(changed: dict[str, str]) -> Iterator[None]:
    """Set the environment within the block."""
    before = dict(os.environ)
    os.environ.update(changed)
    try:
        yield
    finally:
        for name in changed.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)


@wraps(_popen_wait)
def _waited(process: Popen, timeout: float | None = None) -> int | None:
    """Stand in for the wait for a process."""
    if process.returncode is None and party_here() is not None and has_children():
        await_here(lambda: process.poll() is not None, timeout)
        return process.poll()
    return _popen_wait(process, timeout)


@wraps(_kill)
def _signalled(process: Popen, number: int) -> None:
    """Stand in for terminate and kill; return once the process is dead by it."""
    if process.returncode is not None or party_here() is None or not has_children():
        _kill(process, number)
        return
    with death_awaited(process.pid, number):
        _kill(process, number)


@wraps(_recv)
def _received(connection: Any, size: int, read: Any = None) -> Any:
    """Stand in for the reads of a connection."""

    def read_in_time(handle: int, count: int) -> bytes:
        await_here(partial(is_ready, handle, False), None)
        return os.read(handle, count)

    return _recv(connection, size, read_in_time)


@wraps(_send)
def _sent(connection: Any, data: Any, write: Any = None) -> None:
    """Stand in for the writes of a connection."""

    def write_in_time(handle: int, some: Any) -> int:
        await_here(partial(is_ready, handle, True), None)
        return os.write(handle, some[: select.PIPE_BUF])

    _send(connection, data, write_in_time)


@wraps(_make_methods)
def _with_methods(semaphore: Any) -> None:
    """Stand in for the method that gives a semaphore its functions."""
    _make_methods(semaphore)
    semaphore.acquire = partial(_acquired, semaphore._semlock)  # noqa: SLF001 -- as the original


@wraps(_enter)
def _entered(semaphore: Any) -> Any:
    """Stand in for the beginning of a block with a semaphore."""
    return semaphore.acquire()


def _acquired(own: Any, block: bool = True, timeout: float | None = None) -> bool:
    """Acquire a semaphore; parties wait in the rig's time.

    It is taken in the thread that asked: the semaphore knows its owner.
    """
    if party_here() is None or not has_children():
        return bool(own.acquire(block, timeout))
    if own.acquire(False):
        return True
    limit_s = timeout if block else 0.0
    return await_here(partial(_is_free, own), limit_s) and bool(own.acquire(False))


def _is_free(own: Any) -> bool:
    return not own._is_zero()  # noqa: SLF001 -- asks without taking it
