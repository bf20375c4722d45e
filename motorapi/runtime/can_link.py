"""One CAN bus as the host sends and receives on it: frames, their confirmation, bus status.

Frames are Linux can_frame (16 bytes) or canfd_frame (72 bytes). All hardware objects on one bus
object share one `CanLink`, which listens once. Received frames are dispatched by identifier, at the
cost of one dictionary look-up, however many drives there are. Own frames are reported when they
were *transmitted*. Arming rests on that: SYNC (080h) wins arbitration over any RPDO that still
waits (CiA 301 default identifiers), so a SYNC sent too early fires without that RPDO.
"""

import struct
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol, Self, final

from motorhil.motorapi.bus_context import context_of
from motorhil.motorapi.errors import DeadlineExceeded, LinkError, UsageError
from motorhil.motorapi.runtime.api import Registration, Runtime, wait_until
from motorhil.motorapi.runtime.can_sources import ERROR_BYTE, status_of

if TYPE_CHECKING:
    from types import TracebackType

    import can

_EFF: Final = 0x8000_0000
_RTR: Final = 0x4000_0000
_ERR: Final = 0x2000_0000
_ID_MAX: Final = 0x1FFF_FFFF
_FRAME: Final = struct.Struct("<IB3x8s")
_ID: Final = struct.Struct("<I")
_CAN_FRAME_BYTES: Final = 16
_UNCONFIRMED_MAX: Final = 1000
_KEPT_MAX: Final = 10_000

FrameHandler = Callable[[bytes, int], None]
"""A callback for frames with one identifier, called with (frame, time_ns)."""


class Gate(Protocol):
    """A gate that passes frames only while their sender may command (a `Fence`)."""

    def send(self, frame: bytes) -> None:
        """Queue the frame for transmission on the bus, or raise."""


def can_frame(can_id: int, data: bytes) -> bytes:
    """Return the Linux can_frame with this identifier (with its flags) and up to 8 bytes."""
    return _FRAME.pack(can_id, len(data), data)


@final
class Transmission:
    """One queued frame; `time_ns` is its time of completion on the bus, None before that."""

    __slots__ = ("frame", "time_ns")

    def __init__(self, frame: bytes) -> None:
        self.frame: bytes = frame
        self.time_ns: int | None = None


def all_sent(transmissions: Sequence[Transmission]) -> bool:
    """Return whether all of them were on the wire."""
    return all(one.time_ns is not None for one in transmissions)


@final
class Transmissions:
    """All frames that wait for one bus, by identifier."""

    def __init__(self, link: str) -> None:
        self._link: Final = link
        self._awaited: dict[bytes, deque[Transmission]] = {}

    def add(self, transmission: Transmission, confirms: bool) -> None:
        """Record a frame that waits for the bus; `confirms`: whether the bus reports own frames.

        Raises:
            LinkError: the bus has not transmitted anything for a long time.
        """
        key = transmission.frame[:4]
        waiting = self._awaited.get(key)
        if waiting is None:
            waiting = self._awaited[key] = deque()
        elif len(waiting) >= _UNCONFIRMED_MAX:
            if confirms:
                reason = f"{len(waiting)} frames wait, none is transmitted"
                raise LinkError(link=self._link, reason=reason)
            waiting.popleft()  # a bus that does not report own frames
        waiting.append(transmission)

    def remove(self, transmission: Transmission) -> None:
        """Remove a frame that was not sent."""
        self._awaited[transmission.frame[:4]].remove(transmission)

    def pending(self, key: bytes) -> Sequence[Transmission]:
        """Return the waiting frames with this identifier (its 4 bytes)."""
        return tuple(self._awaited.get(key, ()))

    def confirm(self, frame: bytes, time_ns: int) -> None:
        """Confirm the oldest equal frame with this identifier; earlier ones were never sent."""
        waiting = self._awaited.get(frame[:4])
        if not waiting:
            return
        for place, transmission in enumerate(waiting):
            if transmission.frame == frame:
                transmission.time_ns = time_ns
                for _ in range(place + 1):
                    waiting.popleft()
                return

    def forget(self) -> None:
        """Forget all frames: with the bus off they are lost."""
        self._awaited.clear()


