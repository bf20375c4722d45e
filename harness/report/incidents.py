"""Incidents of a recording: faults, events, commands; limited in number."""

from collections import Counter
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, final

KEPT: Final = 2_000
"""Limit for each kind; a longer list is not readable."""


@final
class Severity(IntEnum):
    """The severity of an incident."""

    INFO = 0
    WARNING = 1
    ERROR = 2


@final
@dataclass(frozen=True, slots=True)
class Incident:
    """One incident.

    Attributes:
        time_ns: from the recording's beginning [ns].
        severity: the severity.
        kind: the kind, in a few words.
        place: the bus, the motor, or the source of the message.
        text: the description.
    """

    time_ns: int
    severity: Severity
    kind: str
    place: str
    text: str


@final
class Incidents:
    """All incidents, the first `KEPT` of each kind.

    Attributes:
        kept: the incidents, in order of arrival.
        counts: the number of all incidents, by kind.
    """

    def __init__(self) -> None:
        self.kept: list[Incident] = []
        self.counts: Counter[str] = Counter()

    def add(self, time_ns: int, severity: Severity, kind: str, place: str, text: str) -> None:
        """Add an incident."""
        self.counts[kind] += 1
        if self.counts[kind] <= KEPT:
            self.kept.append(Incident(time_ns, severity, kind, place, text))

    def left_out(self) -> list[str]:
        """Return a remark for each kind that exceeds the limit."""
        return [
            f"the last {count - KEPT} of {count} incidents of kind “{kind}” are not shown"
            for kind, count in self.counts.items()
            if count > KEPT
        ]
