"""Dispatching of frames: handlers by identifier, and the identifiers of a node."""

from collections.abc import Callable
from typing import final

Handler = Callable[[bytes, int], None]


@final
class Routes:
    """The identifiers of a node in any state, and the handlers active in the present one.

    Attributes:
        handlers: by the identifier's four bytes.
    """

    def __init__(self) -> None:
        self.handlers: dict[bytes, Handler] = {}
        self._wanted: dict[int, None] = {}

    def add(self, can_id: int, handler: Handler, is_active: bool) -> None:
        """Listen to this identifier, in this state (`is_active`) or in another one."""
        self.want(can_id)
        if is_active:
            key = can_id.to_bytes(4, "little")
            taken = self.handlers.get(key)
            self.handlers[key] = handler if taken is None else _Both(taken, handler).receive

    def want(self, can_id: int) -> None:
        """Listen to this identifier without a handler."""
        self._wanted[can_id] = None

    def identifiers(self) -> tuple[int, ...]:
        """Return all identifiers listened to, ascending."""
        return tuple(sorted(self._wanted))


@final
class _Both:
    """Two parts of the node that listen to one identifier."""

    def __init__(self, first: Handler, second: Handler) -> None:
        self._first = first
        self._second = second

    def receive(self, frame: bytes, now_ns: int) -> None:
        self._first(frame, now_ns)
        self._second(frame, now_ns)
