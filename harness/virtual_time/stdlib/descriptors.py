"""Waits for descriptors in virtual time: selectors, `select`, `poll`, `epoll`, and sockets.

A party may wait for a descriptor whose other end is in its own program: a pipe, a pair of sockets,
an eventfd. Only a party can change it, so the wait looks at it whenever something has happened.
This is all that an event loop of asyncio waits for, beside its timers. A pipe to a child that has
joined the rig changes in the turns of that child. A line of the rig is a pair of sockets, too
(`lines`). Any other network connection, a device or a pipe to any
other process changes at times of the wall clock; waiting for it is refused.
"""

import os
import select
import selectors
import socket
import stat
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import wraps
from typing import Any, Final, final

from motorhil.harness.virtual_time.stdlib.lines import are_among
from motorhil.harness.virtual_time.stdlib.refusals import is_meant, refuse
from motorhil.harness.virtual_time.stdlib.threads import party_here, program_here

_POLL: Final = "poll with a timeout of 0, and sleep in between"
_FOREIGN_PIPE: Final = "a pipe to another process"
_OF_RELATIVES: Final = (_FOREIGN_PIPE, "anon_inode:[pidfd]")
_RECEIVING: Final = (
    *("accept", "recv", "recv_into", "recvfrom", "recvfrom_into", "recvmsg", "recvmsg_into"),
)
_HARDWARE: Final = "it would command hardware, not the rig"
_CAN: Final = "use python-can, whose buses are the rig's"
_READY: Final = select.POLLIN | select.POLLPRI | select.POLLOUT
_select, _poll, _epoll = select.select, select.poll, select.epoll
_new_socket = socket.socket.__init__


def stand_ins() -> list[tuple[object, object]]:
    """Return (original, stand-in) for the functions that wait for descriptors."""
    return [(_select, select_in_virtual_time), (_poll, poll_in_virtual_time), (_epoll, Epoll)]


def methods() -> list[tuple[type, str, object]]:
    """Return (class, name, stand-in) for the methods that wait for descriptors."""
    kinds = [  # one class has a second name
        kind
        for name, kind in vars(selectors).items()
        if isinstance(kind, type) and kind.__name__ == name and "select" in vars(kind)
    ]
    return [
        (socket.socket, "__init__", _opening),
        *((kind, "select", _selecting(kind)) for kind in kinds),
        *((socket.socket, name, _receiving(name)) for name in _RECEIVING),
    ]


@wraps(_select)
def select_in_virtual_time(
    readable: Iterable[Any],
    writable: Iterable[Any],
    exceptional: Iterable[Any],
    timeout: float | None = None,
    /,
) -> tuple[list[Any], list[Any], list[Any]]:
    """Stand in for select.select."""
    if not is_meant():
        return _select(readable, writable, exceptional, timeout)
    sets = list(readable), list(writable), list(exceptional)
    found: tuple[list[Any], list[Any], list[Any]] = ([], [], [])

    def look() -> bool:
        nonlocal found
        found = _select(*sets, 0)
        return any(found)

    every = [one if isinstance(one, int) else one.fileno() for some in sets for one in some]
    _wait("select.select", _POLL, look, timeout, every)
    return found


def _found(
    name: str, ask: Callable[[], list[Any]], timeout_s: float | None, ends: Iterable[int]
) -> list[Any]:
    """Wait until `ask` finds events, which it may do once for each; return them."""
    found: list[Any] = []

    def look() -> bool:
        nonlocal found
        found = found or ask()
        return len(found) > 0

    _wait(name, _POLL, look, None if timeout_s is not None and timeout_s < 0 else timeout_s, ends)
    return found


@final
class _Poll:
    """Stand-in for what select.poll returns."""

    def __init__(self) -> None:
        self._poll: Final = _poll()
        self._ends: Final[set[int]] = set()

    def register(self, fd: Any, eventmask: int = _READY, /) -> None:
        """Add a descriptor, or change its events."""
        self._poll.register(fd, eventmask)
        self._ends.add(_number_of(fd))

    def modify(self, fd: Any, eventmask: int, /) -> None:
        """Change the events of a descriptor."""
        self._poll.modify(fd, eventmask)

    def unregister(self, fd: Any, /) -> None:
        """Remove a descriptor."""
        self._poll.unregister(fd)
        self._ends.discard(_number_of(fd))

    def poll(self, timeout: float | None = None, /) -> list[tuple[int, int]]:
        """Wait up to this time [ms]; return (descriptor, events)."""
        if not is_meant():
            return self._poll.poll(timeout)
        timeout_s = None if timeout is None else timeout / 1e3
        return _found("select.poll", lambda: self._poll.poll(0), timeout_s, self._ends)


@wraps(_poll)
def poll_in_virtual_time() -> Any:
    """Stand in for select.poll."""
    return _Poll() if is_meant() else _poll()


