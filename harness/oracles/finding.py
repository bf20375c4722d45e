"""Findings: the results of oracles."""

from dataclasses import asdict, dataclass
from enum import Enum
from typing import Final, final

_NS: Final = 1_000_000_000


@final
class Verdict(Enum):
    """The verdict of an oracle; HELD requires that something was examined."""

    HELD = "held"
    BROKEN = "broken"
    NOT_JUDGED = "could not judge"


@final
@dataclass(frozen=True, slots=True)
class Violation:
    """One violation of a promise.

    Attributes:
        time_ns: log time [ns].
        text: the description.
        bus, node, axis, motor: the place as far as known; otherwise 0 or "".
        value, limit: [unit]; None if no number is concerned.
    """

    time_ns: int
    text: str
    bus: str = ""
    node: int = 0
    axis: int = 1
    motor: str = ""
    value: float | None = None
    limit: float | None = None
    unit: str = ""

    def __str__(self) -> str:
        time = f"{self.time_ns // _NS}.{self.time_ns % _NS:09d} s"
        place = f"{self.bus} node {self.node}" if self.node else self.bus
        if self.axis > 1:
            place += f" axis {self.axis}"
        who = " ".join(part for part in (place, self.motor and f"({self.motor})") if part)
        numbers = ""
        if self.value is not None:
            numbers = f": {self.value:g} {self.unit}".rstrip()
            if self.limit is not None:
                numbers += f", limit {self.limit:g} {self.unit}".rstrip()
        return f"{time} {who}: {self.text}{numbers}" if who else f"{time}: {self.text}{numbers}"


@final
@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one oracle for one recording.

    Attributes:
        oracle: its id.
        promise, source: the rule as a sentence, and its source.
        verdict: the verdict.
        looked: number of examined cases.
        first: the first violation of a broken promise. If the verdict is NOT_JUDGED: the first
            violation that would count if the recording were complete.
        further: number of violations (or doubts) after the first one.
        reason: why it could not be judged; "" if it was.
    """

    oracle: str
    promise: str
    source: str
    verdict: Verdict
    looked: int = 0
    first: Violation | None = None
    further: int = 0
    reason: str = ""

    def as_table(self) -> dict[str, object]:
        """Return the finding as a table for JSON."""
        table = asdict(self)
        table["verdict"] = self.verdict.value
        return table
