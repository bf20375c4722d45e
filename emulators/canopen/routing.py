"""Which frame is whose: handlers by the four identifier bytes, and who may be heard at all."""

from collections.abc import Callable
from typing import final

Handler = Callable[[bytes, int], None]


@final
class Routes:
    """What a node listens to, whatever its state, and what of it its state lets through.

    Attributes:
        handlers: by the identifier's four bytes.
    """

    def __init__(self) -> None:
        self.handlers: dict[bytes, Handler] = {}
        self._wanted: dict[int, None] = {}

    def add(self, can_id: int, handler: Handler, is_active: bool) -> None:
        """Frames with this identifier are wanted; in this state or in another one."""
        self.want(can_id)
        if is_active:
            key = can_id.to_bytes(4, "little")
            taken = self.handlers.get(key)
            self.handlers[key] = handler if taken is None else _Both(taken, handler).receive

    def want(self, can_id: int) -> None:
        """Frames with this identifier are wanted, whoever sees to them."""
        self._wanted[can_id] = None

    def identifiers(self) -> tuple[int, ...]:
        """All that are wanted, ascending."""
        return tuple(sorted(self._wanted))


@final
class _Both:
    """Two parts of the node listen to one identifier."""

    def __init__(self, first: Handler, second: Handler) -> None:
        self._first = first
        self._second = second

    def receive(self, frame: bytes, now_ns: int) -> None:
        self._first(frame, now_ns)
        self._second(frame, now_ns)
