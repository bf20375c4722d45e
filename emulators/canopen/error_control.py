"""Error control (CiA 301, 7.2.8): heartbeat producer and consumer, node guarding.

The node applies the effect of a loss on the NMT state (1029h). Its host applies the effect on the
device.

Heartbeat (CiA 301, 7.2.8.2.2) has a producer (1017h) and a consumer (1016h). Node guarding and life
guarding (CiA 301, 7.2.8.2.1) are the older protocol. The NMT master polls each node by a remote
frame. The node answers with its NMT state and a toggle bit. The node in turn detects the loss of
the polling: after 100Ch times 100Dh, beginning with the first poll. A node with a heartbeat (1017h)
is not guarded, because a node may use only one of the two.
"""

from typing import Final, final

from motorhil.emulators.can.frame import RTR_FLAG, pack
from motorhil.emulators.canopen.codes import AbortCode
from motorhil.emulators.canopen.emcy import HEARTBEAT_KEY, HEARTBEAT_LOST, EmcyProducer
from motorhil.emulators.canopen.object_dictionary import ObjectDictionary
from motorhil.emulators.canopen.outbox import MS, NEVER, Outbox

_ERROR_CONTROL: Final = 0x700

_TOGGLE: Final = 0x80

NOBODY: Final = 0  # stands for the unknown master that guards this node


@final
class HeartbeatProducer:
    """A producer that sends the NMT state every 1017h ms. The boot-up message is the first."""

    def __init__(self, od: ObjectDictionary, node_id: int, outbox: Outbox) -> None:
        self._od = od
        self._can_id = _ERROR_CONTROL + node_id
        self._outbox = outbox
        self._period_ns = 0
        self.deadline_ns: int = NEVER

    def take_node_id(self, node_id: int) -> None:
        """Send heartbeats of this node-ID from now on."""
        self._can_id = _ERROR_CONTROL + node_id

    def stop(self) -> None:
        """Stop sending."""
        self.deadline_ns = NEVER
        self._outbox.deadlines_moved = True

    def boot_up(self, now_ns: int) -> None:
        """Send the boot-up message; the first heartbeat follows one period later."""
        self._send(0)
        self._period_ns = self._od.integer(0x1017, 0, 0) * MS
        self.deadline_ns = now_ns + self._period_ns if self._period_ns else NEVER
        self._outbox.deadlines_moved = True

    def configure(self, now_ns: int) -> None:
        """Apply a write to 1017h: the first heartbeat is sent at once, 0 ends them."""
        self._period_ns = self._od.integer(0x1017, 0, 0) * MS
        self.deadline_ns = now_ns if self._period_ns else NEVER
        self._outbox.deadlines_moved = True

    def expire(self, state: int, now_ns: int) -> None:
        """Send a heartbeat; a delay of whole periods skips them."""
        self._send(state)
        self.deadline_ns += self._period_ns
        if self.deadline_ns <= now_ns:
            self.deadline_ns = now_ns + self._period_ns
        self._outbox.deadlines_moved = True

    def _send(self, state: int) -> None:
        self._outbox.frames.append(pack(self._can_id, bytes((state,))))


@final
class _Watch:
    """One entry of 1016h."""

    def __init__(self, node_id: int, period_ns: int) -> None:
        self.node_id = node_id
        self.period_ns = period_ns
        self.deadline_ns: int = NEVER  # not heard yet, or lost
        self.is_lost = False


@final
class HeartbeatConsumer:
    """A monitor of the nodes of 1016h; it starts with their first heartbeat or boot-up."""

    def __init__(self, od: ObjectDictionary, outbox: Outbox) -> None:
        self._od = od
        self._outbox = outbox
        self._watches: dict[int, _Watch] = {}  # by sub-index
        self.deadline_ns: int = NEVER
        for subindex in od.subindices(0x1016):
            variable = od.get(0x1016, subindex)
            if subindex and variable is not None:
                variable.writer = _EntryCheck(od, subindex).check

    def configure(self, written: int | None = None) -> list[int]:
        """Watch the nodes of 1016h, starting when they are first heard.

        Args:
            written: the only sub-index to watch anew; None: all.

        Returns:
            The nodes that were lost until now, and are watched anew or no longer.
        """
        before, self._watches = self._watches, {}
        for subindex in self._od.subindices(0x1016):
            if written not in (None, subindex):
                if subindex in before:
                    self._watches[subindex] = before.pop(subindex)
                continue
            entry = self._od.integer(0x1016, subindex, 0) if subindex else 0
            node_id, period_ns = entry >> 16 & 0xFF, (entry & 0xFFFF) * MS
            if 1 <= node_id <= 127 and period_ns:
                self._watches[subindex] = _Watch(node_id, period_ns)
        self._find_deadline()
        return [watch.node_id for watch in before.values() if watch.is_lost]

    def can_ids(self) -> list[int]:
        """Return the identifiers of the watched heartbeats."""
        return [_ERROR_CONTROL + watch.node_id for watch in self._watches.values()]

    def receive(self, can_id: int, now_ns: int) -> bool:
        """Process a heartbeat or boot-up; return True if that node had been lost."""
        for watch in self._watches.values():
            if watch.node_id == can_id - _ERROR_CONTROL:
                watch.deadline_ns = now_ns + watch.period_ns
                was_lost = watch.is_lost
                watch.is_lost = False
                self._find_deadline()
                return was_lost
        return False

    def expire(self, now_ns: int) -> list[int]:
        """Return the node-IDs lost now; each is reported once until it is heard again."""
        lost = []
        for watch in self._watches.values():
            if watch.deadline_ns <= now_ns:
                watch.deadline_ns = NEVER
                watch.is_lost = True
                lost.append(watch.node_id)
        self._find_deadline()
        return lost

    def _find_deadline(self) -> None:
        deadline_ns = NEVER
        for watch in self._watches.values():
            if watch.deadline_ns < deadline_ns:
                deadline_ns = watch.deadline_ns
        self.deadline_ns = deadline_ns
        self._outbox.deadlines_moved = True


@final
class _EntryCheck:
    """A check that no other entry of 1016h watches the same node-ID (CiA 301: 0604 0043h)."""

    def __init__(self, od: ObjectDictionary, subindex: int) -> None:
        self._od = od
        self._subindex = subindex

    def check(self, value: int) -> int:
        node_id = value >> 16 & 0xFF
        if not value & 0xFFFF or not 1 <= node_id <= 127:
            return 0
        for subindex in self._od.subindices(0x1016):
            other = self._od.integer(0x1016, subindex, 0)
            is_other = subindex not in (0, self._subindex)
            if is_other and other & 0xFFFF and other >> 16 & 0xFF == node_id:
                return AbortCode.PARAMETER_INCOMPATIBLE
        return 0


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
        self.can_id: int = self._answer_id | RTR_FLAG
        self.deadline_ns: int = NEVER
        self.is_lost: bool = False

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

    def configure(self, index: int, subindex: int, now_ns: int) -> None:
        """Apply a write to 100Ch, 100Dh, 1016h or 1017h."""
        if index == 0x1016:
            for node_id in self._consumer.configure(subindex):
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
