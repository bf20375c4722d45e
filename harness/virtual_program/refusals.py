"""Operations refused in virtual time, because they block outside the rig.

`subprocess`, `input`, files, sending on sockets and connecting are not refused. The rig's time
stands still during such calls, as during computations. The refused operations could wait for
something that this program itself must do, or would create a second copy of the rig.
"""

import asyncio
import multiprocessing
import os
import select
import selectors
import signal
import socket
from collections.abc import Callable
from functools import wraps
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from typing import Any, Final

from harness.virtual_program.turn import caller_is_outside, party_here, program_here
from motorapi.errors import UsageError

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
