"""Exchange log of a recorded controller: commands, polls and its responses.

An exchange log is a sequence of steps. A step is something sent to the controller. A *command* (a
write, a set-point, an NMT command) changes the controller. Frames that it then sends by itself
belong to that command, at a delay after it. A *poll* (a read, a SYNC at rest) changes nothing: it
is answered, and can be repeated more or less often than in the recording. Steps are matched by key
and order, not by time. So a host that is faster or slower than the recorded one gets the same
answers.
"""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise
from typing import Final, NamedTuple, final

Key = tuple[str, int, bytes]
"""Kind; object, identifier or command; data."""

REGULAR_MIN: Final = 4
"""The number of similar intervals from which on frames are periodic."""
START: Final[Key] = ("start", 0, b"")
"""The key of the first step: the start of the recording."""


@final
class Role(Enum):
    """The effect of a step on the controller."""

    COMMAND = "command"
    POLL = "poll"


@final
class Sent(NamedTuple):
    """A frame sent by the controller.

    Attributes:
        delay_ns: from the end of its cause to its own end.
        data: a Linux can_frame; of a Modbus unit, an RTU frame.
        duration_ns: from its first bit to its last, if recorded; else 0.
        goes_on: True if the next of its kind followed one period later, in any case.
    """

    delay_ns: int
    data: bytes
    duration_ns: int = 0
    goes_on: bool = False


@final
@dataclass(slots=True)
class Turn:
    """One exchange of a dialogue: a frame of the host and its answers."""

    asked: bytes
    answers: list[Sent] = field(default_factory=list)


@final
@dataclass(slots=True)
class Step:
    """Something sent to the controller.

    Attributes:
        role: its effect.
        key: the key by which it is found.
        time_ns: its time in the recording.
        text: a sentence; empty for a PDO, see `exchange.canopen.sentence`.
        turns: the exchanges of an SDO transfer or a Modbus request; the first is the request.
        answers: the answers to a SYNC or a remote frame.
        reactions: frames the controller sends by itself after a command, until the next command.
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
class ExchangeLog:
    """The exchange log of one recorded controller.

    Attributes:
        bus: of the recording.
        number: node-ID or unit.
        steps: in order; the first is the start of the recording (`START`).
        periods_ns: periods of cyclic frames by identifier.
        masks: for PDOs to it, the relevant bits of their 8 data bytes, by identifier; without a
            mask, all. Each has the number of commands before it takes effect.
        syncs: the identifiers of SYNCs that it used.
    """

    bus: str
    number: int
    steps: list[Step] = field(default_factory=list)
    periods_ns: dict[int, int] = field(default_factory=dict)
    masks: dict[int, list[tuple[int, bytes]]] = field(default_factory=dict)
    syncs: set[int] = field(default_factory=set)


def period_ns(times_ns: Sequence[int]) -> int | None:
    """Return the period of frames at these times; None if they have none.

    Most intervals must be within a tenth of the median. Additional frames sent on events make
    shorter intervals.
    """
    steps = sorted(b - a for a, b in pairwise(times_ns))
    if len(steps) < REGULAR_MIN:
        return None
    middle = steps[len(steps) // 2]
    near = sum(1 for step in steps if abs(step - middle) * 10 <= middle)
    return middle if middle > 0 and 2 * near > len(steps) else None


def goes_on(times_ns: Sequence[int], now_ns: int, period: int) -> bool:
    """Return whether the next of the frames at these times followed about a period after `now_ns`.

    After the last frame the interval before it is assumed.
    """
    behind = bisect_right(times_ns, now_ns)
    last = behind == len(times_ns)
    next_ns = 2 * now_ns - times_ns[behind - 2] if last else times_ns[behind]
    return 4 * (next_ns - now_ns) <= 5 * period
