"""Node guarding and life guarding (CiA 301, 7.2.8.2.1), the older monitoring protocol.

The NMT master polls each node by a remote frame. The node answers with its NMT state and a toggle
bit. The node in turn detects the loss of the polling: after 100Ch times 100Dh, beginning with the
first poll. A node with a heartbeat (1017h) is not guarded, because a node may use only one of the
two.
"""

from typing import Final, final

from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.canopen.shared import MS, NEVER, Outbox
from emulators.media.can_frame import RTR_FLAG, pack

_ERROR_CONTROL: Final = 0x700
_TOGGLE: Final = 0x80


@final
class NodeGuarding:
    """The slave side of guarding.

    Attributes:
        can_id: of the remote frames that poll this node, with their flag.
        deadline_ns: when the master is lost unless it polls before.
        is_lost: the master is lost, until it polls again.
    """

    def __init__(self, od: ObjectDictionary, node_id: int, outbox: Outbox) -> None:
        self._od = od
        self._answer_id = _ERROR_CONTROL + node_id
        self._outbox = outbox
        self._toggle = 0
        self._life_ns = 0
        self._is_asked = False
        self.can_id = self._answer_id | RTR_FLAG
        self.deadline_ns: int = NEVER
        self.is_lost = False

    def take_node_id(self, node_id: int) -> None:
        """Guard this node-ID from now on."""
        self._answer_id = _ERROR_CONTROL + node_id
        self.can_id = self._answer_id | RTR_FLAG

    def reset(self) -> None:
        """Start with toggle bit 0 and without a poll so far."""
        self._toggle = 0
        self._is_asked = self.is_lost = False
        self._life_ns = 0
        self._move(NEVER)

    def configure(self, now_ns: int) -> None:
        """Read 100Ch and 100Dh from the dictionary; 0 in one of them disables life guarding."""
        guard_ns = self._od.integer(0x100C, 0, 0) * MS
        self._life_ns = guard_ns * self._od.integer(0x100D, 0, 0)
        self._wait(now_ns)

    def receive(self, state: int, now_ns: int) -> bool:
        """Answer a poll of the master; return True if it had been lost."""
        if self._od.integer(0x1017, 0, 0):
            return False
        self._outbox.frames.append(pack(self._answer_id, bytes((state | self._toggle,))))
        self._toggle ^= _TOGGLE
        self._is_asked = True
        was_lost, self.is_lost = self.is_lost, False
        self._wait(now_ns)
        return was_lost

    def expire(self) -> int:
        """Mark the master as lost and return how long it had not polled [ms]."""
        self.is_lost = True
        self._move(NEVER)
        return self._life_ns // MS

    def _wait(self, now_ns: int) -> None:
        is_watching = self._is_asked and self._life_ns and not self.is_lost
        self._move(now_ns + self._life_ns if is_watching else NEVER)

    def _move(self, deadline_ns: int) -> None:
        self.deadline_ns = deadline_ns
        self._outbox.deadlines_moved = True
