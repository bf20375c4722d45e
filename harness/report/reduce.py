"""Reduction of points without visible loss: first, last, lowest, highest of each stretch."""

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from numpy import float64, int64
    from numpy.typing import NDArray

POINTS_MAX: Final = 1_500_000
"""Points of all quantities together; below this number all are in the page."""
FRAMES_MAX: Final = 1_500_000
"""Frames of all buses together; above, they are summed in cells of time and identifier."""


def share(count: int, total: int, budget: int) -> int:
    """Return the share of a budget for `count` of `total`; all of them if it is sufficient."""
    return count if total <= budget else max(400, count * budget // total)


def extremes(
    times: "NDArray[int64]", values: "NDArray[float64]", points: int
) -> "tuple[NDArray[int64], NDArray[float64]]":
    """Return about `points` of the points: those of each stretch of time that are visible.

    Shapes: (n,) each, times ascending. Source: Jugel, Jerzak, Hackenbroich & Markl, M4: A
    Visualization-Oriented Time Series Data Aggregation (VLDB 2014).
    """
    import numpy as np

    if len(times) <= points:
        return times, values
    stretches = max(1, points // 4)
    first, last = int(times[0]), int(times[-1])
    width = max(1, -(-(last - first + 1) // stretches))
    group = (times - first) // width
    starts = np.flatnonzero(np.diff(group, prepend=group[0] - 1))
    ends = np.append(starts[1:], len(times)) - 1
    by_value = np.lexsort((values, group))  # by value within each stretch
    kept = np.unique(np.concatenate((starts, ends, by_value[starts], by_value[ends])))
    return times[kept], values[kept]


def cells(
    times: "NDArray[int64]", keys: "NDArray[int64]", weights: "NDArray[int64]", width_ns: int
) -> "tuple[NDArray[int64], NDArray[int64], NDArray[int64], NDArray[int64]]":
    """Sum frames by time and identifier: (ends [ns], keys, weights, counts), by time.

    Shapes: (n,) each, times ascending. The end of a cell is that of its stretch of time.
    """
    import numpy as np

    stretch = times // width_ns
    codes = stretch * (1 << 16) + keys
    found, place = np.unique(codes, return_inverse=True)
    sums = np.bincount(place, weights=weights).astype(np.int64)
    counts = np.bincount(place).astype(np.int64)
    return ((found >> 16) + 1) * width_ns, found & 0xFFFF, sums, counts
