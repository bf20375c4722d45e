"""Fencing: commanding frames are sent only while their sender owns the motor.

The owner of a motor may be paused between any two steps (by SIGSTOP, a debugger, a long garbage
collection), and lose the motor without knowing it. Then it must not command the motor.
Therefore the ownership check and the transmission of a frame are one step (`begin_write` to
`end_write`). A takeover waits for the end of such a step, and no new step begins. A hub refuses
frames still under way at that time, by the token of the ownership.

*Commanding* frames may start or change a motion or a setting: RPDOs, controlwords that enable or
start, streamed set-points, each request of an SDO download, the SYNC that starts armed drives, NMT
commands to the node, the outputs of a servo on the host. *Stops are not fenced*: a stop needs no
ownership. Read requests are not fenced either. Recurring transmissions (a stream of set-points, a
servo, a repeated stop) are bound to the ownership under which they began; they do not continue
under a later one of the same process.

Code that uses a hardware object directly, without a motor, owns the motor for each frame, and for
the duration of a stream.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import TYPE_CHECKING, Final, Protocol, final, runtime_checkable

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.locking.process_lock import LockHandle, ProcessLock
    from motorhil.motorapi.ownership.claim import OwnershipEvent
    from motorhil.motorapi.ownership.ownership import Ownership
    from motorhil.motorapi.runtime.api import Runtime

_DIRECTLY: Final = "a command by its hardware object"


class Fence(Protocol):
    """A gate that passes frames only while their sender owns the commanded motor."""

    def send(self, frame: bytes) -> None:
        """Queue the frame for transmission on the bus.

        Raises:
            MotorBusyError: another owner holds the motor; the message names it and the reason.
        """

    def passage(self) -> AbstractContextManager[None]:
        """Return a context that blocks takeovers; keep it short. Raises as `send`."""


class Owned(Protocol):
    """A resource with at most one owner in this process (an Ownership)."""

    @property
    def is_here(self) -> bool:
        """True if this process owns the resource, to its own knowledge."""

    def begin_write(self, asker: str = "") -> int:
        """Block takeovers until `end_write`. Return the token. Raise MotorBusyError if lost."""

    def end_write(self) -> None:
        """End the step begun by `begin_write`."""


@runtime_checkable
class FencedBus(Protocol):
    """A bus that checks tokens itself (an `EmulatedBus` over a socket)."""

    def transmit_fenced(self, frame: bytes, resource: int, token: int) -> None:
        """Queue the frame; the bus refuses it if the resource has a greater token."""

    def check_token(self, resource: int, token: int) -> None:
        """Raise MotorBusyError if the bus has refused frames with this token; names the owner."""


@runtime_checkable
class AnnouncingBus(Protocol):
    """A bus that accepts ownership announcements (motorhil.harness.python_can.bus.EmulatedBus)."""

    def announce_ownership(
        self, resource: int, action: int, token: int, **facts: str | int
    ) -> None:
        """Announce an ownership, in order with frames; `facts` are those of an OwnershipEvent."""


@final
class NodeFence:
    """The Fence of one node, or of one motor on a node.

    Args:
        lock: the lock that holds the token.
        owned: the ownership in this process.
        runtime: sends frames, if the bus does not check tokens.
        bus: the bus.
        resource: node-ID, + 256 times the channel where motors share a node.
    """

    def __init__(
        self,
        lock: "ProcessLock",
        owned: Owned,
        runtime: "Runtime",
        bus: "can.BusABC",
        resource: int,
    ) -> None:
        self.lock: Final = lock
        self.runtime: Final = runtime
        self._owned: Final = owned
        self._bus: Final = bus
        self._resource: Final = resource
        self._transmit: Final[Callable[[bytes, int, int], None] | None] = (
            bus.transmit_fenced if isinstance(bus, FencedBus) else None
        )

    def send(self, frame: bytes) -> None:
        """See `Fence`."""
        own = self._own()
        try:
            token = self._owned.begin_write()
            try:
                self.let_out(frame, token)
            finally:
                self._owned.end_write()
        finally:
            if own is not None:
                own.release()

    @contextmanager
    def passage(self) -> Iterator[None]:
        """See `Fence`."""
        own = self._own()
        try:
            self._owned.begin_write()
            try:
                yield
            finally:
                self._owned.end_write()
        finally:
            if own is not None:
                own.release()

    def let_out(self, frame: bytes, token: int) -> None:
        """Queue the frame; call this only between begin_write and end_write."""
        if self._transmit is None:
            self.runtime.send(self._bus, frame)
        else:
            self._transmit(frame, self._resource, token)

    def check(self) -> None:
        """Raise MotorBusyError if the bus has refused frames of the present ownership.

        A refused frame has no answer. So whoever missed an answer calls this for the reason.
        """
        hold = self.lock.hold
        if hold is not None and isinstance(self._bus, FencedBus):
            self._bus.check_token(self._resource, hold.token)

    def bound(self, purpose: str) -> "BoundFence":
        """Return a Fence bound to the present ownership, or to a new one, for recurring frames.

        Args:
            purpose: purpose of a new ownership, if this process does not own the motor.

        Raises:
            MotorBusyError: another owner holds the motor.
        """
        own = self._own(purpose)
        hold = self.lock.hold if own is None else own
        if hold is None:
            raise self.lock.not_ours("")
        return BoundFence(self, hold, own)

    @property
    def is_owned(self) -> bool:
        """True if this process owns the motor, to its own knowledge."""
        return self._owned.is_here or self.lock.hold is not None

    def _own(self, purpose: str = _DIRECTLY) -> "LockHandle | None":
        """Acquire the motor for direct hardware use, if this process does not own it."""
        if self.is_owned:
            return None
        return self.lock.acquire(self.runtime, purpose, owner=object())


@final
class BoundFence:
    """The Fence of one ownership, closed under any later one. `release` ends its use."""

    def __init__(
        self, fence: NodeFence, hold: "LockHandle", own: "LockHandle | None" = None
    ) -> None:
        self._fence: Final = fence
        self._hold: Final = hold
        self._own = own

    def send(self, frame: bytes) -> None:
        """See `Fence`."""
        hold = self._hold
        hold.begin_write("")
        try:
            self._fence.let_out(frame, hold.token)
        finally:
            hold.end_write()

    @contextmanager
    def passage(self) -> Iterator[None]:
        """See `Fence`."""
        self._hold.begin_write("")
        try:
            yield
        finally:
            self._hold.end_write()

    def release(self) -> None:
        """Release the ownership acquired for this fence only; releasing again does nothing."""
        own, self._own = self._own, None
        if own is not None:
            own.release()


@final
class JointFence:
    """A Fence for frames that command several motors, open while all of them are owned."""

    def __init__(self, fences: Sequence[Fence]) -> None:
        self._fences: Final = tuple(fences)

    def send(self, frame: bytes) -> None:
        """See `Fence`. The last fence sends the frame, inside the passages of all others."""
        with ExitStack() as passing:
            for fence in self._fences[:-1]:
                passing.enter_context(fence.passage())
            self._fences[-1].send(frame)

    @contextmanager
    def passage(self) -> Iterator[None]:
        """See `Fence`."""
        with ExitStack() as passing:
            for fence in self._fences:
                passing.enter_context(fence.passage())
            yield


def joint_fence(fences: Sequence[Fence]) -> Fence | None:
    """Return one Fence for all of `fences`, or None if there are none."""
    if len(fences) > 1:
        return JointFence(fences)
    return fences[0] if fences else None


def announce(ownership: "Ownership", bus: "can.BusABC", resource: int) -> None:
    """Report every event of the ownership to the bus, if it accepts announcements."""
    if not isinstance(bus, AnnouncingBus):
        return

    def tell(event: "OwnershipEvent") -> None:
        facts: dict[str, str | int] = {
            "owner": event.owner,
            "holder": event.holder,
            "purpose": event.purpose,
            "program": event.program,
            "pid": event.pid,
            "waited_ns": round(event.waited_s * 1e9),
            "held_ns": round(event.held_s * 1e9),
        }
        tell_bus(bus, resource, event.action, event.token, facts)

    ownership.listeners.append(tell)
    ownership.is_announced = True


def tell_bus(
    bus: "can.BusABC", resource: int, action: int, token: int, facts: Mapping[str, str | int]
) -> None:
    """Announce an ownership to the bus; a lost bus is reported by the next command instead."""
    from can import CanError

    if isinstance(bus, AnnouncingBus):
        try:
            bus.announce_ownership(resource, action, token, **facts)
        except (CanError, OSError):
            return
