"""How much of a bus or line is used by what: one entry a frame, whatever the medium."""

from array import array
from dataclasses import dataclass, field
from typing import final


@final
@dataclass(slots=True)
class Traffic:
    """Everything that took time on one bus or line.

    Attributes:
        name: of the bus or line.
        kind: "CAN", "Modbus RTU" or "Modbus/TCP".
        unit: what `weights` are of: "bit" or "ns".
        capacity_s: how much of it there is in a second; None: not known, so no load in per cent.
        why_no_capacity: in words, if it is None.
        times_ns: when each entry ended [ns from the recording's beginning].
        keys: which of `labels` it is.
        weights: how much of the unit it took.
        labels: what is told apart (identifiers, functions), in the order met.
        ranks: by label, where it belongs when they are put in order.
        names: by label, what it is called.
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
        """One more entry."""
        self.times_ns.append(time_ns)
        self.keys.append(key)
        self.weights.append(weight)

    def label(self, text: str, rank: int, name: str = "") -> int:
        """The number of a new label; from `LABELS_MAX` on there is one for all the rest."""
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
"""Identifiers that are told apart on one bus."""
