"""What a recorded controller was told, and what came of it: a recording cut up by cause.

A tape is a sequence of steps. A step is something the controller was told. A *command* (a write, a
set-point, an NMT command) changes it: what it then sends by itself belongs to that command, at a
delay behind it. A *poll* (a read, a SYNC at rest) changes nothing: it is answered, and may be asked
more or less often than in the recording. Steps are found again by their key and order, never by
time stamps, so that a host that is faster or slower than the recorded one gets the same answers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise
from typing import Final, final

Key = tuple[str, int, bytes]
"""What kind of thing is told; the object, identifier or command it is about; its data."""

START: Final[Key] = ("start", 0, b"")
"""The key of a tape's first step: the recording begins."""


@final
class Role(Enum):
    """What being told this does."""

    COMMAND = "command"
    POLL = "poll"


@final
@dataclass(frozen=True, slots=True)
class Sent:
    """Something the controller sent.

    Attributes:
        delay_ns: from what it answers, or follows, being complete until it was complete.
        data: a Linux can_frame; of a Modbus unit, an RTU frame.
        duration_ns: from its first bit to its last, where the recording tells; else 0.
        goes_on: whether the next of its kind came a period later, whatever happened meanwhile.
    """

    delay_ns: int
    data: bytes
    duration_ns: int = 0
    goes_on: bool = False


@final
@dataclass(slots=True)
class Turn:
    """One exchange of a dialogue: what the host sends next, and what it is answered."""

    asked: bytes
    answers: list[Sent] = field(default_factory=list)


@final
@dataclass(slots=True)
class Step:
    """Something the controller was told.

    Attributes:
        role: what it does.
        key: what it is found by.
        time_ns: when it was told in the recording.
        text: as a sentence; of a PDO none, see `traces.canopen_tapes.sentence`.
        turns: the exchanges of an SDO transfer or a Modbus request; the first one is what was told.
        answers: what a SYNC or a remote frame is answered.
        reactions: of a command: what the controller then sends by itself, until the next command.
        answer_text: its last answer as a sentence; "" if there is none.
    """

    role: Role
    key: Key
    time_ns: int
    text: str
    turns: list[Turn] = field(default_factory=list)
    answers: list[Sent] = field(default_factory=list)
    reactions: list[Sent] = field(default_factory=list)
    answer_text: str = ""


@final
@dataclass(slots=True)
class Tape:
    """A recorded controller.

    Attributes:
        bus: of the recording.
        number: node-ID or unit.
        steps: in their order; the first is the recording's beginning (`START`).
        periods_ns: of what it sends periodically by itself, by identifier.
        masks: of PDOs to it, what of their 8 data bytes counts, by identifier; else all does. Each
            with how many commands it was told before the first that it holds for.
        syncs: the identifiers of SYNCs that it heard.
    """

    bus: str
    number: int
    steps: list[Step] = field(default_factory=list)
    periods_ns: dict[int, int] = field(default_factory=dict)
    masks: dict[int, list[tuple[int, bytes]]] = field(default_factory=dict)
    syncs: set[int] = field(default_factory=set)


REGULAR_MIN: Final = 4
"""So many intervals alike make something periodic."""


def period_ns(times_ns: Sequence[int]) -> int | None:
    """The period of what came at these times; None: it has none.

    Most intervals are within a tenth of the middle one; what is sent on events besides has shorter
    ones between them.
    """
    steps = sorted(b - a for a, b in pairwise(times_ns))
    if len(steps) < REGULAR_MIN:
        return None
    middle = steps[len(steps) // 2]
    near = sum(1 for step in steps if abs(step - middle) * 10 <= middle)
    return middle if middle > 0 and 2 * near > len(steps) else None
