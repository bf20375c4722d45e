"""Where the faults of a plan meet the traffic of a bus: who hears what, and when."""

from heapq import heappop, heappush
from typing import Final, final

from emulators.media.delivery import DELIVERED, HEARD, LOST, Delivery, kind_without
from emulators.media.faults import NEVER_NS, FaultKind, FaultPlan

ERROR_FRAME_BITS: Final = 14  # an error flag nobody adds to (6) and its delimiter (8)


@final
class FaultSeam:
    """What a bus with a fault plan knows besides; a bus without faults never comes here.

    Memory grows by what is heard later and not yet due, and as `FaultPlan` says.

    Attributes (read only): plan; cut_mask, the ports now off the bus as bits 1 << number;
    deaf_mask, those that were off it at any time since the frame in flight began.
    """

    def __init__(self, plan: FaultPlan) -> None:
        self.plan = plan
        self.cut_mask = 0
        self.deaf_mask = 0
        self._names: list[str] = []
        self._late: list[tuple[int, int, bytes, int, int]] = []  # heap: due, turn, frame, port, hit
        self._turn = 0
        self._next_cut_ns = NEVER_NS

    def is_idle(self) -> bool:
        """Whether nothing is wrong, and nothing can go wrong."""
        return not (self._late or self.cut_mask or self.deaf_mask) and self.plan.is_empty()

    def attach(self, name: str) -> bool:
        """The next port has this name; whether it is cut off from the start."""
        number = len(self._names)
        self._names.append(name)
        if name not in self.plan.cut_ports():
            return False
        self.cut_mask |= 1 << number
        self.deaf_mask |= 1 << number
        return True

    def next_ns(self) -> int:
        """When a cut begins or ends, or a frame is heard late; NEVER_NS if nothing is due."""
        if not self._late:
            return self._next_cut_ns
        due_ns = self._late[0][0]
        return self._next_cut_ns if 0 <= self._next_cut_ns < due_ns else due_ns

    def is_cut_due(self, now_ns: int) -> bool:
        """Whether a cut begins or ends now, or should have before."""
        return 0 <= self._next_cut_ns <= now_ns

    def keep_cuts(self, now_ns: int, in_flight: bool) -> int:
        """The mask of ports cut off or back since the last call; the masks are now up to date."""
        before = self.cut_mask
        self.cut_mask = self._mask(self.plan.keep_cuts(now_ns))
        self.deaf_mask = self.deaf_mask | self.cut_mask if in_flight else self.cut_mask
        self._next_cut_ns = self.plan.next_cut_ns(now_ns)
        return before ^ self.cut_mask

    def is_cut(self, port: int) -> bool:
        """Whether this port is off the bus."""
        return bool(self.cut_mask >> port & 1)

    def was_cut(self, port: int) -> bool:
        """Whether this port was off the bus at any time since the frame in flight began."""
        return bool(self.deaf_mask >> port & 1)

    def forget_flight(self) -> None:
        """The frame in flight is over; the next may begin."""
        self.deaf_mask = self.cut_mask

    def hear_late(self, now_ns: int, out: list[Delivery]) -> None:
        """Appends the frames whose delay is over."""
        while self._late and self._late[0][0] <= now_ns:
            _, _, frame, port, hit = heappop(self._late)
            self._tell(out, frame, port, HEARD, hit & ~self.cut_mask)

    def complete(self, frame: bytes, port: int, now_ns: int, out: list[Delivery]) -> bool:
        """A frame has gone over the bus; appends to `out` what came of it.

        Returns:
            Whether the sender believes it failed, and sends it again.
        """
        rule = self.plan.verdict(frame, self._names[port], now_ns)
        if rule is None:
            self.deliver(frame, port, out)
            return False
        well = ~self.deaf_mask
        hit = self._mask(list(rule.ports)) if rule.ports else -1
        if rule.kind is FaultKind.DUPLICATE:
            self._tell(out, frame, port, HEARD, hit & well)
            return True
        self._tell(out, frame, port, DELIVERED, well & ~hit)
        if rule.kind is FaultKind.DELAY:
            self._turn += 1
            heappush(self._late, (now_ns + rule.delay_ns, self._turn, frame, port, hit))
        elif rule.kind is FaultKind.CORRUPT:
            self._tell(out, self.plan.corrupted(rule, frame), port, HEARD, hit & well)
        return False

    def deliver(self, frame: bytes, port: int, out: list[Delivery]) -> None:
        """The frame reaches all that are on the bus."""
        self._tell(out, frame, port, DELIVERED, ~self.deaf_mask)

    def _tell(self, out: list[Delivery], frame: bytes, port: int, kind: int, ears: int) -> None:
        """Appends a delivery to the ports of a mask; nobody left to hear it makes it LOST."""
        others = ((1 << len(self._names)) - 1) & ~(1 << port)
        if others & ears or (kind == DELIVERED and not others and ears):
            out.append((frame, port, kind_without(kind, others & ~ears)))
        elif kind == DELIVERED:
            out.append((frame, port, LOST))

    def _mask(self, names: list[str]) -> int:
        """The ports of these names; names of no port are nobody."""
        mask = 0
        for number, name in enumerate(self._names):
            if name in names:
                mask |= 1 << number
        return mask
