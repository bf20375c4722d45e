"""Whose servos run on an I/O node: those of one process, however many motors there are on it.

Its outputs share frames, and its digital outputs one byte; so whoever commands one of its motors
commands the node. It is occupied as long as a servo of this process is on, and as outputs are sent.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, final

from motorapi.fencing import BoundFence, Fence, NodeFence, tell_bus
from motorapi.ownership_events import LockAction
from motorapi.process_lock import this_process

if TYPE_CHECKING:
    import can

    from motorapi.adaptations.drive_node import DriveNode
    from motorapi.process_lock import Hold, ProcessLock


@final
class NodeOccupation:
    """One node, as a process has it for its servos.

    Attributes:
        fence: lets out what commands the node; None: no other process can take it over.
        outputs: the same for what its servos send by themselves, under one occupation.
    """

    def __init__(self, lock: "ProcessLock | None", bus: "can.BusABC", node: "DriveNode") -> None:
        self._lock: Final = lock
        self._bus: Final = bus
        self._node: Final = node
        self._runtime: Final = node.link.runtime
        self._token = 0
        self.fence: Final = (
            None if lock is None else NodeFence(lock, self, self._runtime, bus, node.node_id)
        )
        self.outputs: Fence | None = self.fence

    @property
    def is_here(self) -> bool:
        """Whether this process has it."""
        hold = None if self._lock is None else self._lock.hold
        return hold is not None and hold.owner is self

    def begin_write(self, asker: str = "") -> int:
        """See `motorapi.fencing.Owned`; for the lock that there is."""
        assert self._lock is not None
        return self._lock.begin_write(asker)

    def end_write(self) -> None:
        """See `begin_write`."""
        assert self._lock is not None
        self._lock.end_write()

    def occupy(self, *, take_over: bool = False) -> "Hold | None":
        """The node is this process's, until what is returned is released.

        Args:
            take_over: also where another process's servo runs on it, which then ends.

        Raises:
            MotorBusyError: another process's servo runs on it; says whose.
        """
        lock = self._lock
        if lock is None or self.fence is None:
            return None
        label = self._node.label
        what = f"the servo of {label}"
        hold = lock.acquire(self._runtime, what, owner=self, asker=label, take_over=take_over)
        if hold.token != self._token:
            self._token = hold.token
            self.outputs = BoundFence(self.fence, hold)
            action = LockAction.TAKEN_OVER if take_over else LockAction.TAKEN
            process = this_process()
            facts: dict[str, str | int] = {
                "owner": what,
                "program": process.program,
                "pid": process.pid,
            }
            tell_bus(self._bus, self._node.node_id, action, hold.token, facts)
        return hold

    @contextmanager
    def occupied(self, *, take_over: bool = False) -> Iterator[None]:
        """The node is this process's inside the block. As `occupy`."""
        hold = self.occupy(take_over=take_over)
        try:
            yield
        finally:
            if hold is not None:
                hold.release()
