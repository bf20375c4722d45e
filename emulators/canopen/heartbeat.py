"""Heartbeat (CiA 301, 7.2.8.2.2): producer (1017h) and consumer (1016h)."""

from typing import Final, final

from emulators.canopen.abort_code import AbortCode
from emulators.canopen.object_dictionary import ObjectDictionary
from emulators.canopen.shared import MS, NEVER, Outbox
from emulators.media.can_frame import pack

_ERROR_CONTROL: Final = 0x700


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
        self._watches: list[_Watch] = []
        self.deadline_ns: int = NEVER
        for subindex in od.subindices(0x1016):
            variable = od.get(0x1016, subindex)
            if subindex and variable is not None:
                variable.writer = _EntryCheck(od, subindex).check

    def configure(self) -> list[int]:
        """Watch the nodes of 1016h, starting when they are first heard.

        Returns:
            The nodes that were lost until now.
        """
        lost = [watch.node_id for watch in self._watches if watch.is_lost]
        self._watches = []
        for subindex in self._od.subindices(0x1016):
            entry = self._od.integer(0x1016, subindex, 0) if subindex else 0
            node_id, period_ns = entry >> 16 & 0xFF, (entry & 0xFFFF) * MS
            if 1 <= node_id <= 127 and period_ns:
                self._watches.append(_Watch(node_id, period_ns))
        self._find_deadline()
        return lost

    def can_ids(self) -> list[int]:
        """Return the identifiers of the watched heartbeats."""
        return [_ERROR_CONTROL + watch.node_id for watch in self._watches]

    def receive(self, can_id: int, now_ns: int) -> bool:
        """Process a heartbeat or boot-up; return True if that node had been lost."""
        for watch in self._watches:
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
        for watch in self._watches:
            if watch.deadline_ns <= now_ns:
                watch.deadline_ns = NEVER
                watch.is_lost = True
                lost.append(watch.node_id)
        self._find_deadline()
        return lost

    def _find_deadline(self) -> None:
        deadline_ns = NEVER
        for watch in self._watches:
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
