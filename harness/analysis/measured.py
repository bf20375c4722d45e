"""Periods and jitter of messages, measured in a recording.

A message is periodic if nearly all of its distances are close to their median. Its period minimises
the spread of its frames about a grid, which restarts after each irregular distance. Its jitter is
how much closer than the period any two frames came. Irregular distances (a boot-up message between
heartbeats, an immediate change report) are accounted for separately. All other messages are
sporadic: the period is the mean over the whole recording, and the jitter is how far bursts run
ahead of it. The minimum distance is known for both. The result covers everything that was recorded,
and not much more; unrecorded behaviour is not covered.

Stamps mark the ends of frames, so waiting for the bus is part of the jitter. The delay of a frame
is not recorded, but later frames prove a part of it. If one comes too early, those before it were
late by as much.

The clock of a periodic message is a straight line, fitted to the frames' times over their numbers
by least squares. An irregular
distance (a pause, a lost frame) begins a new run with its own phase. All runs share one period. The
jitter is the residual of the fit.

All times come from the clock that stamped the recording. The error of that clock is part of every
value in ppm, but not of the drift between two messages stamped by it.
"""

from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import floor, log10, sqrt
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.synchronization.bus_load import FD_LENGTHS
from motorhil.motorapi.synchronization.can_frame_length import Bits
from motorhil.motorapi.synchronization.can_response_time import Arrival, Message

SAMPLES_MIN: Final = 10
_REGULAR_SHARE: Final = 0.9
_REGULAR_WITHIN: Final = 4  # a quarter of the median
_FINE: Final = 1 << 16  # of a nanosecond: a period's error grows with the number of frames
_LIKE: Final = 4  # a quarter of the median distance
_ROUND_WITHIN_PPM: Final = 200.0  # crystals are within 100
_TOLD_WITHIN_PPM: Final = 10_000.0
_STEPS: Final = (1.0, 0.1, 0.05)  # of the first digit: 10, 12, 12.5


@final
@dataclass(slots=True)
class Heard:
    """All frames of one identifier, as recorded.

    Attributes:
        identifier, extended: 29 bits if extended.
        times_ns: the ends of the frames, in order [ns].
        length: maximum number of data bytes.
        fd: True if some are CAN FD frames.
        switched: True if all have a bit rate switch.
        senders: the senders, in order of appearance.
        shortest: no frame has fewer bits at either rate; None: unknown.
    """

    identifier: int
    extended: bool
    times_ns: "array[int]" = field(default_factory=lambda: array("q"))
    length: int = 0
    fd: bool = False
    switched: bool = False
    senders: list[str] = field(default_factory=list)
    shortest: Bits | None = None

    def add_kind(self, length: int, sender: str, fd: bool, switched: bool) -> None:
        """Add the facts of frames of one length and kind, from one sender."""
        self.length = max(self.length, length)
        self.fd = self.fd or fd
        self.switched = self.switched and switched
        if sender and sender not in self.senders:
            self.senders.append(sender)


@final
@frozen
class Measured:
    """A message as measured in a recording.

    Attributes:
        message: the message as input of the analysis.
        frames: number of its frames.
        least_ns, most_ns: smallest and largest distance of two frames [ns]; None: only one frame.
        irregular: number of irregular distances of a periodic message.
        usual_late_ns: median of the proved delays of a periodic message [ns]; the maximum is its
            jitter.
        shortest: lower bound of the length of its frames; None: unknown.
    """

    message: Message
    frames: int
    least_ns: int | None
    most_ns: int | None
    irregular: int
    usual_late_ns: int = 0
    shortest: Bits | None = None


def measured(heard: Heard, span_ns: int, name: str = "") -> Measured:
    """Measure the message from its frames.

    Args:
        heard: at least one frame.
        span_ns: duration of the whole recording, > 0 [ns].
        name: a description of the message.
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
    """Return the distances close to their median; none if they are too few."""
    if len(gaps) + 1 < SAMPLES_MIN:
        return []
    median = sorted(gaps)[len(gaps) // 2]
    regular = [gap for gap in gaps if abs(gap - median) * _REGULAR_WITHIN <= median]
    return regular if len(regular) >= _REGULAR_SHARE * len(gaps) else []


def _runs(times: list[int], gaps: list[int], regular: list[int]) -> list[list[int]]:
    """Return the parts without an irregular distance."""
    low, high = min(regular), max(regular)
    ends = [place + 1 for place, gap in enumerate(gaps) if not low <= gap <= high]
    return [times[begin:end] for begin, end in pairwise([0, *ends, len(times)])]


def _period_ns(runs: list[list[int]], low_ns: int, high_ns: int) -> int:
    """Return the period with the smallest spread of frames in any run, rounded down [ns].

    The spread grows with the distance from that period, on either side.
    """
    hulls = [(_hull(run, 1), _hull(run, -1)) for run in runs if len(run) > 1]  # one has no spread

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
    """Return the points (number, time) on the convex hull; side 1: upper, -1: lower.

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
    """Return a lower bound of each frame's delay, as proved by later frames [ns]."""
    late_ns: list[int] = []
    lead_ns: int | None = None  # of a grid of periods ahead of the earliest frame in it
    for number in range(len(run) - 1, -1, -1):
        place_ns = number * period_ns - run[number]
        lead_ns = place_ns if lead_ns is None else max(lead_ns, place_ns)
        late_ns.append(lead_ns - place_ns)
    return late_ns


