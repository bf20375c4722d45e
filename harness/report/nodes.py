"""What nodes on buses told of themselves: states and quantities, by bus, node and axis."""

from dataclasses import dataclass, field
from typing import final

from harness.report.tracks import Steps, Track

Place = tuple[str, int, int]
"""Bus, node or unit, axis from 1."""


@final
@dataclass(slots=True)
class Told:
    """By one axis of one node.

    Attributes: pds (states of the PDS FSA, as `traces.decode_cia402.STATES` counts them), mode (of
    operation), nmt, tracks (by index of CiA 402, in the drive's own units).
    """

    pds: Steps = field(default_factory=Steps)
    mode: Steps = field(default_factory=Steps)
    nmt: Steps = field(default_factory=Steps)
    tracks: dict[int, Track] = field(default_factory=dict)

    def track(self, index: int) -> Track:
        """The quantity with this index."""
        found = self.tracks.get(index)
        if found is None:
            found = self.tracks[index] = Track(held=True)
        return found


@final
class Nodes:
    """All of them."""

    def __init__(self) -> None:
        self.told: dict[Place, Told] = {}

    def of(self, bus: str, node: int, axis: int) -> Told:
        """What this one told."""
        place = (bus, node, axis)
        found = self.told.get(place)
        if found is None:
            found = self.told[place] = Told()
        return found

    def is_drive(self, bus: str, node: int) -> bool:
        """Whether it told something of CiA 402, on any axis."""
        return any(
            place[:2] == (bus, node) and bool(told.tracks or len(told.pds) or len(told.mode))
            for place, told in self.told.items()
        )
