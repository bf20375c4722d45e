"""Traffic statistics of a CAN bus."""

from typing import final

from motorhil.emulators.can.frame_length import can_id_of_key
from motorhil.emulators.media.load import BusyTime


@final
class CanStatistics:
    """The counts and load of one bus. Only the bus writes it; a frame counts when it is complete.

    Takes up to 1 MB (`BusyTime`) and an entry per different identifier.

    Attributes (read only): frames and bits (incl. stuff bits and intermission) of frames sent;
    busy, the time occupied by these, by failed frames and by intermissions; errors, the number of
    error detections by nodes; bits_lost, the bits of failed frames and error frames.
    """

    def __init__(self) -> None:
        self.frames: int = 0
        self.bits: int = 0
        self.busy: BusyTime = BusyTime()
        self.errors: int = 0
        self.bits_lost: int = 0
        self.by_key: dict[int, int] = {}  # frames sent, by arbitration key
        self._collisions: dict[int, int] = {}

    def count(self, key: int, bits: int) -> None:
        """Count a sent frame."""
        self.frames += 1
        self.bits += bits
        counts = self.by_key
        counts[key] = counts.get(key, 0) + 1

    def count_collision(self, key: int) -> None:
        """Count a sent frame that had competed with another node's frame of the same key."""
        self._collisions[key] = self._collisions.get(key, 0) + 1

    def absorb(self, other: "CanStatistics") -> None:
        """Move the counts of another bus part here; its busy time is not moved."""
        self.frames += other.frames
        self.bits += other.bits
        self.errors += other.errors
        self.bits_lost += other.bits_lost
        other.give(self.by_key, self._collisions)
        other.frames = other.bits = other.errors = other.bits_lost = 0

    def give(self, counts: dict[int, int], collisions: dict[int, int]) -> None:
        """Move the counts by key into these dictionaries."""
        for own, others in ((self.by_key, counts), (self._collisions, collisions)):
            for key, count in own.items():
                others[key] = others.get(key, 0) + count
            own.clear()

    def busy_ns(self) -> int:
        """Return the total busy time [ns]."""
        return self.busy.busy_ns()

    def load(self, from_ns: int, until_ns: int) -> float:
        """Return the busy part of a window, 0.0 to 1.0.

        Raises:
            ValueError: the window is empty.
        """
        return self.busy.load(from_ns, until_ns)

    def peak_load(self, window_ns: int) -> float:
        """Return the highest load of any window of this length so far, 0.0 to 1.0.

        Raises:
            ValueError: window_ns is not above 0.
        """
        return self.busy.peak_load(window_ns)

    def counts(self) -> dict[int, int]:
        """Return the frames sent by can_id (identifier and flags), most urgent first."""
        return {can_id_of_key(key): count for key, count in sorted(self.by_key.items())}

    def collisions(self) -> dict[int, int]:
        """Return how often two nodes competed with one identifier and frame type, by can_id."""
        return {can_id_of_key(key): count for key, count in sorted(self._collisions.items())}
