"""Traffic of a bus or line: one entry per frame, for any medium."""

from array import array
from dataclasses import dataclass, field
from typing import final


@final
@dataclass(slots=True)
class Traffic:
    """All traffic of one bus or line.

    Attributes:
        name: name of the bus or line.
        kind: "CAN", "Modbus RTU" or "Modbus/TCP".
        unit: unit of `weights`: "bit" or "ns".
        capacity_s: capacity per second in that unit; None: unknown, so no load in per cent.
        why_no_capacity: the reason if it is None.
        times_ns: end of each entry [ns from the recording's beginning].
        keys: index into `labels` of each entry.
        weights: capacity taken by each entry.
        labels: the distinguished kinds (identifiers, functions), in order of appearance.
        ranks: sort key of each label.
        names: description of each label.
    """

    name: str
    kind: str
    unit: str
    capacity_s: float | None
    why_no_capacity: str = ""
    times_ns: "array[int]" = field(default_factory=lambda: array("q"))
    keys: "array[int]" = field(default_factory=lambda: array("H"))
    weights: "array[int]" = field(default_factory=lambda: array("L"))
    labels: list[str] = field(default_factory=list)
    ranks: list[int] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def add(self, time_ns: int, key: int, weight: int) -> None:
        """Add one entry."""
        self.times_ns.append(time_ns)
        self.keys.append(key)
        self.weights.append(weight)

    def label(self, text: str, rank: int, name: str = "") -> int:
        """Return the number of a new label; from `LABELS_MAX` on, one number for all the rest."""
        if len(self.labels) >= LABELS_MAX:
            if len(self.labels) == LABELS_MAX:
                self.labels.append("others")
                self.ranks.append(1 << 40)
                self.names.append("")
            return LABELS_MAX
        self.labels.append(text)
        self.ranks.append(rank)
        self.names.append(name)
        return len(self.labels) - 1


LABELS_MAX = 4_000
"""Limit of distinguished identifiers on one bus."""
