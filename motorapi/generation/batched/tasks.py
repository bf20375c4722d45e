"""Many motions to be made, and their peaks."""

from dataclasses import dataclass
from typing import Final, final

import numpy as np

from motorapi.generation.batched.limits import FloatArray, refuse_where
from motorapi.generation.closed_form import task_of
from motorapi.generation.limits import ProfileLimits

UNBOUNDED: Final = "the limits allow no such motion, or do not bound it"
_LOST: Final = 64.0  # as for a single one
_ROUNDING: Final = 2.0**-50  # likewise


@final
@dataclass(frozen=True, slots=True, eq=False)
class Tasks:
    """Motions to be made, each mirrored where need be, so that its excess is >= 0.

    `first` is the index of the first of them; the others are as in `closed_form.Task`.
    """

    first: int
    sign: FloatArray
    excess: FloatArray
    begin: FloatArray
    end: FloatArray
    low: FloatArray
    high: FloatArray
    rise: FloatArray
    fall: FloatArray
    back_rise: FloatArray
    back_fall: FloatArray

    def ramp_s(self, begin: FloatArray, end: FloatArray, change: FloatArray) -> FloatArray:
        """How long a ramp takes; `change` is the difference, which may be known more exactly."""
        falling = change < 0.0
        forward = np.where(falling, self.fall, self.rise)
        backward = np.where(falling, self.back_fall, self.back_rise)
        size = np.abs(change)
        turning = np.where(
            begin < 0.0, end / forward - begin / backward, begin / forward - end / backward
        )
        straight = np.where((begin >= 0.0) & (end >= 0.0), size / forward, size / backward)
        return np.where(np.sign(begin) * np.sign(end) < 0.0, turning, straight)


def tasks_of(first: int, given: list[FloatArray], bounds: list[FloatArray]) -> Tasks:
    """The motions between the states (final, initial, initial and final velocity) in `given`.

    Raises:
        UsageError: a number is not finite, or a boundary velocity lies outside the limits.
    """
    final, initial, begin, end = given
    low, high, rise, fall, back_rise, back_fall = bounds
    refuse_where(~np.isfinite(final - initial), "the way is not a finite number", first)
    within = (low <= begin) & (begin <= high) & (low <= end) & (end <= high)
    outside = ~(within & np.isfinite(begin - end))
    refuse_where(outside, "a boundary velocity lies outside its limits", first)
    rising = end > begin
    forward = np.where(rising, rise, -fall)
    backward = np.where(rising, back_rise, -back_fall)
    to, since = np.maximum(end, 0.0), np.maximum(begin, 0.0)
    direct = (to - since) * (to + since) / forward
    to, since = np.minimum(end, 0.0), np.minimum(begin, 0.0)
    direct = 0.5 * (direct + (to - since) * (to + since) / backward)
    excess = (final - initial) - direct
    for index in np.flatnonzero(np.abs(excess) * _LOST < np.abs(direct)):
        excess[index] = _exactly(given, bounds, int(index))
    size = np.where(end > 0.0, forward, backward)
    lost = np.abs(initial) + np.abs(final) + (begin * begin + end * end) / np.abs(size)
    turning = (begin * end > 0.0) & (excess * end < 0.0) & (begin != end)
    excess = np.where(turning & (np.abs(excess) <= _ROUNDING * lost), 0.0, excess)
    back = excess < 0.0
    return Tasks(
        first,
        np.where(back, -1.0, 1.0),
        np.abs(excess),
        np.where(back, -begin, begin),
        np.where(back, -end, end),
        np.where(back, -high, low),
        np.where(back, -low, high),
        np.where(back, back_fall, rise),
        np.where(back, back_rise, fall),
        np.where(back, fall, back_rise),
        np.where(back, rise, back_fall),
    )


def peaks_of(task: Tasks) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """(peak, how much velocity rises to it, how much it falls after, how long it is held [s])."""
    greater = np.maximum(task.begin, task.end)
    k = 1.0 / task.rise + 1.0 / task.fall
    k_back = 1.0 / task.back_rise + 1.0 / task.back_fall
    straight = task.excess == 0.0
    excess = task.excess + np.where(greater < 0.0, 0.5 * k_back * greater * greater, 0.0)
    base = np.where(straight, greater, np.maximum(greater, 0.0))
    gained = np.where(straight, 0.0, 2.0 * excess / k)
    peak = np.where(straight, base, np.sqrt(base * base + gained))
    gain = np.where(straight, 0.0, gained / (peak + base))
    clipped = (peak > task.high) | (peak == np.inf)
    refuse_where(clipped & ~((task.high > 0.0) & (task.high < np.inf)), UNBOUNDED, task.first)
    peak = np.where(clipped, task.high, peak)
    gain = np.where(clipped, task.high - base, gain)
    held = (excess - 0.5 * k * gain * (peak + base)) / peak
    hold_s = np.where(clipped, np.maximum(held, 0.0), 0.0)
    return peak, (base - task.begin) + gain, (base - task.end) + gain, hold_s


def _exactly(given: list[FloatArray], bounds: list[FloatArray], index: int) -> float:
    """The excess of one motion, signed, as the generator of single ones finds it."""
    final, initial, begin, end = (float(a[index] if a.ndim else a) for a in given)
    low, high, rise, fall, back_rise, back_fall = (float(a[index] if a.ndim else a) for a in bounds)
    limits = ProfileLimits.by_direction((low, high), (-fall, rise), (-back_fall, back_rise))
    sign, excess, *_ = task_of(final, limits, initial, begin, end)
    return sign * excess
