"""Occupation of an I/O node by the servos of one process.

The outputs of a node share frames, and its digital outputs one byte. So a process that commands one
of its motors commands the whole node. The node is occupied while a servo of this process is on, and
while outputs are sent.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.node import CanopenNode
from motorhil.motorapi.locking.process_lock import this_process
from motorhil.motorapi.ownership.claim import LockAction
from motorhil.motorapi.ownership.fencing import BoundFence, Fence, NodeFence, tell_bus

if TYPE_CHECKING:
    from motorhil.motorapi.locking.process_lock import LockHandle, ProcessLock


@final
class NodeOccupation:
    """The occupation of one node by this process.

    Attributes:
        fence: the fence for frames that command the node; None: no other process can take it over.
        outputs: the fence for the servos' own frames, under one occupation.
    """

    def __init__(self, lock: "ProcessLock | None", node: CanopenNode) -> None:
        self._lock: Final = lock
        self._bus: Final = node.link.bus
        self._node: Final = node
        self._runtime: Final = node.link.runtime
        self._token = 0
        self.fence: Final = (
            None if lock is None else NodeFence(lock, self, self._runtime, self._bus, node.node_id)
        )
        self.outputs: Fence | None = self.fence

    @property
    def is_here(self) -> bool:
        """True if this process occupies the node."""
        hold = None if self._lock is None else self._lock.hold
        return hold is not None and hold.owner is self

    def begin_write(self, asker: str = "") -> int:
        """Begin a write under the lock; see class `Owned`."""
        assert self._lock is not None
        return self._lock.begin_write(asker)

    def end_write(self) -> None:
        """End a write; see `begin_write`."""
        assert self._lock is not None
        self._lock.end_write()

    def occupy(self, *, take_over: bool = False) -> "LockHandle | None":
        """Occupy the node for this process, until the returned handle is released.

        Args:
            take_over: take the node over from another process; its servo then ends.

        Raises:
            MotorBusyError: another process's servo runs on the node; the message names it.
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
        """Occupy the node inside the block, as `occupy` does."""
        hold = self.occupy(take_over=take_over)
        try:
            yield
        finally:
            if hold is not None:
                hold.release()
