"""Error control (CiA 301, 7.2.8): heartbeat producer and consumer, node guarding.

The node applies the effect of a loss on the NMT state (1029h). Its host applies the effect on the
device.
"""

from typing import Final, final

from emulators.canopen.emcy import HEARTBEAT_KEY, HEARTBEAT_LOST, EmcyProducer
from emulators.canopen.guarding import NodeGuarding
from emulators.canopen.heartbeat import HeartbeatConsumer, HeartbeatProducer
from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.canopen.shared import NEVER, Outbox

NOBODY: Final = 0  # stands for the unknown master that guards this node


@final
class ErrorControl:
    """The heartbeat producer and consumer, and node guarding.

    Attributes:
        state: the reported NMT state.
        deadline_ns: when `expire` must be called.
    """

    def __init__(
        self, od: ObjectDictionary, node_id: int, emcy: EmcyProducer, outbox: Outbox
    ) -> None:
        self._emcy = emcy
        self._outbox = outbox
        self._producer = HeartbeatProducer(od, node_id, outbox)
        self._consumer = HeartbeatConsumer(od, outbox)
        self._guarding = NodeGuarding(od, node_id, outbox)
        self.state = 0
        self.deadline_ns: int = NEVER

    def take_node_id(self, node_id: int) -> None:
        """Use another node-ID."""
        self._producer.take_node_id(node_id)
        self._guarding.take_node_id(node_id)

    def stop(self) -> None:
        """Stop sending on INITIALISING; `reset`, which must follow, clears the watched nodes."""
        self._producer.stop()
        self._find_deadline()

    def reset(self, now_ns: int) -> None:
        """Read all settings from the dictionary and forget the nodes heard so far."""
        self._guarding.reset()
        self._guarding.configure(now_ns)
        self._consumer.configure()
        self._find_deadline()

    def boot_up(self, now_ns: int) -> None:
        """Send the boot-up message."""
        self._producer.boot_up(now_ns)
        self._find_deadline()

    def configure(self, index: int, now_ns: int) -> None:
        """Apply a write to 100Ch, 100Dh, 1016h or 1017h."""
        if index == 0x1016:
            for node_id in self._consumer.configure():
                self._emcy.repair(HEARTBEAT_KEY + node_id, now_ns)
        elif index == 0x1017:
            self._producer.configure(now_ns)
        else:
            self._guarding.configure(now_ns)
        self._find_deadline()

    def guard_id(self) -> int:
        """Return the identifier of the remote frames that guard this node, with their flag."""
        return self._guarding.can_id

    def heartbeat_ids(self) -> list[int]:
        """Return the identifiers of the watched heartbeats."""
        return self._consumer.can_ids()

    def heartbeat(self, frame: bytes, now_ns: int) -> None:
        """Process a watched heartbeat."""
        can_id = frame[0] | frame[1] << 8
        if frame[4] and self._consumer.receive(can_id, now_ns):
            self._emcy.repair(HEARTBEAT_KEY + (can_id & 0x7F), now_ns)
        self._find_deadline()

    def guard(self, _frame: bytes, now_ns: int) -> None:
        """Answer a guarding request of the NMT master."""
        if self._guarding.receive(self.state, now_ns):
            self._emcy.repair(HEARTBEAT_KEY, now_ns)
        self._find_deadline()

    def expire(self, now_ns: int) -> list[int]:
        """Process what is due and return the node-IDs lost now (NOBODY: this node's guard)."""
        lost: list[int] = []
        if self._producer.deadline_ns <= now_ns:
            self._producer.expire(self.state, now_ns)
        if self._consumer.deadline_ns <= now_ns:
            lost = self._consumer.expire(now_ns)
        if self._guarding.deadline_ns <= now_ns:
            lost.append(NOBODY)
        self._find_deadline()
        return lost

    def tell_lost(self, node_id: int, now_ns: int) -> None:
        """Report the loss of one of the nodes that `expire` returned, by EMCY and event."""
        if node_id == NOBODY:
            text = f"not guarded for {self._guarding.expire()} ms"
        else:
            text = f"heartbeat of node {node_id} lost"
        self._outbox.events.append(("warning", text))
        vendor = bytes((node_id,)) if node_id else b""
        self._emcy.find(HEARTBEAT_KEY + node_id, HEARTBEAT_LOST, vendor, now_ns)
        self._find_deadline()

    def _find_deadline(self) -> None:
        deadline_ns = self._producer.deadline_ns
        if self._consumer.deadline_ns < deadline_ns:
            deadline_ns = self._consumer.deadline_ns
        if self._guarding.deadline_ns < deadline_ns:
            deadline_ns = self._guarding.deadline_ns
        self.deadline_ns = deadline_ns
