"""Fencing at the wire: a commanding frame goes out only while its sender owns the motor.

Who owns a motor may be paused for any time between two of its steps (by SIGSTOP, a debugger, a
long garbage collection), and lose the motor meanwhile without knowing it. So that it cannot command
it afterwards, the look whether it still owns it and the sending of the frame are one step
(`begin_write` to `end_write`): whoever takes a motor over waits for the end of such a step, and no
new one begins. A hub refuses what is still on its way to it then, by the token of the ownership.

*Commanding* is what may start or change a motion or a setting: RPDOs, controlwords that enable or
start, streamed set-points, each request of an SDO download, the SYNC that starts what is armed, NMT
to the node, the outputs of a servo on the host. *Stops are not fenced*: stopping takes nobody's
permission. Neither are questions.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final, Protocol, final, runtime_checkable

if TYPE_CHECKING:
    import can

    from motorapi.runtime import Runtime


class Fence(Protocol):
    """Lets frames out only while their sender owns what they command."""

    def send(self, frame: bytes) -> None:
        """The frame waits its turn on the bus.

        Raises:
            MotorBusyError: somebody else owns the motor; says who, and how that came.
        """

    def begin(self) -> int:
        """Nobody can take the motor over until `end`; the token. Raises as `send`."""

    def end(self) -> None:
        """What was begun is over."""


class Fencing(Protocol):
    """Who owns something that others may take over (an Ownership, a lock between processes)."""

    def begin_write(self) -> int:
        """The token; nobody can take it over until `end_write`.

        Raises:
            MotorBusyError: it is not owned here, or no more.
        """

    def end_write(self) -> None:
        """What was begun is over."""


@runtime_checkable
class FencedBus(Protocol):
    """A bus that looks at tokens itself (harness.can_plugin.EmulatedBus over a socket)."""

    def transmit_fenced(self, frame: bytes, resource: int, token: int) -> None:
        """The frame is queued; refused there if somebody has a greater token of the resource."""


@final
class NodeFence:
    """The Fence of one node, or of one motor on a node.

    Args:
        owned: who owns it.
        runtime: what the bus is sent on by, where it does not look at tokens.
        bus: the bus.
        resource: node-ID, + 256 times the channel where motors share a node.
    """

    def __init__(
        self, owned: Fencing, runtime: "Runtime", bus: "can.BusABC", resource: int
    ) -> None:
        self._owned: Final = owned
        self._runtime: Final = runtime
        self._bus: Final = bus
        self._resource: Final = resource
        self._transmit: Final[Callable[[bytes, int, int], None] | None] = (
            bus.transmit_fenced if isinstance(bus, FencedBus) else None
        )

    def begin(self) -> int:
        """See `Fence`."""
        return self._owned.begin_write()

    def end(self) -> None:
        """See `Fence`."""
        self._owned.end_write()

    def send(self, frame: bytes) -> None:
        """See `Fence`."""
        token = self._owned.begin_write()
        try:
            if self._transmit is None:
                self._runtime.send(self._bus, frame)
            else:
                self._transmit(frame, self._resource, token)
        finally:
            self._owned.end_write()


@final
class JointFence:
    """Lets out frames that command several motors, while all of them are owned."""

    def __init__(self, fences: "Sequence[Fence]") -> None:
        self._fences: Final = tuple(fences)

    def begin(self) -> int:
        """See `Fence`; the last one's token."""
        token = 0
        with ExitStack() as begun:
            for fence in self._fences:
                token = fence.begin()
                begun.callback(fence.end)
            begun.pop_all()
        return token

    def end(self) -> None:
        """See `Fence`."""
        with ExitStack() as ending:
            for fence in self._fences:
                ending.callback(fence.end)

    def send(self, frame: bytes) -> None:
        """See `Fence`. The frame passes the last one's, inside of all others'."""
        with ExitStack() as begun:
            for fence in self._fences[:-1]:
                fence.begin()
                begun.callback(fence.end)
            self._fences[-1].send(frame)


def joint_fence(fences: "Sequence[Fence]") -> Fence | None:
    """One Fence for all of these; None if there are none."""
    if len(fences) > 1:
        return JointFence(fences)
    return fences[0] if fences else None
