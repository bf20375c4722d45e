"""States and quantities of nodes on buses, by bus, node and axis."""

from dataclasses import dataclass, field
from typing import final

from harness.report.tracks import Steps, Track

Place = tuple[str, int, int]
"""Bus, node or unit, axis from 1."""


@final
@dataclass(slots=True)
class Told:
    """The values from one axis of one node.

    Attributes:
        pds: states of the PDS FSA, with the numbers of `traces.decode_cia402.STATES`.
        mode: modes of operation.
        nmt: NMT states.
        tracks: by index of CiA 402, in the drive's own units.
    """

    pds: Steps = field(default_factory=Steps)
    mode: Steps = field(default_factory=Steps)
    nmt: Steps = field(default_factory=Steps)
    tracks: dict[int, Track] = field(default_factory=dict)

    def track(self, index: int) -> Track:
        """Return the quantity with this index, created if necessary."""
        found = self.tracks.get(index)
        if found is None:
            found = self.tracks[index] = Track(held=True)
        return found


@final
class Nodes:
    """All nodes."""

    def __init__(self) -> None:
        self.told: dict[Place, Told] = {}

    def of(self, bus: str, node: int, axis: int) -> Told:
        """Return the values of this axis, created if necessary."""
        place = (bus, node, axis)
        found = self.told.get(place)
        if found is None:
            found = self.told[place] = Told()
        return found

    def is_drive(self, bus: str, node: int) -> bool:
        """Return True if a node has CiA 402 values on any axis."""
        return any(
            place[:2] == (bus, node) and bool(told.tracks or len(told.pds) or len(told.mode))
            for place, told in self.told.items()
        )
