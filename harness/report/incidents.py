"""Incidents of a recording: faults, events, commands; limited in number, not in time."""

from collections import Counter
from enum import IntEnum
from typing import Final, final

from motorhil.frozen import frozen

KEPT: Final = 2_000
"""Limit for each kind; a longer list is not readable. Above, they are thinned out evenly."""


@final
class Severity(IntEnum):
    """The severity of an incident."""

    INFO = 0
    WARNING = 1
    ERROR = 2


@final
@frozen
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
    """All incidents; of a frequent kind, one in every 2, 4, 8, ... over the whole recording.

    Attributes:
        counts: the number of all incidents, by kind.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._kept: dict[str, list[tuple[int, Incident]]] = {}  # by kind, with the order of arrival
        self._one_in: dict[str, int] = {}

    def add(self, time_ns: int, severity: Severity, kind: str, place: str, text: str) -> None:
        """Add an incident."""
        number = self.counts[kind]
        self.counts[kind] += 1
        one_in = self._one_in.setdefault(kind, 1)
        if number % one_in:
            return
        kept = self._kept.setdefault(kind, [])
        kept.append((self.counts.total(), Incident(time_ns, severity, kind, place, text)))
        if len(kept) > KEPT:
            del kept[1::2]
            self._one_in[kind] = 2 * one_in

    def kept(self) -> list[Incident]:
        """Return the incidents that are kept, in order of arrival."""
        found = [one for kept in self._kept.values() for one in kept]
        return [incident for _, incident in sorted(found, key=lambda one: one[0])]

    def since(self, number: int) -> list[Incident]:
        """Return the kept incidents after the first `number` of all, in order of arrival."""
        found: list[tuple[int, Incident]] = []
        for kept in self._kept.values():
            for one in reversed(kept):
                if one[0] <= number:
                    break
                found.append(one)
        return [incident for _, incident in sorted(found, key=lambda one: one[0])]

    def left_out(self) -> list[str]:
        """Return a remark for each kind that exceeds the limit."""
        return [
            f"of {self.counts[kind]} incidents of kind “{kind}” one in {one_in} is shown"
            for kind, one_in in self._one_in.items()
            if one_in > 1
        ]
