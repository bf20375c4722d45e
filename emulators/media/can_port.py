"""Transmit side of a node: its candidate and its queue."""

from heapq import heappop, heappush
from typing import Final, final

from emulators.media.can_bits import KEY_SHIFT, LENGTHS_MASK
from emulators.media.can_node import CanNode, QueueOrder

__all__ = ["CUT_OFF", "LENGTHS_MASK", "PORT_MASK", "PORT_SHIFT", "CanPort"]

# An entry in an arbitration: key << 30 | port << 18 | lengths. The lowest wins. Its 62 bits fit
# the tagged integers of compiled code. The lengths are those of `can_bits`.
PORT_SHIFT: Final = 18
PORT_MASK: Final = 0xFFF
CUT_OFF: Final = -1  # in place of the candidate's entry: off the bus, all frames wait


@final
class CanPort:
    """The frames of one node. Only the bus reads and writes it.

    Attributes:
        chip: the setup of its CAN controller.
        tag: the port's number, at its place in an entry.
        entry: of the candidate, which competes or is in flight; 0: there is none; or CUT_OFF.
        frame: the candidate.
        behind: heap of (rank, turn, entry, frame); rank is the key, or 0 in a FIFO.
        starts_seen: the bus's count of arbitrations before the candidate's first.
        losses: arbitrations lost by earlier candidates.
        repeated: frames that a fault made the node send again.
        babbling: the candidate is a babbled frame, not a submitted one.
    """

    def __init__(self, number: int, name: str, chip: CanNode) -> None:
        self.name = name
        self.chip = chip
        self.tag = number << PORT_SHIFT
        self.by_priority = chip.queue is QueueOrder.PRIORITY
        self.entry = 0
        self.frame = b""
        self.behind: list[tuple[int, int, int, bytes]] = []
        self.starts_seen = 0
        self.losses = 0
        self.repeated: set[bytes] = set()
        self.babbling = False
        self._turn = 0

    def pending(self) -> int:
        """Return the number of pending frames."""
        return len(self.behind) + (1 if self.entry > 0 else 0)

    def queue(self, entry: int, frame: bytes) -> None:
        """Queue the frame as the last of its rank."""
        self._turn += 1
        heappush(self.behind, (self._rank(entry), self._turn, entry, frame))

    def put_back(self) -> None:
        """Put the candidate back as the first of its rank, leaving no candidate."""
        self._turn += 1
        heappush(self.behind, (self._rank(self.entry), -self._turn, self.entry, self.frame))
        self.entry = 0

    def promote(self) -> bool:
        """Make the best queued frame the candidate; return False if there is none."""
        if not self.behind:
            self.entry = 0
            return False
        _, _, self.entry, self.frame = heappop(self.behind)
        return True

    def adopt(self, other: "CanPort") -> None:
        """Take over the queued frames and the counts of another port."""
        self.behind, other.behind = other.behind, []
        self.losses = other.losses
        self.repeated = other.repeated
        self._turn, other._turn = other._turn, 0  # noqa: SLF001 -- another one of its own kind

    def _rank(self, entry: int) -> int:
        return entry >> KEY_SHIFT if self.by_priority else 0
