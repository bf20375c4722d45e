"""Many profiles of given durations. The formulas are those of `motorapi.generation.durations`."""

import numpy as np

from motorapi.generation.batched.limits import FloatArray, refuse_where
from motorapi.generation.batched.tasks import Tasks, peaks_of
from motorapi.limits import ROUNDING


def peaks_lasting(
    task: Tasks, duration_s: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """(peak, how much velocity rises to it, falls after it, how long it is held, duration [s]).

    Raises:
        UsageError: a duration is not finite and >= 0, or not possible.
    """
    good = np.isfinite(duration_s) & (duration_s >= 0.0)
    refuse_where(~good, "the duration is not a finite number >= 0", task.first)
    found = peaks_of(task)
    shortest_s, lasting_s = _allowed(task, found, duration_s)
    direct_s = task.ramp_s(task.begin, task.end, task.end - task.begin)
    peak = np.clip(_peaks(task, lasting_s - direct_s), task.low, task.high)
    up, down = peak - task.begin, peak - task.end
    ramps_s = task.ramp_s(task.begin, peak, up) + task.ramp_s(peak, task.end, -down)
    chosen = (peak, up, down, np.maximum(lasting_s - ramps_s, 0.0))
    fastest = lasting_s <= shortest_s
    made = [np.where(fastest, one, other) for one, other in zip(found, chosen, strict=True)]
    return made[0], made[1], made[2], made[3], np.where(fastest, shortest_s, lasting_s)


def _peaks(task: Tasks, spare_s: FloatArray) -> FloatArray:
    excess = task.excess
    least, most = np.minimum(task.begin, task.end), np.maximum(task.begin, task.end)
    k = 1.0 / task.rise + 1.0 / task.fall
    k_back = 1.0 / task.back_rise + 1.0 / task.back_fall
    stop, rest_s = 0.5 * k * least * least, spare_s - k * least
    above = most + _roots(excess - most * spare_s, spare_s, -k)
    turned = _roots(excess + 0.5 * k_back * most * most, spare_s + k_back * most, -k)
    slower = least - _roots(least * spare_s - excess, spare_s, -k)
    stopping = _roots(excess - stop, rest_s, k)
    returning = -_roots(stop - excess, rest_s, -k_back)
    return np.select(
        [
            (excess > most * spare_s) & (most >= 0.0),
            excess > most * spare_s,
            excess >= least * spare_s,
            rest_s < 0.0,
            excess >= stop,
        ],
        [above, turned, excess / spare_s, slower, stopping],
        returning,
    )


def _roots(rest: FloatArray, slope: FloatArray, bend: FloatArray) -> FloatArray:
    square = np.maximum(slope * slope + 2.0 * bend * rest, 0.0)
    return np.where(rest > 0.0, 2.0 * rest / (slope + np.sqrt(square)), 0.0)


def _allowed(
    task: Tasks, found: tuple[FloatArray, ...], duration_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The shortest durations, and those asked for, or possible ones that rounding made of them."""
    peak, up, down, hold_s = found
    rise_s = task.ramp_s(task.begin, peak, up)
    shortest_s = rise_s + hold_s + task.ramp_s(peak, task.end, -down)
    excess, low = task.excess, task.low
    least = np.minimum(task.begin, task.end)
    k = 1.0 / task.rise + 1.0 / task.fall
    k_back = 1.0 / task.back_rise + 1.0 / task.back_fall
    direct_s = task.ramp_s(task.begin, task.end, task.end - task.begin)
    missing = 0.5 * k * least * least - excess
    slowest = np.sqrt(np.maximum(least * least - 2.0 * excess / k, 0.0))
    first_s = np.maximum(shortest_s, direct_s + 2.0 * excess / (least + slowest))
    back = np.minimum(np.sqrt(2.0 * missing / k_back), -low)
    held_s = np.where(back < -low, 0.0, (missing - 0.5 * k_back * low * low) / -low)
    second_s = np.where(low == 0.0, np.inf, direct_s + k * least + k_back * back + held_s)
    gap = (least > 0.0) & (missing > 0.0)
    asked = np.where(duration_s < shortest_s, shortest_s, duration_s)
    asked = np.where(gap & (asked > first_s) & (asked < second_s), first_s, asked)
    near = np.abs(asked - duration_s) <= ROUNDING * asked
    late = gap & ~near & (second_s - duration_s <= ROUNDING * second_s) & (second_s < np.inf)
    refuse_where(
        ~(near | late), "not possible in its duration (see possible_durations)", task.first
    )
    return shortest_s, np.where(late, np.maximum(second_s, duration_s), asked)
