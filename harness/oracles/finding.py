"""What an oracle says of a recording, as values."""

from dataclasses import asdict, dataclass
from enum import Enum
from typing import Final, final

_NS: Final = 1_000_000_000


@final
class Verdict(Enum):
    """What was found. Nothing is ever HELD that was not looked at."""

    HELD = "held"
    BROKEN = "broken"
    NOT_JUDGED = "could not judge"


@final
@dataclass(frozen=True, slots=True)
class Violation:
    """Once that a promise was not kept.

    Attributes: time_ns (log time); text (what happened, in words); bus, node, axis, motor (as far
    as they are known; 0 and "" where not); value, limit [unit] (None: it is not about a number).
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
    """What one oracle says of one recording.

    Attributes:
        oracle: its id.
        promise, source: what should hold, in a sentence, and who says so.
        verdict: see Verdict.
        looked: how often there was something to judge: its reach.
        first: the first violation of a promise that is broken, or, where the verdict is
            NOT_JUDGED, the first thing that would be one if the recording were complete.
        further: violations (or doubts) after that one.
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
        """The same for a machine."""
        table = asdict(self)
        table["verdict"] = self.verdict.value
        return table
