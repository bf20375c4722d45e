"""Periods and jitter of messages as a recording shows them.

A message is periodic if nearly all of its distances are like their median. Its period is the mean
of those; its jitter is how much closer than that any of its frames came, where none of the
distances between them is irregular; what irregular ones add (a boot-up message between heartbeats,
a change that is told at once) is kept apart. Everything else is sporadic: its period is the mean
over the whole recording, its jitter how far its bursts run ahead of that. Of both the least
distance is known. So what comes out allows all that was recorded, and not much more; what was not
recorded it does not know.

Stamps are of the ends of frames: waiting for the bus is in the jitter already.
"""

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, final

from harness.analysis.frame_length import FD_LENGTHS
from harness.analysis.message import Arrival, Message

SAMPLES_MIN: Final = 10
_REGULAR_SHARE: Final = 0.9
_REGULAR_WITHIN: Final = 4  # a quarter of the median


@final
@dataclass(slots=True)
class Heard:
    """All frames of one identifier, as they were recorded.

    Attributes: identifier, extended; times_ns (of their ends, in order); length (data bytes, the
    most); fd, switched; senders (in the order met); bits (all together, 0: not known).
    """

    identifier: int
    extended: bool
    times_ns: "array[int]" = field(default_factory=lambda: array("q"))
    length: int = 0
    fd: bool = False
    switched: bool = False
    senders: list[str] = field(default_factory=list)
    bits: int = 0

    def add(self, time_ns: int, length: int, sender: str) -> None:
        """One more frame."""
        self.times_ns.append(time_ns)
        self.length = max(self.length, length)
        if sender and sender not in self.senders:
            self.senders.append(sender)


@final
@dataclass(frozen=True, slots=True)
class Measured:
    """A message as it was recorded.

    Attributes:
        message: as the analysis takes it.
        frames: it stands on so many.
        least_ns, most_ns: distances between two of them; None: there is one frame only.
        irregular: how many distances of a periodic message are not like the others.
    """

    message: Message
    frames: int
    least_ns: int | None
    most_ns: int | None
    irregular: int


def measured(heard: Heard, span_ns: int, name: str = "") -> Measured:
    """The message that these frames are of.

    Args:
        heard: at least one frame.
        span_ns: of the whole recording, > 0.
        name: what it is, in words.
    """
    times = sorted(heard.times_ns)
    gaps = [after - before for before, after in pairwise(times)]
    positive = [gap for gap in gaps if gap > 0]
    regular = _regular(positive)
    if regular:
        message = _periodic(times, gaps, regular)
        irregular = len(gaps) - len(regular)
    else:
        message = _sporadic(times, gaps, span_ns)
        irregular = 0
    period_ns, jitter_ns, irregular_ns, arrival = message
    found = Message(
        identifier=heard.identifier,
        length=next(length for length in FD_LENGTHS if length >= heard.length),
        period_ns=period_ns,
        jitter_ns=jitter_ns,
        irregular_ns=irregular_ns,
        distance_ns=min(gaps, default=0),
        deadline_ns=period_ns if arrival is Arrival.PERIODIC else None,
        extended=heard.extended,
        name=name,
        sender=heard.senders[0] if len(heard.senders) == 1 else "",
        fd=heard.fd,
        switched=heard.switched,
        arrival=arrival,
        source=f"{len(times)} frames",
    )
    return Measured(found, len(times), min(gaps, default=None), max(gaps, default=None), irregular)


def _regular(gaps: list[int]) -> list[int]:
    """The distances that are like their median, if nearly all are; else none."""
    if len(gaps) + 1 < SAMPLES_MIN:
        return []
    median = sorted(gaps)[len(gaps) // 2]
    regular = [gap for gap in gaps if abs(gap - median) * _REGULAR_WITHIN <= median]
    return regular if len(regular) >= _REGULAR_SHARE * len(gaps) else []


def _periodic(
    times: list[int], gaps: list[int], regular: list[int]
) -> tuple[int, int, int, Arrival]:
    period_ns = sum(regular) // len(regular)
    low, high = min(regular), max(regular)
    jitter_ns = 0
    begin = 0
    for place, gap in enumerate([*gaps, -1]):
        if not low <= gap <= high:
            jitter_ns = max(jitter_ns, _ahead_ns(times[begin : place + 1], period_ns))
            begin = place + 1
    all_ns = _ahead_ns(times, period_ns)
    return period_ns, jitter_ns, max(0, all_ns - jitter_ns), Arrival.PERIODIC


def _sporadic(times: list[int], gaps: list[int], span_ns: int) -> tuple[int, int, int, Arrival]:
    period_ns = max(1, span_ns // len(times))
    return period_ns, _ahead_ns(times, period_ns), 0, Arrival.SPORADIC


def _ahead_ns(times: Iterable[int], period_ns: int) -> int:
    """How much closer than once a period any of them came to any one before."""
    lowest: int | None = None
    ahead_ns = 0
    for number, time_ns in enumerate(times):
        place_ns = number * period_ns - time_ns
        lowest = place_ns if lowest is None else min(lowest, place_ns)
        ahead_ns = max(ahead_ns, place_ns - lowest)
    return ahead_ns
