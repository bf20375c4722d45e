"""Seam between a fault plan and the traffic of a bus."""

from collections.abc import Sequence
from heapq import heappop, heappush
from typing import Final, final

from emulators.media.can_frame import pack
from emulators.media.delivery import DELIVERED, HEARD, LOST, Delivery, kind_without
from emulators.media.fault_rule import FaultKind
from emulators.media.faults import NEVER_NS, FaultPlan

# the sender's error flag (6), the last bit of the overload flags that follow it, a delimiter (8)
ERROR_FRAME_BITS: Final = 15


@final
class FaultSeam:
    """The additional state of a bus with a fault plan; not used without faults.

    Memory grows with the delayed frames, and as `FaultPlan` says.

    Attributes: plan; deaf_mask, the ports (1 << number) that are alone and hear nothing (written by
    the bus).
    """

    def __init__(self, plan: FaultPlan) -> None:
        self.plan = plan
        self.deaf_mask = 0
        self._names: list[str] = []
        self._late: list[tuple[int, int, bytes, int, int]] = []  # heap: due, turn, frame, port, hit
        self._turn = 0
        self._next_change_ns = NEVER_NS

    def is_idle(self) -> bool:
        """Return whether no fault is active or possible."""
        return not self._late and self.plan.is_empty()

    def attach(self, name: str) -> None:
        """Add the next port, with this name."""
        self._names.append(name)

    def next_ns(self) -> int:
        """Return when a rule changes or a late frame is heard; NEVER_NS if nothing is due."""
        if not self._late:
            return self._next_change_ns
        due_ns = self._late[0][0]
        return self._next_change_ns if 0 <= self._next_change_ns < due_ns else due_ns

    def is_change_due(self, now_ns: int) -> bool:
        """Return whether a rule begins or ends now, or should have before."""
        return 0 <= self._next_change_ns <= now_ns

    def keep(self, now_ns: int) -> bool:
        """Update the lasting rules and return whether they have changed since the last call."""
        changed = self.plan.keep(now_ns)
        self._next_change_ns = self.plan.next_change_ns(now_ns)
        return changed

    def babbles(self) -> list[tuple[int, bytes]]:
        """Return (port, frame) of each node that babbles now."""
        return [
            (self._names.index(rule.sender), pack(rule.identifier, rule.data))
            for rule in self.plan.lasting(FaultKind.BABBLE)
            if rule.sender in self._names and rule.identifier is not None
        ]

    def hear_late(self, now_ns: int, out: list[Delivery]) -> None:
        """Append the frames whose delay is over."""
        while self._late and self._late[0][0] <= now_ns:
            _, _, frame, port, hit = heappop(self._late)
            self._tell(out, frame, port, HEARD, hit & ~self.deaf_mask)

    def complete(
        self, frame: bytes, port: int, now_ns: int, ears: int, silent: bool, out: list[Delivery]
    ) -> bool:
        """Apply the fault rules to a complete frame and append the deliveries to `out`.

        Args:
            frame: as it was sent.
            port: of its sender.
            now_ns: when it was complete [ns].
            ears: mask of the ports that it has reached.
            silent: do not inform the sender, because the frame was not submitted.
            out: the deliveries of the bus.

        Returns:
            True if the sender believes that it failed, and sends it again.
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
        """Deliver the frame to these ports and confirm it to its sender."""
        self._tell(out, frame, port, HEARD if silent else DELIVERED, ears)

    def hear(self, frame: bytes, port: int, ears: int, out: list[Delivery]) -> None:
        """Deliver the frame to these ports without informing its sender."""
        self._tell(out, frame, port, HEARD, ears)

    def mask(self, names: Sequence[str]) -> int:
        """Return the mask of the ports with these names; unknown names are ignored."""
        mask = 0
        for number, name in enumerate(self._names):
            if name in names:
                mask |= 1 << number
        return mask

    def _tell(self, out: list[Delivery], frame: bytes, port: int, kind: int, ears: int) -> None:
        """Append a delivery to the ports of a mask; it is LOST if no port is left to hear it."""
        others = ((1 << len(self._names)) - 1) & ~(1 << port)
        if others & ears:
            out.append((frame, port, kind_without(kind, others & ~ears)))
        elif kind == DELIVERED:
            out.append((frame, port, LOST))
