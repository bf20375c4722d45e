"""Error control (CiA 301, 7.2.8): heartbeats sent and watched, node guarding, and who is lost.

What a loss does to the NMT state (1029h) is the node's affair, what it does to the device its
host's.
"""

from typing import Final, final

from emulators.canopen.emcy import HEARTBEAT_KEY, HEARTBEAT_LOST, EmcyProducer
from emulators.canopen.guarding import NodeGuarding
from emulators.canopen.heartbeat import HeartbeatConsumer, HeartbeatProducer
from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.canopen.shared import NEVER, Outbox

NOBODY: Final = 0  # the node-ID that stands for whoever guards this one


@final
class ErrorControl:
    """Heartbeat producer and consumer, and node guarding.

    Attributes:
        state: the NMT state that is told.
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
        """The node has another node-ID."""
        self._producer.take_node_id(node_id)
        self._guarding.take_node_id(node_id)

    def stop(self) -> None:
        """INITIALISING: nothing is sent; `reset`, which must follow, forgets who was watched."""
        self._producer.stop()
        self._find_deadline()

    def reset(self, now_ns: int) -> None:
        """All is what the dictionary says now, and nobody was ever heard."""
        self._guarding.reset()
        self._guarding.configure(now_ns)
        self._consumer.configure()
        self._find_deadline()

    def boot_up(self, now_ns: int) -> None:
        """The boot-up message goes out."""
        self._producer.boot_up(now_ns)
        self._find_deadline()

    def configure(self, index: int, now_ns: int) -> None:
        """100Ch, 100Dh, 1016h or 1017h was written."""
        if index == 0x1016:
            for node_id in self._consumer.configure():
                self._emcy.repair(HEARTBEAT_KEY + node_id, now_ns)
        elif index == 0x1017:
            self._producer.configure(now_ns)
        else:
            self._guarding.configure(now_ns)
        self._find_deadline()

    def guard_id(self) -> int:
        """The identifier of the remote frames that guard this node, with their flag."""
        return self._guarding.can_id

    def heartbeat_ids(self) -> list[int]:
        """The identifiers of the heartbeats watched."""
        return self._consumer.can_ids()

    def heartbeat(self, frame: bytes, now_ns: int) -> None:
        """A heartbeat that is watched came."""
        can_id = frame[0] | frame[1] << 8
        if frame[4] and self._consumer.receive(can_id, now_ns):
            self._emcy.repair(HEARTBEAT_KEY + (can_id & 0x7F), now_ns)
        self._find_deadline()

    def guard(self, _frame: bytes, now_ns: int) -> None:
        """The NMT master asks this node."""
        if self._guarding.receive(self.state, now_ns):
            self._emcy.repair(HEARTBEAT_KEY, now_ns)
        self._find_deadline()

    def expire(self, now_ns: int) -> list[int]:
        """What is due is done; answers with the node-IDs lost now, or NOBODY guards this one."""
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
        """EMCY and an event about one of those that `expire` answered with."""
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
