"""Clock of a periodic message: period, error and jitter, as recorded.

A straight line is fitted to the frames' times over their numbers, by least squares. An irregular
distance (a pause, a lost frame) begins a new run with its own phase. All runs share one period. The
jitter is the residual of the fit.

All times come from the clock that stamped the recording. The error of that clock is part of every
value in ppm, but not of the drift between two messages stamped by it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import floor, log10, sqrt
from typing import Final, final

_LIKE: Final = 4  # a quarter of the median distance
_ROUND_WITHIN_PPM: Final = 200.0  # crystals are within 100
_TOLD_WITHIN_PPM: Final = 10_000.0
_STEPS: Final = (1.0, 0.1, 0.05)  # of the first digit: 10, 12, 12.5


@final
@dataclass(frozen=True, slots=True)
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
    runs = _runs(times_ns)
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


def _runs(times_ns: Sequence[int]) -> list[Sequence[int]]:
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
