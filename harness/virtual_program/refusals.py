"""What cannot be in virtual time, refused by its name: it would wait where nobody knows of the rig.

Left as they are: `subprocess`, `input`, files, sending on sockets, connecting. The rig's time
stands still while they last, as while the program computes. What is refused could also wait for
something that this program has to do itself, or makes a second copy of the rig.
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

_COPY: Final = "the new process would have a copy of the rig, with a time of its own"
_SOCKET: Final = "it waits in the operating system, and no thread of the program runs meanwhile"
_PROCESSES: Final = "it is for processes, and waits in the operating system"
_ALARM: Final = "it goes by the wall's clock, not by the rig's"
_THREADS: Final = "use threads (concurrent.futures.ThreadPoolExecutor)"
_TIMER: Final = "use threading.Timer"
_POLL: Final = "ask without waiting (a timeout of 0), and sleep in between"

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
    (asyncio.Runner, "__enter__"),  # of asyncio.run: before there is anything to close
    (asyncio.Runner, "run"),
    (asyncio.BaseEventLoop, "run_until_complete"),
    (asyncio.BaseEventLoop, "run_forever"),
)
_RECEIVING: Final = (
    *("accept", "recv", "recv_into", "recvfrom", "recvfrom_into", "recvmsg", "recvmsg_into"),
)


def _refuse(name: str, why: str, remedy: str) -> None:
    raise UsageError(
        f"{name} in virtual time: {why}; {remedy}, or run the program on the wall's clock: "
        "motorhil serve RIG -- python SCRIPT"
    )


def _is_meant() -> bool:
    """Whether a party calls, from the program: two calls up."""
    return party_here() is not None and not caller_is_outside(3)


def _refused(
    original: Callable[..., Any],
    name: str,
    why: str,
    remedy: str,
    waits: Callable[..., bool] = lambda *_, **__: True,
) -> Callable[..., Any]:
    """The original, refused to parties whenever `waits` of its arguments says so."""

    @wraps(original)
    def stand_in(*arguments: Any, **named: Any) -> Any:
        if _is_meant():
            if waits(*arguments, **named):
                _refuse(name, why, remedy)
            program, party = program_here(), party_here()
            if program is not None and party is not None:
                program.look(party)  # a program that polls gets on
        return original(*arguments, **named)

    return stand_in


def _select_waits(*arguments: Any) -> bool:
    return len(arguments) < 4 or arguments[3] is None or arguments[3] > 0


def _selector_waits(selector: object, timeout: float | None = None) -> bool:
    return timeout is None or timeout > 0


def _socket_waits(receiver: socket.socket, *_: Any, **__: Any) -> bool:
    return receiver.gettimeout() != 0


def _of_processes(place: object, name: str) -> Callable[..., Any]:
    """What of `multiprocessing` is for waiting, also in its pool of threads."""
    return _refused(getattr(place, name), f"multiprocessing.{name}", _PROCESSES, _THREADS)


def stand_ins() -> list[tuple[object, object]]:
    """Functions that are refused, and what refuses them."""
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
    """(class, name, what refuses it) of methods that are refused."""
    found: list[tuple[type, str, object]] = [
        (BaseProcess, "start", _refused(BaseProcess.start, "multiprocessing", _COPY, _THREADS)),
        *((BaseContext, name, _of_processes(BaseContext, name)) for name in _OF_PROCESSES),
        *(
            (kind, name, _refused(getattr(kind, name), "asyncio", _SOCKET, "use threads"))
            for kind, name in _LOOPS
        ),
    ]
    for name, kind in vars(selectors).items():  # one of them under a second name, too
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
