"""Fencing at the wire: a commanding frame goes out only while its sender owns the motor.

Who owns a motor may be paused for any time between two of its steps (by SIGSTOP, a debugger, a
long garbage collection), and lose the motor meanwhile without knowing it. So that it cannot command
it afterwards, the look whether it still owns it and the sending of the frame are one step
(`begin_write` to `end_write`): whoever takes a motor over waits for the end of such a step, and no
new one begins. A hub refuses what is still on its way to it then, by the token of the ownership.

*Commanding* is what may start or change a motion or a setting: RPDOs, controlwords that enable or
start, streamed set-points, each request of an SDO download, the SYNC that starts what is armed, NMT
to the node, the outputs of a servo on the host. *Stops are not fenced*: stopping takes nobody's
permission. Neither are questions. What goes on by itself (a stream of set-points, a servo, the
repetition of a stop) is bound to the very ownership it began under: it does not go on under a later
one of the same process.

Who works a hardware object by itself, without a motor, owns the motor for each frame, and for as
long as a stream goes on.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import TYPE_CHECKING, Final, Protocol, final, runtime_checkable

if TYPE_CHECKING:
    import can

    from motorapi.ownership import Ownership
    from motorapi.ownership_events import OwnershipEvent
    from motorapi.process_lock import Hold, ProcessLock
    from motorapi.runtime import Runtime

_DIRECTLY: Final = "a command by its hardware object"


class Fence(Protocol):
    """Lets frames out only while their sender owns what they command."""

    def send(self, frame: bytes) -> None:
        """The frame waits its turn on the bus.

        Raises:
            MotorBusyError: somebody else owns the motor; says who, and how that came.
        """

    def passage(self) -> AbstractContextManager[None]:
        """Nobody takes the motor over inside the block, which must be short. Raises as `send`."""


class Owned(Protocol):
    """Something that one owner of this process may have for himself (an Ownership)."""

    @property
    def is_here(self) -> bool:
        """Whether somebody of this process has it, as far as that one knows."""

    def begin_write(self, asker: str = "") -> int:
        """The token; nobody takes it over until `end_write`. Raises MotorBusyError: it was lost."""

    def end_write(self) -> None:
        """What was begun is over."""


@runtime_checkable
class FencedBus(Protocol):
    """A bus that looks at tokens itself (harness.can_plugin.EmulatedBus over a socket)."""

    def transmit_fenced(self, frame: bytes, resource: int, token: int) -> None:
        """The frame is queued; refused there if somebody has a greater token of the resource."""


@runtime_checkable
class AnnouncingBus(Protocol):
    """A bus that can be told who owns what (the same)."""

    def announce_ownership(
        self, resource: int, action: int, token: int, **facts: str | int
    ) -> None:
        """Said in the order of this and of frames; `facts` are those of an OwnershipEvent."""


@final
class NodeFence:
    """The Fence of one node, or of one motor on a node.

    Args:
        lock: whose token it is.
        owned: who has it in this process.
        runtime: sends on the bus, where that does not look at tokens.
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
        """The frame waits its turn on the bus; to be called between begin_write and end_write."""
        if self._transmit is None:
            self.runtime.send(self._bus, frame)
        else:
            self._transmit(frame, self._resource, token)

    def bound(self, purpose: str) -> "BoundFence":
        """For what goes on by itself: the Fence of this very ownership, or of an own one.

        Args:
            purpose: of an own one, where nobody of this process owns the motor.

        Raises:
            MotorBusyError: somebody else owns it.
        """
        own = self._own(purpose)
        hold = self.lock.hold if own is None else own
        if hold is None:
            raise self.lock.not_ours("")
        return BoundFence(self, hold, own)

    @property
    def is_owned(self) -> bool:
        """Whether this process owns it, as far as it knows."""
        return self._owned.is_here or self.lock.hold is not None

    def _own(self, purpose: str = _DIRECTLY) -> "Hold | None":
        """Where nobody of this process owns it: it is owned by whoever works the hardware."""
        if self.is_owned:
            return None
        return self.lock.acquire(self.runtime, purpose, owner=object())


@final
class BoundFence:
    """The Fence of one ownership: it lets nothing out under a later one. `release` ends its use."""

    def __init__(self, fence: NodeFence, hold: "Hold", own: "Hold | None" = None) -> None:
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
        """What was owned for it alone is owned no more; releasing again does nothing."""
        own, self._own = self._own, None
        if own is not None:
            own.release()


@final
class JointFence:
    """Lets out frames that command several motors, while all of them are owned."""

    def __init__(self, fences: Sequence[Fence]) -> None:
        self._fences: Final = tuple(fences)

    def send(self, frame: bytes) -> None:
        """See `Fence`. The frame passes the last one's, inside of all others'."""
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
    """One Fence for all of these; None if there are none."""
    if len(fences) > 1:
        return JointFence(fences)
    return fences[0] if fences else None


def announce(ownership: "Ownership", bus: "can.BusABC", resource: int) -> None:
    """What happens to the ownership is told to the bus, if that is one that listens."""
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


def tell_bus(
    bus: "can.BusABC", resource: int, action: int, token: int, facts: Mapping[str, str | int]
) -> None:
    """The bus is told of an ownership; if it has gone, whoever commands the motor learns that."""
    from can import CanError

    if isinstance(bus, AnnouncingBus):
        try:
            bus.announce_ownership(resource, action, token, **facts)
        except (CanError, OSError):
            return
