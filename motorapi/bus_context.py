"""State that this process keeps for one bus.

Motors, groups and threads that share a bus know nothing of one another. Each room of the interface
keeps its state of a bus in a *part* of one `BusContext`, which goes away with the bus object.
`context_of` is the only look-up of the process.

Several bus objects may be open on one physical bus. State of the physical bus (its motors, its
SYNC) hangs on `BusContext.medium`, which their contexts share.

A serial line has a context as a bus has. Motors without a bus use the context of their runtime.
"""

import os
import threading
from collections.abc import Callable, Hashable
from typing import Final, TypeVar, cast, final
from weakref import WeakKeyDictionary, WeakValueDictionary

PartT = TypeVar("PartT")
_AF_CAN: Final = 29  # linux/socket.h


@final
class Parts:
    """Objects that belong together, one of each class."""

    def __init__(self) -> None:
        self._parts: Final[dict[type, object]] = {}

    def part(self, kind: type[PartT], make: Callable[[], PartT] | None = None) -> PartT:
        """Return the part of this class, made on first use by `make`, or by the class itself."""
        found = self._parts.get(kind)
        if found is None:
            found = self._parts.setdefault(kind, (make or kind)())
        return cast("PartT", found)

    def find(self, kind: type[PartT]) -> PartT | None:
        """Return the part of this class, or None."""
        return cast("PartT | None", self._parts.get(kind))

    def drop(self, part: object) -> None:
        """Drop a part; the next use makes another one."""
        if self._parts.get(type(part)) is part:
            del self._parts[type(part)]


@final
class BusContext:
    """The state that this process keeps for one bus object.

    Attributes:
        parts: the state of this bus object.
        medium: the state of the physical bus, shared by all bus objects on it.
        key: identifies the physical bus in this process; None: no other bus object is on it.
    """

    def __init__(self, medium: Parts | None = None, key: Hashable = None) -> None:
        self.parts: Final = Parts()
        self.medium: Final = Parts() if medium is None else medium
        self.key: Final = key


# A context refers to its bus through its parts; the bus keeps it, so that both can go together.
_ATTRIBUTE: Final = "_motorhil_context"
_slotted: "Final[WeakKeyDictionary[object, BusContext]]" = WeakKeyDictionary()
_media: "Final[WeakValueDictionary[Hashable, Parts]]" = WeakValueDictionary()
_lock: Final = threading.Lock()


def context_of(home: object) -> BusContext:
    """Return the context of a bus, a line or a runtime, made on first use.

    A runtime holds its context itself, in its attribute `context`.
    """
    own = getattr(home, "context", None)
    if isinstance(own, BusContext):
        return own
    with _lock:
        context = getattr(home, _ATTRIBUTE, None) or _slotted.get(home)
        if context is None:
            key = physical_key(home)
            context = BusContext(None if key is None else _media.get(key), key)
            if key is not None:
                _media[key] = context.medium
            try:
                setattr(home, _ATTRIBUTE, context)
            except AttributeError:
                _slotted[home] = context
        return context


os.register_at_fork(
    before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_lock.release
)


def physical_key(home: object) -> Hashable:
    """Return one key for all objects on one physical bus or line, however they were opened.

    None: only this object is known to be on it.
    """
    runtime = getattr(home, "runtime", None)
    hub = getattr(home, "hub_bus", None)
    if hub is not None:
        return ("hub", os.path.realpath(hub[0]), hub[1])
    channel = getattr(home, "channel", None)
    raw = getattr(home, "socket", None)
    if getattr(raw, "family", None) == _AF_CAN and channel:
        return ("socketcan", str(channel))
    path = getattr(home, "path", channel)
    if isinstance(path, str) and path.startswith("/dev/"):
        return ("device", os.path.realpath(path))
    address = getattr(home, "address", None)
    if isinstance(address, tuple):
        return ("tcp", *address)
    info = getattr(home, "channel_info", "unknown")
    return None if info == "unknown" else (id(runtime), type(home).__name__, str(info))
