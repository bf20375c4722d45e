"""Functions through way-points, many at once."""

import numpy as np
from numpy.typing import ArrayLike

from motorapi.commands import DerivativeLimits
from motorapi.errors import UsageError
from motorapi.generation.batched.curves import Curves
from motorapi.generation.batched.limits import FloatArray
from motorapi.generation.batched.splines import CUBIC, QUINTIC, coefficients_of
from motorapi.generation.batched.times import shortest_times


def through_waypoints(
    values: ArrayLike,
    times: ArrayLike | None = None,
    *,
    limits: DerivativeLimits | None = None,
    first: ArrayLike | None = None,
    second: ArrayLike | None = None,
    degree: int = CUBIC,
) -> Curves:
    """What `motorapi.generation.through_waypoints` makes of each row of `values`.

    Args:
        values: shape (n, m), m >= 2 [U].
        times: shape (n, m) or (m,), ascending [s]; None: as short as `limits` allow, from 0 on.
        limits: of the derivatives, where there are no times.
        first: shape (n, m) or (m,), nan where it is free [U/s]; None: 0 at the ends.
        second: likewise [U/s²], for degree 5.
        degree: of the pieces, 3 or 5.

    Raises:
        UsageError: shapes do not fit, a number is not finite, times do not ascend, or see
            `through_waypoints`.
    """
    points = np.atleast_2d(np.asarray(values, dtype=np.float64))
    if points.shape[1] < 2 or not np.isfinite(points).all():
        raise UsageError("way-points are at least two, and finite numbers")
    if degree not in (CUBIC, QUINTIC):
        raise UsageError(f"pieces are of degree 3 or 5, not {degree}")
    if second is not None and degree == CUBIC:
        raise UsageError("second derivatives are given to pieces of degree 5 only")
    slopes = _derivatives("first", first, points)
    bends = _derivatives("second", second, points) if degree == QUINTIC else None
    if not isinstance(limits, DerivativeLimits | None):
        raise UsageError(f"limits of way-points are DerivativeLimits, not {limits!r}")
    if limits is not None and (times is not None or limits.value is not None):
        what = "their value" if times is None else "way-points with times"
        raise UsageError(
            f"limits of {what} are not kept to: hold the function against them, by"
            " motorapi.generation.feasible"
        )
    if times is None:
        if limits is None:
            raise UsageError("way-points need times, or limits that tell how soon they can be")
        edges = shortest_times(points, (slopes, bends), limits)
    else:
        edges = _fitting("times", times, points)
        if not (np.isfinite(edges).all() and (np.diff(edges) > 0.0).all()):
            raise UsageError("times must be finite numbers and ascend")
    return Curves(edges, coefficients_of(points, edges, slopes, bends))


def _derivatives(name: str, given: ArrayLike | None, points: FloatArray) -> FloatArray:
    if given is None:
        made = np.full(points.shape, np.nan)
        made[:, 0] = made[:, -1] = 0.0
        return made
    made = _fitting(f"{name} derivatives", given, points)
    if np.isinf(made).any():
        raise UsageError(f"{name} derivatives are finite, or nan where they are free")
    return made


def _fitting(name: str, given: ArrayLike, points: FloatArray) -> FloatArray:
    array = np.asarray(given, dtype=np.float64)
    if array.shape not in (points.shape, points.shape[1:]):
        raise UsageError(f"{name} have shape {array.shape}, way-points {points.shape}")
    return np.array(np.broadcast_to(array, points.shape))
