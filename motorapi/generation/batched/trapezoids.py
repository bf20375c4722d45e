"""Many trapezoidal profiles at once, by the formulas of `motorapi.generation.closed_form`."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from motorapi.generation.batched.durations import peaks_lasting
from motorapi.generation.batched.limits import FloatArray, LimitArrays, refuse_where
from motorapi.generation.batched.profiles import Profiles
from motorapi.generation.batched.tasks import UNBOUNDED, Tasks, peaks_of, tasks_of
from motorapi.generation.limits import ProfileLimits

_AT_REST: Final = np.zeros(1)
_CHUNK: Final = 4096  # motions whose numbers fit the processor's cache


def trapezoids(
    final: ArrayLike,
    limits: LimitArrays | ProfileLimits,
    *,
    initial: ArrayLike = 0.0,
    initial_velocity: ArrayLike = 0.0,
    final_velocity: ArrayLike = 0.0,
    duration_s: ArrayLike | None = None,
) -> Profiles:
    """The profiles that `trapezoid` makes of each; numbers hold for all motions.

    Raises:
        UsageError: as for `trapezoid`; names the first index.
    """
    if isinstance(limits, ProfileLimits):
        limits = LimitArrays.of(limits)
    given = [
        np.asarray(numbers, dtype=np.float64)
        for numbers in (final, initial, initial_velocity, final_velocity)
    ]
    lasting = None if duration_s is None else np.asarray(duration_s, dtype=np.float64)
    at_rest = lasting is None and not (given[2].any() or given[3].any())
    low = limits.high if at_rest and limits.is_symmetric else limits.low
    sides = (low, limits.high, limits.rise, limits.fall, limits.back_rise, limits.back_fall)
    shape = np.broadcast_shapes(
        (1,), *(array.shape for array in (*given, *sides)), () if lasting is None else lasting.shape
    )
    made = Profiles(shape[0], given, limits)
    with np.errstate(all="ignore"):
        for begin in range(0, shape[0], _CHUNK):
            part = slice(begin, min(begin + _CHUNK, shape[0]))
            chunk = [array[part] if array.ndim else array for array in given]
            bounds = [array[part] if array.ndim else array for array in sides]
            if lasting is not None:
                task = tasks_of(begin, chunk, bounds)
                pieces_lasting(made, part, task, lasting[part] if lasting.ndim else lasting)
            elif at_rest:
                way = np.broadcast_to(chunk[0] - chunk[1], made.peak[part].shape)
                task = _from_rest(begin, way, bounds, limits.is_symmetric)
                _make_rest_to_rest(made, part, task)
            else:
                task = tasks_of(begin, chunk, bounds)
                peak, up, down, hold_s = peaks_of(task)
                _make(made, part, task, peak, up, down, hold_s)
    return made


def _from_rest(first: int, way: FloatArray, bounds: list[FloatArray], symmetric: bool) -> Tasks:
    low, high, rise, fall, back_rise, back_fall = bounds
    if not symmetric:
        back = way < 0.0
        rise, fall = np.where(back, back_fall, rise), np.where(back, back_rise, fall)
        high = np.where(back, 0.0 - low, high)  # never -0.0, which is no way to go
    # Of the sign only its sign counts; the limits of backward motion play no part.
    return Tasks(first, way, np.abs(way), _AT_REST, _AT_REST, low, high, rise, fall, rise, fall)


def _make_rest_to_rest(made: Profiles, part: slice, task: Tasks) -> None:
    """As `peaks_of` and `_make`, with all that is 0 left out, and no branch on each number.

    What follows from the peak, `Profiles` works out when it is asked for.
    """
    k = 1.0 / task.rise + 1.0 / task.fall
    gained = task.excess / k
    gained += gained
    fastest = np.sqrt(gained, out=gained)
    peak = np.minimum(fastest, task.high)
    ramps_s = k * peak
    hold_s = task.excess / peak
    hold_s -= 0.5 * ramps_s
    hold_s *= fastest > task.high
    np.fmax(hold_s, 0.0, out=hold_s)  # without a way, 0 / 0 as well
    lasts_s = np.add(ramps_s, hold_s, out=made.duration_s[part])
    np.copysign(peak, task.sign, out=made.peak[part])
    if not np.isfinite(lasts_s).all():
        refuse_where(~np.isfinite(task.excess), "the way is not a finite number", task.first)
        refuse_where(~np.isfinite(lasts_s), UNBOUNDED, task.first)


def _make(
    made: Profiles,
    part: slice,
    task: Tasks,
    peak: FloatArray,
    up: FloatArray,
    down: FloatArray,
    hold_s: FloatArray,
) -> None:
    rise_s, fall_s = task.ramp_s(task.begin, peak, up), task.ramp_s(peak, task.end, -down)
    made.peak[part] = task.sign * peak
    made.put_ramps(part, rise_s, hold_s)
    made.duration_s[part] = rise_s + hold_s + fall_s


def pieces_lasting(made: Profiles, part: slice, task: Tasks, duration_s: FloatArray) -> None:
    """Puts the profiles that take so long into `made`."""
    peak, up, down, hold_s, lasting_s = peaks_lasting(task, duration_s)
    _make(made, part, task, peak, up, down, hold_s)
    made.duration_s[part] = lasting_s