@final
class Epoll:
    """Stand-in for select.epoll."""

    def __init__(self, sizehint: int = -1, flags: int = 0) -> None:
        self._epoll = _epoll(sizehint, flags)
        self._ends: Final[set[int]] = set()

    @classmethod
    def fromfd(cls, fd: int, /) -> "Epoll":
        """Return one on an existing descriptor; the ends within it are not known."""
        own = cls()
        own._epoll.close()
        own._epoll = _epoll.fromfd(fd)
        return own

    def __enter__(self) -> "Epoll":
        """Return itself."""
        self._epoll.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        """Close it."""
        self.close()

    @property
    def closed(self) -> bool:
        """True once it is closed."""
        return self._epoll.closed

    def close(self) -> None:
        """Close it."""
        self._epoll.close()

    def fileno(self) -> int:
        """Return its descriptor."""
        return self._epoll.fileno()

    def register(self, fd: Any, eventmask: int = _READY) -> None:
        """Add a descriptor."""
        self._epoll.register(fd, eventmask)
        self._ends.add(_number_of(fd))

    def modify(self, fd: Any, eventmask: int) -> None:
        """Change the events of a descriptor."""
        self._epoll.modify(fd, eventmask)

    def unregister(self, fd: Any) -> None:
        """Remove a descriptor."""
        self._epoll.unregister(fd)
        self._ends.discard(_number_of(fd))

    def poll(self, timeout: float | None = None, maxevents: int = -1) -> list[tuple[int, int]]:
        """Wait up to this time [s]; return (descriptor, events)."""
        if not is_meant():
            return self._epoll.poll(timeout, maxevents)
        return _found("select.epoll", lambda: self._epoll.poll(0, maxevents), timeout, self._ends)


def _number_of(fd: Any) -> int:
    return fd if isinstance(fd, int) else int(fd.fileno())


@wraps(_new_socket)
def _opening(
    own: socket.socket, family: int = -1, type: int = -1, proto: int = -1, fileno: Any = None
) -> None:
    """Stand in for the constructor of socket.socket, which opens none on real CAN interfaces."""
    if family == socket.AF_CAN and fileno is None and is_meant():
        refuse("socket.socket(AF_CAN)", _HARDWARE, _CAN)
    _new_socket(own, family, type, proto, fileno)


def _selecting(kind: type) -> Callable[..., Any]:
    """Return a stand-in for the method `select` of a selector."""
    original = vars(kind)["select"]
    name = f"selectors.{kind.__name__.lstrip('_')}.select"

    @wraps(original)
    def stand_in(selector: selectors.BaseSelector, timeout: float | None = None) -> Any:
        if not is_meant():
            return original(selector, timeout)
        found: list[Any] = []

        def look() -> bool:
            nonlocal found
            found = original(selector, 0)
            return len(found) > 0

        _wait(name, _POLL, look, timeout, (key.fd for key in selector.get_map().values()))
        return found

    return stand_in


def _receiving(name: str) -> Callable[..., Any]:
    """Return a stand-in for a method of sockets that waits for data."""
    original = getattr(socket.socket, name)
    remedy = "make it non-blocking and sleep in between"

    @wraps(original)
    def stand_in(receiver: socket.socket, *arguments: Any, **named: Any) -> Any:
        if is_meant():
            timeout_s, ends = receiver.gettimeout(), (receiver.fileno(),)
            is_there = _wait(
                f"socket.{name}", remedy, lambda: any(_select(ends, (), (), 0)), timeout_s, ends
            )
            if not is_there and timeout_s:
                raise TimeoutError("timed out")
        return original(receiver, *arguments, **named)

    return stand_in


def _wait(
    name: str,
    remedy: str,
    look: Callable[[], bool],
    timeout_s: float | None,
    descriptors: Iterable[int],
) -> bool:
    """Wait until `look` finds something, up to a time [s] of the rig; return whether it does.

    Raises:
        UsageError: it would wait for something outside the program.
    """
    program, party = program_here(), party_here()
    assert program is not None
    assert party is not None
    if look():
        return True
    if timeout_s is not None and timeout_s <= 0:
        program.look(party)  # lets time pass for a program that polls
        return False
    every = list(descriptors)
    what = _foreign_among(every)
    relatives = program.children is not None and program.children.has_relatives()
    if what and not (relatives and what in _OF_RELATIVES):
        refuse(name, f"it waits for {what}, which has the wall clock", remedy)
    left_s = None if timeout_s is None else program.from_now_s(party, timeout_s)
    wait = program.runtime.wait_until if are_among(every) else program.runtime.wait_for_parties
    if program.children is None or not relatives:
        return wait(look, left_s)
    with program.children.watching():
        return wait(look, left_s)


def _foreign_among(descriptors: Iterable[int]) -> str:
    """Return what the first descriptor with an end outside this program is; "" if none has one."""
    for descriptor in descriptors:
        with suppress(OSError):  # it is closed: the wait itself tells
            what = _foreign(descriptor)
            if what:
                return what
    return ""


def _foreign(descriptor: int) -> str:
    mode, link = os.fstat(descriptor).st_mode, _link(descriptor)
    if stat.S_ISFIFO(mode):
        return "" if _ends(link) > 1 else _FOREIGN_PIPE
    if stat.S_ISSOCK(mode):
        with socket.socket(fileno=os.dup(descriptor)) as copy:
            if copy.family != socket.AF_UNIX:
                return "a network socket"
            return "a named socket" if copy.getsockname() or copy.getpeername() else ""
    return "" if link == "anon_inode:[eventfd]" else link


def _link(descriptor: int) -> str:
    return os.readlink(f"/proc/self/fd/{descriptor}")


def _ends(link: str) -> int:
    """Return how many descriptors of this process are of this pipe."""
    found = 0
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # that of the listing itself
            found += _link(int(name)) == link
    return found