@final
class _Subscribers:
    """The handlers of frames with one identifier, in the order of their subscription.

    Attributes:
        own: that of `CanLink.handle`, which is one; None: there is none.
        others: those of `CanLink.subscribe`.
    """

    def __init__(self) -> None:
        self.own: FrameHandler | None = None
        self.others: list[FrameHandler] = []

    def joined(self) -> FrameHandler | None:
        """Return one handler that calls them all, or None."""
        all_of = tuple(self.others) if self.own is None else (self.own, *self.others)
        if len(all_of) < 2:
            return all_of[0] if all_of else None

        def call_all(frame: bytes, time_ns: int) -> None:
            for handler in all_of:
                handler(frame, time_ns)

        return call_all


@final
class CanLink:
    """The host's end of one CAN bus; `open_link` returns a shared one.

    Attributes:
        bus: the bus object.
        runtime: the runtime for waits.
        users: the number of its users.
        name: the name of the bus in messages ("can0").
        status: the status of the bus, as its CAN controller reports it.
        on_bus_off: callbacks for the transition to bus-off.
        on_other: called with frames that no handler receives, or None.
        confirms: whether an own frame has ever been reported as transmitted.
    """

    def __init__(self, bus: "can.BusABC", runtime: Runtime) -> None:
        self.bus: Final = bus
        self.runtime: Final = runtime
        self.name: Final = bus_label(bus)
        self.status: Final = status_of(bus, self.name)
        self.on_bus_off: Final[list[Callable[[], None]]] = []
        self.on_other: FrameHandler | None = None
        self.confirms: bool = False
        self.users: int = 0
        self._subscribers: dict[tuple[bytes, bool], _Subscribers] = {}
        self._handlers: dict[bytes, FrameHandler] = {}
        self._fd_handlers: dict[bytes, FrameHandler] = {}
        self._sent_handlers: dict[bytes, FrameHandler] = {}
        self._transmissions = Transmissions(self.name)
        self._takes_fd = False
        self._registration: Registration = runtime.listen(bus, self._on_frame)

    def take_fd(self) -> None:
        """Receive CAN FD frames as well, from now on.

        Raises:
            UsageError: the bus object was opened for classical CAN.
        """
        if not self._takes_fd:
            before = self._registration
            self._registration = self.runtime.listen(self.bus, self._on_frame, fd=True)
            before.cancel()
            self._takes_fd = True

    def handle(self, can_id: int, handler: FrameHandler) -> None:
        """Dispatch frames with this identifier to `handler`, in place of the previous one."""
        key = _ID.pack(can_id)
        self._of(key, False).own = handler
        self._join(key, False)

    def subscribe(self, can_id: int, handler: FrameHandler, *, fd: bool = False) -> None:
        """Dispatch frames with this identifier also to `handler`; `fd`: those of CAN FD too."""
        key = _ID.pack(can_id)
        for of_fd in (False, True) if fd else (False,):
            self._of(key, of_fd).others.append(handler)
            self._join(key, of_fd)

    def unsubscribe(self, can_id: int, handler: FrameHandler) -> None:
        """End what `subscribe` began."""
        key = _ID.pack(can_id)
        for of_fd in (False, True):
            if handler in self._of(key, of_fd).others:
                self._of(key, of_fd).others.remove(handler)
            self._join(key, of_fd)

    def _of(self, key: bytes, of_fd: bool) -> _Subscribers:
        return self._subscribers.setdefault((key, of_fd), _Subscribers())

    def _join(self, key: bytes, of_fd: bool) -> None:
        """Update the table of handlers after a change of the subscribers."""
        table = self._fd_handlers if of_fd else self._handlers
        handler = self._of(key, of_fd).joined()
        if handler is None:
            table.pop(key, None)
            del self._subscribers[key, of_fd]
        else:
            table[key] = handler

    def handle_sent(self, can_id: int, handler: FrameHandler) -> None:
        """Pass own frames with this identifier to `handler` when they were transmitted."""
        self._sent_handlers[_ID.pack(can_id)] = handler

    def is_handled(self, can_id: int) -> bool:
        """Return whether received frames with this identifier have a handler."""
        return _ID.pack(can_id) in self._handlers

    def ignore(self, can_id: int) -> None:
        """End what `handle` began."""
        key = _ID.pack(can_id)
        self._of(key, False).own = None
        self._join(key, False)

    def send(self, frame: bytes, fence: Gate | None = None) -> None:
        """Queue a frame for transmission; a commanding frame only if its fence permits it.

        Raises:
            LinkError: the bus does not accept the frame, or is off.
            MotorBusyError: the fence refuses the frame: another program has taken the motor over.
        """
        if self.status.is_off:
            raise self.status.failure()
        try:
            if fence is None:
                self.runtime.send(self.bus, frame)
            else:
                fence.send(frame)
        except Exception as error:  # other errors than python-can's and the system's pass
            from can import CanError

            if isinstance(error, CanError | OSError):
                lost = LinkError(link=self.name, reason=f"cannot send: {error}")
                lost.__cause__ = error  # Compiled code loses the cause of `raise ... from`.
                raise lost from error
            raise

    def send_tracked(self, frame: bytes, fence: Gate | None = None) -> Transmission:
        """Queue a frame as `send` does; return the transmission, which holds the time of sending.

        Either all frames of an identifier must be sent tracked, or none.

        Raises:
            LinkError: the bus does not accept the frame, or has not transmitted for a long time.
            MotorBusyError: the fence refuses the frame.
        """
        return self.send_as(Transmission(frame), fence)

    def send_as(self, transmission: Transmission, fence: Gate | None = None) -> Transmission:
        """Queue a transmission that the caller has made, as `send_tracked` does.

        On the wall clock, another thread may hear an answer to the frame before this method has
        returned.

        Raises:
            LinkError: as `send_tracked`.
            MotorBusyError: as `send_tracked`.
        """
        self._transmissions.add(transmission, self.confirms)
        try:
            self.send(transmission.frame, fence)
        except BaseException:
            self._transmissions.remove(transmission)
            raise
        return transmission

    def confirmed(self, transmissions: Sequence[Transmission], timeout_s: float = 0.5) -> None:
        """Wait until all of these transmissions have been on the wire.

        Raises:
            LinkError: they were not within `timeout_s` [s], or the bus went off.
        """
        if self.wait_until(lambda: all_sent(transmissions), timeout_s):
            return
        missing = [one for one in transmissions if one.time_ns is None]
        can_id = _ID.unpack_from(missing[0].frame)[0] & _ID_MAX
        hint = ""
        if not self.confirms:
            hint = "; this bus never reported an own frame: open it with receive_own_messages=True"
        trouble = self.status.trouble()
        hint = f"; {trouble}" if trouble else hint
        raise LinkError(
            link=self.name,
            reason=f"{len(missing)} of {len(transmissions)} frames (first {can_id:03X}h) were not"
            f" transmitted within {timeout_s:g} s{hint}",
        )

    def pending(self, can_id: int) -> Sequence[Transmission]:
        """Return the tracked frames with this identifier that still wait for the bus.

        The result is empty if the bus does not report own frames.
        """
        return self._transmissions.pending(_ID.pack(can_id)) if self.confirms else ()

    def wait_until(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait like the runtime's `wait_until`, for a condition that only this bus can fulfil.

        Raises:
            LinkError: the bus is off, or went off while waiting.
        """
        status = self.status
        status.check()
        offs = status.offs
        over = self.runtime.wait_until(lambda: done() or status.offs != offs, timeout_s)
        if over and status.offs != offs and not done():
            raise status.failure()
        return over

    def _on_frame(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        if transmitted:
            self.confirms = True
            self._transmissions.confirm(frame, time_ns)
            handler = self._sent_handlers.get(frame[:4])
            if handler is not None:
                handler(frame, time_ns)
            if self.status.unacknowledged_ns is not None:
                self.status.sent()
            return
        if len(frame) != _CAN_FRAME_BYTES:
            handler = self._fd_handlers.get(frame[:4])
            if handler is not None:
                handler(frame, time_ns)
            return
        handler = self._handlers.get(frame[:4])
        if handler is not None:
            handler(frame, time_ns)
        elif frame[3] & ERROR_BYTE:
            self._on_error(frame, time_ns)
        elif self.on_other is not None:
            self.on_other(frame, time_ns)

    def _on_error(self, message: bytes, time_ns: int) -> None:
        """Handle an error frame of our own CAN controller."""
        status, offs = self.status, self.status.offs
        status.hear(message, time_ns)
        if status.offs != offs:
            self._transmissions.forget()
            for told in tuple(self.on_bus_off):
                told()

    def close(self) -> None:
        """Close the link: nothing is received afterwards."""
        self._registration.cancel()


def open_link(bus: "can.BusABC", runtime: Runtime, *, fd: bool = False) -> CanLink:
    """Return the link of this bus object, made on first use; `release_link` ends the use.

    Raises:
        UsageError: `fd`, and the bus object was opened for classical CAN.
    """
    link = context_of(bus).parts.part(CanLink, lambda: CanLink(bus, runtime))
    link.users += 1
    try:
        if fd:
            link.take_fd()
    except BaseException:
        release_link(link)
        raise
    return link


def release_link(link: CanLink) -> None:
    """Count one user of the link less; the last one closes it, not the bus object."""
    link.users -= 1
    if link.users == 0:
        context_of(link.bus).parts.drop(link)
        link.close()


def bus_label(bus: "can.BusABC") -> str:
    """Return the name of a bus in messages: its channel, if python-can knows it."""
    channel = getattr(bus, "channel", None)
    return str(channel) if channel is not None else str(bus.channel_info)


@final
@dataclass(frozen=True, slots=True)
class RawFrame:
    """One received frame: identifier (11 bits, or 29 if `extended`), data, time of completion."""

    can_id: int
    data: bytes
    time_ns: int
    extended: bool = False


def raw_frame(can_id: object, data: object, *, extended: bool) -> bytes:
    """Return the Linux can_frame with an identifier of 11 bits (29 if `extended`) and 0 to 8 bytes.

    Raises:
        UsageError: the identifier or the data is not valid.
    """
    highest = 0x1FFF_FFFF if extended else 0x7FF
    if not isinstance(can_id, int) or not 0 <= can_id <= highest:
        hint = "" if extended else "; longer ones need extended=True"
        raise UsageError(f"can_id = {can_id!r}: an identifier is 0 to {highest:X}h{hint}")
    if not isinstance(data, bytes | bytearray) or len(data) > 8:
        raise UsageError(f"data = {data!r}: a frame has up to 8 bytes")
    return can_frame(can_id | (_EFF if extended else 0), bytes(data))


@final
class FrameInbox:
    """Frames of other nodes received from now on, oldest first (the last 10,000), until `close`.

    Args:
        link: the link of the bus.
        can_ids: identifiers to receive, of 11 or 29 bits; none: all of them.
    """

    def __init__(self, link: CanLink, can_ids: Collection[int]) -> None:
        for can_id in can_ids:
            if not isinstance(can_id, int) or not 0 <= can_id <= 0x1FFF_FFFF:
                raise UsageError(f"can_id = {can_id!r}: an identifier is 0 to 1FFFFFFFh")
        self._link = link
        self._can_ids = frozenset(can_ids)
        self._frames: deque[RawFrame] = deque(maxlen=_KEPT_MAX)
        self._registration = link.runtime.listen(link.bus, self._on_frame)

    def _on_frame(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        word = int.from_bytes(frame[:4], "little")
        if transmitted or word & (_RTR | _ERR):
            return
        can_id = word & 0x1FFF_FFFF
        if not self._can_ids or can_id in self._can_ids:
            data = frame[8 : 8 + frame[4]]
            self._frames.append(RawFrame(can_id, data, time_ns, bool(word & _EFF)))

    def receive(self, timeout_s: float = 1.0) -> RawFrame:
        """Return the next frame.

        Raises:
            DeadlineExceeded: none came within `timeout_s` [s].
            LinkError: the bus is off.
        """
        frames, status = self._frames, self._link.status
        if not wait_until(self._link.runtime, lambda: bool(frames) or status.is_off, timeout_s):
            which = ", ".join(f"{can_id:03X}h" for can_id in sorted(self._can_ids)) or "any"
            raise DeadlineExceeded(
                awaited=f"a frame on {self._link.name} ({which})",
                timeout_s=timeout_s,
                last_heard="none of them",
            )
        if not frames:
            raise status.failure()
        return frames.popleft()

    def close(self) -> None:
        """Stop receiving."""
        self._registration.cancel()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: "type[BaseException] | None",
        error: BaseException | None,
        traceback: "TracebackType | None",
    ) -> None:
        self.close()
