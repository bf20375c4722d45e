"""What happened at one moment: faults, events, commands; bounded, and what was too much is told."""

from collections import Counter
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, final

KEPT: Final = 2_000
"""Of each kind; a page with more of them is no list any more."""


@final
class Severity(IntEnum):
    """How much it matters."""

    INFO = 0
    WARNING = 1
    ERROR = 2


@final
@dataclass(frozen=True, slots=True)
class Incident:
    """One of them.

    Attributes: time_ns (from the recording's beginning), severity, kind (of a few words), place
    (bus, motor or who says so), text.
    """

    time_ns: int
    severity: Severity
    kind: str
    place: str
    text: str


@final
class Incidents:
    """All of them, the first `KEPT` of each kind.

    Attributes: kept (in the order they came), counts (of all, by kind).
    """

    def __init__(self) -> None:
        self.kept: list[Incident] = []
        self.counts: Counter[str] = Counter()

    def add(self, time_ns: int, severity: Severity, kind: str, place: str, text: str) -> None:
        """It happened."""
        self.counts[kind] += 1
        if self.counts[kind] <= KEPT:
            self.kept.append(Incident(time_ns, severity, kind, place, text))

    def left_out(self) -> list[str]:
        """What is not shown, in words."""
        return [
            f"{count - KEPT} of {count} incidents of kind “{kind}” are not shown, the last ones"
            for kind, count in self.counts.items()
            if count > KEPT
        ]
