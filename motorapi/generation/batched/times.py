"""How soon way-points can be gone through within limits of the derivatives.

Slowing a motion from rest to rest down by a factor s makes its first derivative s times smaller,
its second s² times, its third s³ times. So for given *ratios* of the times the shortest ones follow
at once. The ratios begin as what each piece would take alone; then each time in turn is tried
longer and shorter, as long as that gains something, with a step that shrinks (a pattern search; of
more than 32 pieces the first ratios stay). That ends near the optimum, not provably at it; the
limits are held to rounding either way.
"""

from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from motorapi.commands import DerivativeLimits
from motorapi.errors import UsageError
from motorapi.generation.batched.curves import differentiated, ranges
from motorapi.generation.batched.limits import FloatArray
from motorapi.generation.batched.splines import coefficients_of

_ROUNDS: Final = 40
_TRIED_MOST: Final = 32  # pieces; the effort grows with the square
_LEAST_REACH: Final = 0.01  # relative change of a step that is tried last
_SLOWEST: Final = 2.0**40  # how much slower than at first it is tried with given velocities

Derivatives: TypeAlias = tuple[FloatArray, FloatArray | None]
"""First and second derivatives at the way-points, as for `coefficients_of`."""


def shortest_times(
    values: FloatArray, derivatives: Derivatives, limits: DerivativeLimits
) -> FloatArray:
    """Times from 0 on for the way-points, shape (n, m).

    Args:
        values: shape (n, m).
        derivatives: at the way-points.
        limits: of first, second and third derivative, at least one of them.

    Raises:
        UsageError: nothing is limited, no two neighbouring way-points differ, or velocities are
            given that no times keep within the limits.
    """
    bounds = [(k, x) for k, x in ((1, limits.first), (2, limits.second), (3, limits.third)) if x]
    if not any(np.isfinite(bound).any() for _, bound in bounds):
        raise UsageError("without times there must be a limit of a derivative")
    rise = np.abs(np.diff(values))
    if not (rise.sum(axis=1) > 0.0).all():
        raise UsageError("way-points that are all the same take no time: give times")
    steps: FloatArray = np.zeros(rise.shape)
    for order, (low, high) in bounds:
        size = min(-low, high)
        if np.isfinite(size):
            steps = np.maximum(steps, (rise / size) ** (1.0 / order))
    steps = np.maximum(steps, 0.05 * steps.mean(axis=1, keepdims=True))
    steps, _ = _nearly_scaled(values, derivatives, steps, bounds)
    if steps.shape[1] <= _TRIED_MOST:
        steps = _tried(values, derivatives, steps, bounds)
    steps = _scaled(values, derivatives, steps, bounds)
    times = np.zeros(values.shape)
    np.cumsum(steps, axis=1, out=times[:, 1:])
    return times


def _tried(
    values: FloatArray,
    derivatives: Derivatives,
    steps: FloatArray,
    bounds: list[tuple[int, tuple[float, float]]],
) -> FloatArray:
    """The steps, with each in turn made longer or shorter as long as that gains something."""
    count, pieces = steps.shape
    changes = np.concatenate([np.eye(pieces), -np.eye(pieces)])
    tries = len(changes)
    many = np.repeat(values, tries, axis=0)
    first, second = derivatives
    wide = (
        np.repeat(first, tries, axis=0),
        None if second is None else np.repeat(second, tries, axis=0),
    )
    rows, reach = np.arange(count), np.full(count, 0.4)
    best = steps.sum(axis=1)
    for _ in range(_ROUNDS):
        tried = steps[:, None, :] * np.exp(reach[:, None, None] * changes)
        made = _nearly_scaled(many, wide, tried.reshape(-1, pieces), bounds)[0]
        made = made.reshape(count, tries, pieces)
        totals = made.sum(axis=2)
        choice = totals.argmin(axis=1)
        better = (totals[rows, choice] < best * (1.0 - 1e-6)) & (reach >= _LEAST_REACH)
        steps = np.where(better[:, None], made[rows, choice], steps)
        best = np.where(better, totals[rows, choice], best)
        reach = np.where(better, reach, 0.4 * reach)
        if (reach < _LEAST_REACH).all():
            break
    return steps


def _is_moving(derivatives: Derivatives) -> bool:
    """Whether a derivative is given that is not 0, so that slower does not scale everything."""
    first, second = derivatives
    return bool(np.nan_to_num(first).any() or (second is not None and np.nan_to_num(second).any()))


def _nearly_scaled(
    values: FloatArray,
    derivatives: Derivatives,
    steps: FloatArray,
    bounds: list[tuple[int, tuple[float, float]]],
) -> tuple[FloatArray, FloatArray]:
    """The steps, all longer or shorter so that the limits are just held, or nearly; how used."""
    for _ in range(4 if _is_moving(derivatives) else 1):
        used = _used(values, derivatives, steps, bounds)
        factor = used.max(axis=1, keepdims=True)
        steps = steps * factor
    return steps, used / factor


def _scaled(
    values: FloatArray,
    derivatives: Derivatives,
    steps: FloatArray,
    bounds: list[tuple[int, tuple[float, float]]],
) -> FloatArray:
    """The steps, all longer or shorter by a factor so that the limits are just held."""
    if not _is_moving(derivatives):
        used = _used(values, derivatives, steps, bounds)
        longer: FloatArray = steps * used.max(axis=1, keepdims=True) * (1.0 + 1e-15)
        return longer

    def held(factor: FloatArray) -> NDArray[np.bool_]:
        most = _used(values, derivatives, steps * factor[:, None], bounds).max(axis=1)
        return np.asarray(most <= 1.0)

    high = np.ones(len(values))
    while not (enough := held(high)).all():
        high = np.where(enough, high, 2.0 * high)
        if high.max() > _SLOWEST:
            raise UsageError("no times keep the derivatives that are given within the limits")
    low = 0.5 * high
    for _ in range(60):
        middle = np.sqrt(low * high)
        enough = held(middle)
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    return steps * high[:, None]


def _used(
    values: FloatArray,
    derivatives: Derivatives,
    steps: FloatArray,
    bounds: list[tuple[int, tuple[float, float]]],
) -> FloatArray:
    """For each piece, the factor by which its limits would have it slower (< 1: quicker)."""
    times = np.concatenate([np.zeros((len(values), 1)), np.cumsum(steps, axis=1)], axis=1)
    coefficients = coefficients_of(values, times, *derivatives)
    used = np.zeros(steps.shape)
    for order, (low, high) in bounds:
        lowest, highest = ranges(differentiated(coefficients, order), steps)
        most = np.maximum(np.maximum(lowest / low, highest / high), 0.0)
        used = np.maximum(used, most ** (1.0 / order))
    return used
