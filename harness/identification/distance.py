"""How far apart the motions of a motor are in two recordings, such as a real and an emulated one.

Two recordings begin at different times, and encoders count from different positions. So the second
one is first shifted: in time to where positions correlate best, then by the mean distance of the
positions. A controller tracks positions whatever its plant is: the torque tells how far apart the
plants are. Torques are averaged over `SMOOTH_S`, because a servo makes ripple of its own.
"""

from typing import TYPE_CHECKING, Final, final

import numpy as np

from motorhil.frozen import frozen
from motorhil.harness.identification.samples import on_grid, usual_period_ns
from motorhil.harness.report.motors import Line, Motor, Plot

if TYPE_CHECKING:
    from numpy import float64
    from numpy.typing import NDArray

_COMPARED: Final = ("position", "velocity", "torque")
SMOOTH_S: Final = 0.1
_ENERGY: Final = 0.2  # of that of both motions, which must be in common
_LEAST: Final = 50  # samples in common


@final
@frozen
class Distance:
    """The distance of one quantity of one motor in two recordings.

    Attributes:
        motor, quantity, unit: the subject.
        typical: root mean square of the differences, in `unit`.
        share: the same as a share of the quantity's own root mean square, without its mean.
        largest: the largest difference.
    """

    motor: str
    quantity: str
    unit: str
    typical: float
    share: float
    largest: float


@final
@frozen
class Shift:
    """How much later the second recording is [s], and its positions are higher."""

    time_s: float
    position: float


def distances(first: Motor, second: Motor) -> tuple[Shift, list[Distance]] | None:
    """Return the shift and the distances of a motor; None: it has no position in common."""
    pair = _pair(first, second, "position")
    if pair is None:
        return None
    one, other, _ = pair
    period_ns = max(usual_period_ns(one), usual_period_ns(other))
    if not period_ns:
        return None
    own, theirs = (_series(line, period_ns) for line in (one, other))
    if min(len(own), len(theirs)) < _LEAST:
        return None
    lag = _lag(own, theirs)
    begins = int(one.times_ns[0]), int(other.times_ns[0])
    shift_ns = begins[1] - begins[0] + lag * period_ns
    found: list[Distance] = []
    offset = 0.0
    for quantity in _COMPARED:
        pair = _pair(first, second, quantity)
        both = None if pair is None else _together(pair[0], pair[1], shift_ns, period_ns)
        if pair is None or both is None:
            continue
        values, others = both
        if quantity == "position":
            offset = float(np.mean(others - values))
            others = others - offset
        if quantity == "torque":
            values, others = (_smooth(one, SMOOTH_S * 1e9 / period_ns) for one in both)
        found.append(_distance(first.name, quantity, pair[2], values, others))
    return (Shift(shift_ns / 1e9, offset), found) if found else None


def _pair(first: Motor, second: Motor, quantity: str) -> tuple[Line, Line, str] | None:
    """Return a line of each in the same unit: actual values, or else true ones."""
    own = {(plot.unit, line.role): line for plot, line in _lines(first, quantity)}
    for role in ("actual", "truth"):
        for plot, line in _lines(second, quantity):
            match = own.get((plot.unit, role))
            if line.role == role and match is not None:
                return match, line, plot.unit
    return None


def _lines(motor: Motor, quantity: str) -> list[tuple[Plot, Line]]:
    return [
        (plot, line)
        for plot in motor.plots
        if plot.quantity == quantity
        for line in plot.lines
        if len(line.times_ns) > 1
    ]


def _series(line: Line, period_ns: float) -> "NDArray[float64]":
    grid = np.arange(float(line.times_ns[0]), float(line.times_ns[-1]), period_ns)
    return on_grid(grid, line, period_ns)


def _lag(one: "NDArray[float64]", other: "NDArray[float64]") -> int:
    """Return how many samples later the second series is, at most half of the shorter one.

    Slopes are compared, so that another zero of the encoder does not matter. The score is twice
    their correlation, as a share of the energies in common: 1 where both are equal.
    """
    slopes = np.diff(one), np.diff(other)
    size = 1 << (len(one) + len(other)).bit_length()
    spectra = [np.fft.rfft(slope, size) for slope in slopes]
    product = np.fft.irfft(np.conj(spectra[0]) * spectra[1], size)
    sums = [np.concatenate([[0.0], np.cumsum(slope * slope)]) for slope in slopes]
    most = max(1, min(len(one), len(other)) // 2)
    lags = np.arange(-most, most)
    begin = np.maximum(0, -lags)
    end = np.minimum(len(slopes[0]), len(slopes[1]) - lags)
    energy = sums[0][end] - sums[0][begin] + sums[1][end + lags] - sums[1][begin + lags]
    least = _ENERGY * (sums[0][-1] + sums[1][-1])
    score = 2.0 * product[lags] / np.where(energy > least, energy, np.inf)
    return int(lags[np.argmax(score)])


def _together(
    one: Line, other: Line, shift_ns: float, period_ns: float
) -> "tuple[NDArray[float64], NDArray[float64]] | None":
    begin = max(float(one.times_ns[0]), float(other.times_ns[0]) - shift_ns)
    end = min(float(one.times_ns[-1]), float(other.times_ns[-1]) - shift_ns)
    grid = np.arange(begin, end, period_ns)
    if len(grid) < _LEAST:
        return None
    return on_grid(grid, one, period_ns), on_grid(grid + shift_ns, other, period_ns)


def _smooth(values: "NDArray[float64]", samples: float) -> "NDArray[float64]":
    """Return the moving average over this number of samples."""
    window = np.ones(min(max(1, round(samples)), len(values)))
    out: NDArray[float64] = np.convolve(values, window / len(window), "valid")
    return out


def _distance(
    motor: str,
    quantity: str,
    unit: str,
    values: "NDArray[float64]",
    others: "NDArray[float64]",
) -> Distance:
    apart = values - others
    typical = float(np.sqrt(np.mean(apart * apart)))
    own = float(np.std(values))
    share = typical / own if own else 0.0 if not typical else float("inf")
    return Distance(motor, quantity, unit, typical, share, float(np.max(np.abs(apart))))
