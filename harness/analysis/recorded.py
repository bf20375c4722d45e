"""Periods and jitter of messages as a recording shows them.

A message is periodic if nearly all of its distances are like their median. Its period is the one
with which its frames were least late, all from one due time on where no distance between them is
irregular: with no other is their spread smaller, with their real one neither. Its jitter is how
much closer than that any of them came; what irregular distances add (a boot-up message between
heartbeats, a change that is told at once) is kept apart. Everything else is sporadic: its period is
the mean over the whole recording, its jitter how far its bursts run ahead of that. Of both the
least distance is known. So what comes out allows all that was recorded, and not much more; what was
not recorded it does not know.

Stamps are of the ends of frames: waiting for the bus is in the jitter already. How late a frame was
is not recorded, but those after it prove some of it: if one comes closer than it should, those
before it were late by as much.
"""

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, final

from harness.analysis.frame_length import FD_LENGTHS, Bits
from harness.analysis.message import Arrival, Message

SAMPLES_MIN: Final = 10
_REGULAR_SHARE: Final = 0.9
_REGULAR_WITHIN: Final = 4  # a quarter of the median
_FINE: Final = 1 << 16  # of a nanosecond: a period's error grows with the number of frames


@final
@dataclass(slots=True)
class Heard:
    """All frames of one identifier, as they were recorded.

    Attributes: identifier, extended; times_ns (of their ends, in order); length (data bytes, the
    most); fd (some of them); switched (all of them); senders (in the order met); shortest (none
    has fewer bits, at either rate; None: not known).
    """

    identifier: int
    extended: bool
    times_ns: "array[int]" = field(default_factory=lambda: array("q"))
    length: int = 0
    fd: bool = False
    switched: bool = False
    senders: list[str] = field(default_factory=list)
    shortest: Bits | None = None

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
        usual_late_ns: half of the frames of a periodic message were proved no later than this
            after they could have come; the latest one by its jitter.
        shortest: none of its frames was shorter; None: not known.
    """

    message: Message
    frames: int
    least_ns: int | None
    most_ns: int | None
    irregular: int
    usual_late_ns: int = 0
    shortest: Bits | None = None


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
    irregular = usual_late_ns = irregular_ns = 0
    arrival = Arrival.SPORADIC
    if regular:
        arrival = Arrival.PERIODIC
        runs = _runs(times, gaps, regular)
        period_ns = _period_ns(runs, min(regular), max(regular))
        late_ns = [late_ns for run in runs for late_ns in _late_ns(run, period_ns)]
        usual_late_ns, jitter_ns = sorted(late_ns)[len(late_ns) // 2], max(late_ns)
        irregular_ns = max(0, _ahead_ns(times, period_ns) - jitter_ns)
        irregular = len(gaps) - len(regular)
    else:
        period_ns = max(1, span_ns // len(times))
        jitter_ns = _ahead_ns(times, period_ns)
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
        source=f"{len(times)} frame{'s' * (len(times) > 1)}",
    )
    return Measured(
        found,
        len(times),
        min(gaps, default=None),
        max(gaps, default=None),
        irregular,
        usual_late_ns,
        heard.shortest,
    )


def _regular(gaps: list[int]) -> list[int]:
    """The distances that are like their median, if nearly all are; else none."""
    if len(gaps) + 1 < SAMPLES_MIN:
        return []
    median = sorted(gaps)[len(gaps) // 2]
    regular = [gap for gap in gaps if abs(gap - median) * _REGULAR_WITHIN <= median]
    return regular if len(regular) >= _REGULAR_SHARE * len(gaps) else []


def _runs(times: list[int], gaps: list[int], regular: list[int]) -> list[list[int]]:
    """Parts without an irregular distance."""
    low, high = min(regular), max(regular)
    ends = [place + 1 for place, gap in enumerate(gaps) if not low <= gap <= high]
    return [times[begin:end] for begin, end in pairwise([0, *ends, len(times)])]


def _period_ns(runs: list[list[int]], low_ns: int, high_ns: int) -> int:
    """The one with which the frames of no run spread more than they must, rounded down.

    How much they spread is the larger, the further a period is from that one, on either side.
    """
    hulls = [(_hull(run, 1), _hull(run, -1)) for run in runs]

    def spread(period: int) -> int:
        return max(
            max(_FINE * at_ns - number * period for number, at_ns in above)
            - min(_FINE * at_ns - number * period for number, at_ns in below)
            for above, below in hulls
        )

    low, high = _FINE * low_ns, _FINE * high_ns
    while low < high:
        middle = (low + high) // 2
        if spread(middle + 1) < spread(middle):
            low = middle + 1
        else:
            high = middle
    return low // _FINE


def _hull(run: list[int], side: int) -> list[tuple[int, int]]:
    """Of the points (number, time) those on the convex hull; side 1: above all others, -1: below.

    Source: A. M. Andrew, Another efficient algorithm for convex hulls in two dimensions (1979).
    """
    hull: list[tuple[int, int]] = []
    for number, at_ns in enumerate(run):
        while len(hull) > 1:
            (first, first_ns), (last, last_ns) = hull[-2:]
            turn = (last - first) * (at_ns - first_ns) - (number - first) * (last_ns - first_ns)
            if side * turn < 0:
                break
            hull.pop()
        hull.append((number, at_ns))
    return hull


def _late_ns(run: list[int], period_ns: int) -> list[int]:
    """Of each frame how late it was at least, by those after it."""
    late_ns: list[int] = []
    lead_ns: int | None = None  # of a grid of periods over the frame that came soonest in it
    for number in range(len(run) - 1, -1, -1):
        place_ns = number * period_ns - run[number]
        lead_ns = place_ns if lead_ns is None else max(lead_ns, place_ns)
        late_ns.append(lead_ns - place_ns)
    return late_ns


def _ahead_ns(times: Iterable[int], period_ns: int) -> int:
    """How much closer than once a period any of them came to any one before."""
    lowest: int | None = None
    ahead_ns = 0
    for number, time_ns in enumerate(times):
        place_ns = number * period_ns - time_ns
        lowest = place_ns if lowest is None else min(lowest, place_ns)
        ahead_ns = max(ahead_ns, place_ns - lowest)
    return ahead_ns
