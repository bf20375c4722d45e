"""Many generated profiles, evaluated at once."""

from typing import final

import numpy as np
from numpy.typing import ArrayLike

from motorapi.generation.batched.limits import FloatArray, LimitArrays


@final
class Profiles:
    """n trapezoidal profiles from argument 0 on; their arrays are not to be written to.

    Each ramps to its peak, holds it and ramps to its final velocity, either ramp in two pieces if
    it turns round.

    Attributes, shape (n,):
        peak: the velocity held, or reached between the ramps [U/s], signed.
        duration_s: how long it takes [s].
    """

    __slots__ = ("_hold_s", "_limits", "_rise_s", "_states", "_table", "duration_s", "peak")

    def __init__(self, count: int, states: list[FloatArray], limits: LimitArrays) -> None:
        """To be filled in by the generator; `states` are final, initial, and their velocities."""
        self._limits = limits
        self._states = states
        self._table: _Table | None = None
        self._rise_s: FloatArray | None = None
        self._hold_s: FloatArray | None = None
        self.peak = np.empty(count)
        self.duration_s = np.empty(count)

    @property
    def rise_s(self) -> FloatArray:
        """How long the ramps to the peaks take: when each plateau begins [s]."""
        return self._times()[0]

    @property
    def hold_s(self) -> FloatArray:
        """How long the peaks are held [s]."""
        return self._times()[1]

    def put_ramps(self, part: slice, rise_s: FloatArray, hold_s: FloatArray) -> None:
        """For the generator; without this, they are all from rest to rest."""
        if self._rise_s is None or self._hold_s is None:
            self._rise_s, self._hold_s = np.empty(len(self)), np.empty(len(self))
        self._rise_s[part], self._hold_s[part] = rise_s, hold_s

    def _times(self) -> tuple[FloatArray, FloatArray]:
        if self._rise_s is None or self._hold_s is None:
            limits, size = self._limits, np.abs(self.peak)
            back = np.signbit(self.peak)
            rise = 1.0 / np.where(back, limits.back_fall, limits.rise)
            fall = 1.0 / np.where(back, limits.back_rise, limits.fall)
            self._rise_s = size * rise
            self._hold_s = self.duration_s - (rise + fall) * size
        return self._rise_s, self._hold_s

    def __len__(self) -> int:
        return len(self.peak)

    def __repr__(self) -> str:
        return f"<{len(self)} profiles>"

    def value(self, argument: ArrayLike) -> FloatArray:
        """The function values [U]; arguments of shape (n,) or (n, m), or one number for all."""
        return self._as_table().values_at(np.asarray(argument, dtype=np.float64), 0)

    def first(self, argument: ArrayLike) -> FloatArray:
        """The first derivatives [U/s]; outside the arguments those of the nearer ends."""
        return self._as_table().values_at(np.asarray(argument, dtype=np.float64), 1)

    def second(self, argument: ArrayLike) -> FloatArray:
        """The second derivatives [U/s²]; where two pieces meet that of the later; outside, 0."""
        return self._as_table().values_at(np.asarray(argument, dtype=np.float64), 2)

    def _as_table(self) -> "_Table":
        if self._table is None:
            self._table = _Table(self, self._states, self._limits)
        return self._table


@final
class _Table:
    """Five pieces for each, some of no duration: two to rise, one to hold, two to fall."""

    def __init__(self, made: Profiles, states: list[FloatArray], limits: LimitArrays) -> None:
        count = len(made)
        final, initial, begin, end = (np.broadcast_to(array, (count,)) for array in states)
        peak = made.peak
        zero = np.zeros(count)
        self.entries = np.stack([begin, _middle(begin, peak), peak, peak, _middle(peak, end)])
        self.exits = np.stack([self.entries[1], peak, peak, self.entries[4], end])
        self.accelerations = np.stack(
            [_slope(limits, self.entries[k], self.exits[k]) if k != 2 else zero for k in range(5)]
        )
        with np.errstate(all="ignore"):
            lasts = (self.exits - self.entries) / self.accelerations
        lasts[~np.isfinite(lasts)] = 0.0
        self.accelerations[lasts == 0.0] = 0.0  # without a limit, a ramp is a step
        # The kinks are within the ramps, whose ends are known more exactly.
        times = [zero, np.minimum(lasts[0], made.rise_s), made.rise_s, made.rise_s + made.hold_s]
        times += [np.minimum(times[3] + lasts[3], made.duration_s), made.duration_s]
        self.times = np.stack(times)
        steps = np.diff(self.times, axis=0) * 0.5 * (self.entries + self.exits)
        self.values = np.empty((6, count))
        self.values[0], self.values[5] = initial, final
        np.add(initial, steps[0], out=self.values[1])
        np.add(self.values[1], steps[1], out=self.values[2])
        np.subtract(final, steps[4], out=self.values[4])
        np.subtract(self.values[4], steps[3], out=self.values[3])
        self.ends = (begin, end)

    def values_at(self, argument: FloatArray, order: int) -> FloatArray:
        count = self.times.shape[1]
        rows = np.arange(count)
        if argument.ndim == 2:
            rows = rows[:, None]
        argument = np.broadcast_to(argument, np.broadcast_shapes(argument.shape, rows.shape))
        if order == 2:  # at the very end, that of the last piece
            at_end = argument == self.times[5][rows]
            argument = np.where(at_end, np.nextafter(argument, -np.inf), argument)
        piece = np.zeros(argument.shape, dtype=np.intp)
        for edge in self.times[1:5]:
            piece += argument >= edge[rows]
        times, last = self.times, self.times[5][rows]
        acceleration = self.accelerations[piece, rows]
        if order == 2:
            return np.where((argument < 0.0) | (argument > last), 0.0, acceleration)
        late = piece >= 3  # reckoned from the end of the piece
        corner = piece + late
        local = argument - times[corner, rows]
        entry, leave = self.entries[piece, rows], self.exits[piece, rows]
        velocity = np.where(late, leave, entry)
        if order == 1:
            found = velocity + acceleration * local
            low, high = np.minimum(entry, leave), np.maximum(entry, leave)
            before, after = (end[rows] for end in self.ends)
        else:
            with np.errstate(invalid="ignore"):
                found = self.values[corner, rows] + (velocity + 0.5 * acceleration * local) * local
            near, far = self.values[piece, rows], self.values[piece + 1, rows]
            low, high = np.minimum(near, far), np.maximum(near, far)
            before, after = self.values[0][rows], self.values[5][rows]
        found = np.clip(found, low, high)
        return np.where(argument <= 0.0, before, np.where(argument >= last, after, found))


def _middle(begin: FloatArray, end: FloatArray) -> FloatArray:
    """Where a ramp has its kink: at 0, or at its end if it does not turn round."""
    return np.where(np.sign(begin) * np.sign(end) < 0.0, 0.0, end)


def _slope(limits: LimitArrays, begin: FloatArray, end: FloatArray) -> FloatArray:
    """The second derivative of a ramp that does not turn round."""
    forward = np.maximum(begin, end) > 0.0
    rising = np.where(forward, limits.rise, limits.back_rise)
    falling = np.where(forward, limits.fall, limits.back_fall)
    return np.where(begin == end, 0.0, np.where(end > begin, rising, -falling))
