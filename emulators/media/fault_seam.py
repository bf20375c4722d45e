"""Where the faults of a plan meet the traffic of a bus: who hears what, and when."""

from collections.abc import Sequence
from heapq import heappop, heappush
from typing import Final, final

from emulators.media.can_frame import pack
from emulators.media.delivery import DELIVERED, HEARD, LOST, Delivery, kind_without
from emulators.media.fault_rule import FaultKind
from emulators.media.faults import NEVER_NS, FaultPlan

# the sender's error flag (6), the last bit of the overload flags that answer it, a delimiter (8)
ERROR_FRAME_BITS: Final = 15


@final
class FaultSeam:
    """What a bus with a fault plan knows besides; a bus without faults never comes here.

    Memory grows by what is heard later and not yet due, and as `FaultPlan` says.

    Attributes: plan; deaf_mask, the ports that are alone and hear nothing as bits 1 << number
    (whoever has the bus writes it).
    """

    def __init__(self, plan: FaultPlan) -> None:
        self.plan = plan
        self.deaf_mask = 0
        self._names: list[str] = []
        self._late: list[tuple[int, int, bytes, int, int]] = []  # heap: due, turn, frame, port, hit
        self._turn = 0
        self._next_change_ns = NEVER_NS

    def is_idle(self) -> bool:
        """Whether nothing is wrong, and nothing can go wrong."""
        return not self._late and self.plan.is_empty()

    def attach(self, name: str) -> None:
        """The next port has this name."""
        self._names.append(name)

    def next_ns(self) -> int:
        """When a rule begins or is over, or a frame is heard late; NEVER_NS if nothing is due."""
        if not self._late:
            return self._next_change_ns
        due_ns = self._late[0][0]
        return self._next_change_ns if 0 <= self._next_change_ns < due_ns else due_ns

    def is_change_due(self, now_ns: int) -> bool:
        """Whether a rule begins or is over now, or should have before."""
        return 0 <= self._next_change_ns <= now_ns

    def keep(self, now_ns: int) -> bool:
        """Whether other rules last now than when last asked."""
        changed = self.plan.keep(now_ns)
        self._next_change_ns = self.plan.next_change_ns(now_ns)
        return changed

    def babbles(self) -> list[tuple[int, bytes]]:
        """(port, frame) of who babbles now."""
        return [
            (self._names.index(rule.sender), pack(rule.identifier, rule.data))
            for rule in self.plan.lasting(FaultKind.BABBLE)
            if rule.sender in self._names and rule.identifier is not None
        ]

    def hear_late(self, now_ns: int, out: list[Delivery]) -> None:
        """Appends the frames whose delay is over."""
        while self._late and self._late[0][0] <= now_ns:
            _, _, frame, port, hit = heappop(self._late)
            self._tell(out, frame, port, HEARD, hit & ~self.deaf_mask)

    def complete(
        self, frame: bytes, port: int, now_ns: int, ears: int, silent: bool, out: list[Delivery]
    ) -> bool:
        """A frame has gone over the bus; appends to `out` what came of it.

        Args:
            frame: as it was sent.
            port: of its sender.
            now_ns: when it was complete [ns].
            ears: mask of the ports that it has reached.
            silent: its sender is not told: nobody has submitted it.
            out: what the bus delivers.

        Returns:
            Whether the sender believes it failed, and sends it again.
        """
        rule = self.plan.verdict(frame, self._names[port], now_ns)
        if rule is None:
            self.deliver(frame, port, ears, silent, out)
            return False
        hit = self.mask(rule.ports) if rule.ports else -1
        if rule.kind is FaultKind.DUPLICATE:
            self.hear(frame, port, hit & ears, out)
            return True
        self.deliver(frame, port, ears & ~hit, silent, out)
        if rule.kind is FaultKind.DELAY:
            self._turn += 1
            heappush(self._late, (now_ns + rule.delay_ns, self._turn, frame, port, hit & ears))
        elif rule.kind is FaultKind.CORRUPT:
            self.hear(self.plan.corrupted(rule, frame), port, hit & ears, out)
        return False

    def deliver(
        self, frame: bytes, port: int, ears: int, silent: bool, out: list[Delivery]
    ) -> None:
        """The frame reaches these ports, and its sender knows that it was sent."""
        self._tell(out, frame, port, HEARD if silent else DELIVERED, ears)

    def hear(self, frame: bytes, port: int, ears: int, out: list[Delivery]) -> None:
        """The frame reaches these ports; its sender is told nothing."""
        self._tell(out, frame, port, HEARD, ears)

    def mask(self, names: Sequence[str]) -> int:
        """The ports of these names; names of no port are nobody."""
        mask = 0
        for number, name in enumerate(self._names):
            if name in names:
                mask |= 1 << number
        return mask

    def _tell(self, out: list[Delivery], frame: bytes, port: int, kind: int, ears: int) -> None:
        """Appends a delivery to the ports of a mask; nobody left to hear it makes it LOST."""
        others = ((1 << len(self._names)) - 1) & ~(1 << port)
        if others & ears:
            out.append((frame, port, kind_without(kind, others & ~ears)))
        elif kind == DELIVERED:
            out.append((frame, port, LOST))