def _ahead_ns(times: Iterable[int], period_ns: int) -> int:
    """Return how far any frame runs ahead of a period grid from an earlier frame [ns]."""
    lowest: int | None = None
    ahead_ns = 0
    for number, time_ns in enumerate(times):
        place_ns = number * period_ns - time_ns
        lowest = place_ns if lowest is None else min(lowest, place_ns)
        ahead_ns = max(ahead_ns, place_ns - lowest)
    return ahead_ns


@final
@frozen
class Clock:
    """The measured clock of a message.

    Attributes:
        period_ns: the fitted period [ns].
        peak_to_peak_ns, deviation_ns: jitter of the frames around the fit [ns]; the latter is the
            standard deviation.
        nominal_ns: the intended period [ns]; None if no round period is near.
        is_told: True if the recording states the period; otherwise it is the nearest round one.
    """

    period_ns: float
    peak_to_peak_ns: float
    deviation_ns: float
    nominal_ns: float | None
    is_told: bool

    @property
    def error_ppm(self) -> float | None:
        """The relative error of the clock [ppm]; positive if it is fast."""
        return None if self.nominal_ns is None else (self.nominal_ns / self.period_ns - 1) * 1e6

    def drift_ppm(self, other: "Clock") -> float | None:
        """Return how much faster this clock is than another [ppm]; None if their periods differ."""
        drift = (other.period_ns / self.period_ns - 1) * 1e6
        return drift if abs(drift) <= _TOLD_WITHIN_PPM else None


def clock_of(times_ns: Sequence[int], told_ns: Sequence[int] = ()) -> Clock:
    """Fit the clock of a periodic message.

    Args:
        times_ns: the times of its frames, at least three, in order [ns].
        told_ns: periods stated by the recording [ns]; the last one that fits counts.
    """
    runs = _clock_runs(times_ns)
    twice_xy = sum(
        (2 * number - len(run) + 1) * (time_ns - run[0])
        for run in runs
        for number, time_ns in enumerate(run)
    )
    twelve_xx = sum(len(run) * (len(run) ** 2 - 1) for run in runs)
    period_ns = 6 * twice_xy / twelve_xx
    left: list[float] = []
    for run in runs:
        middle_ns = sum(time_ns - run[0] for time_ns in run) / len(run)
        middle = (len(run) - 1) / 2
        left += [
            time_ns - run[0] - middle_ns - period_ns * (number - middle)
            for number, time_ns in enumerate(run)
        ]
    told = [one for one in told_ns if abs(one / period_ns - 1) * 1e6 <= _TOLD_WITHIN_PPM]
    return Clock(
        period_ns,
        max(left) - min(left),
        sqrt(sum(one * one for one in left) / len(left)),
        told[-1] if told else _nearest_round(period_ns),
        bool(told),
    )


def _clock_runs(times_ns: Sequence[int]) -> list[Sequence[int]]:
    """Return the parts without a pause that have two frames or more."""
    gaps = [after - before for before, after in pairwise(times_ns)]
    median = sorted(gaps)[len(gaps) // 2]
    ends = [place + 1 for place, gap in enumerate(gaps) if abs(gap - median) * _LIKE > median]
    runs = [times_ns[begin:end] for begin, end in pairwise([0, *ends, len(times_ns)])]
    return [run for run in runs if len(run) > 1]


def _nearest_round(period_ns: float) -> float | None:
    """Return the roundest period that may be intended [ns], or None."""
    digit = 10.0 ** floor(log10(period_ns * (1 + _ROUND_WITHIN_PPM / 1e6)))
    for step in _STEPS:
        near = round(period_ns / (digit * step)) * step * digit
        if near and abs(period_ns / near - 1) * 1e6 <= _ROUND_WITHIN_PPM:
            return near
    return None
