"""Quantities over time: appended, reduced without visible loss, packed into one text.

Values are appended one by one, then read as numpy arrays. A reduction keeps first, last, lowest and
highest of each stretch of time. Arrays are packed as base64 of deflated bytes, sorted by
significance.
"""

import base64
import zlib
from array import array
from typing import TYPE_CHECKING, Final, final

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy import float64, int64, integer
    from numpy.typing import NDArray

Packed = dict[str, object]
"""A packed array: type ("u8", "u16", "u32", "f32"), offset, count; for times, delta is true."""
TICKS_MAX: Final = (1 << 32) - 1
POINTS_MAX: Final = 1_500_000
"""Points of all quantities together; below this number all are in the page."""
FRAMES_MAX: Final = 1_500_000
"""Frames of all buses together; above, they are summed in cells of time and identifier."""
TIME_MAX_NS: Final = 1 << 62
"""Limit of drawn times; a stamp that far from the beginning is invalid."""


@final
class Track:
    """One quantity: times [ns from the recording's beginning] and values, in order of arrival.

    Attributes:
        held: True if a value holds until the next one; False if it samples a smooth quantity.
    """

    __slots__ = ("_last", "held", "times_ns", "values")

    def __init__(self, held: bool = False) -> None:
        self.times_ns: array[int] = array("q")
        self.values: array[float] = array("d")
        self.held = held
        self._last: float | None = None

    def __len__(self) -> int:
        return len(self.times_ns)

    def add(self, time_ns: int, value: float) -> None:
        """Append a value; an unchanged value of a held quantity is skipped."""
        if self.held and value == self._last:
            return
        self._last = value
        self.times_ns.append(time_ns)
        self.values.append(value)

    def sorted(self) -> "tuple[NDArray[int64], NDArray[float64]]":
        """Return times and values by time; equal times keep their order."""
        import numpy as np

        times = np.array(self.times_ns, dtype=np.int64)
        values = np.array(self.values, dtype=np.float64)
        if len(times) > 1 and bool(np.any(np.diff(times) < 0)):
            order = np.argsort(times, kind="stable")
            times, values = times[order], values[order]
        return times, values


@final
class Steps:
    """A state over time: a number from each time on, in order of arrival.

    Attributes:
        times_ns, codes: the times [ns] and the numbers.
        last: the present number; None: unknown.
    """

    __slots__ = ("codes", "last", "times_ns")

    def __init__(self) -> None:
        self.times_ns: array[int] = array("q")
        self.codes: array[int] = array("q")
        self.last: int | None = None

    def __len__(self) -> int:
        return len(self.times_ns)

    def add(self, time_ns: int, code: int) -> bool:
        """Append a state; return True if it differs from the previous one."""
        if code == self.last:
            return False
        self.last = code
        self.times_ns.append(time_ns)
        self.codes.append(code)
        return True


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


@final
class Packer:
    """Packer of arrays, with times in ticks; the whole recording has at most 2^32 of them.

    Attributes:
        tick_ns: duration of a tick [ns].
    """

    def __init__(self, span_ns: int) -> None:
        self.tick_ns = max(1, -(-span_ns // TICKS_MAX))
        self._parts: list[bytes] = []
        self._size = 0

    def ticks(self, time_ns: int) -> int:
        """Return a time from the recording's beginning in ticks."""
        return min(max(0, time_ns) // self.tick_ns, TICKS_MAX)

    def times(self, times_ns: "NDArray[int64]") -> Packed:
        """Pack ascending times as differences."""
        import numpy as np

        ticks = np.clip(times_ns // self.tick_ns, 0, TICKS_MAX)
        steps = np.diff(ticks, prepend=0)
        return {**self._add("u32", steps.astype("<u4")), "delta": True}

    def whole(self, values: "Sequence[int] | NDArray[int64]") -> Packed:
        """Pack whole numbers from 0, in as many bytes as the largest needs."""
        import numpy as np

        array = np.asarray(values, dtype=np.int64)
        top = int(array.max()) if len(array) else 0
        kind = "u8" if top < 1 << 8 else "u16" if top < 1 << 16 else "u32"
        return self._add(kind, np.minimum(array, TICKS_MAX).astype(f"<u{int(kind[1:]) // 8}"))

    def numbers(self, values: "NDArray[float64]") -> Packed:
        """Pack numbers as differences from the first finite one."""
        import numpy as np

        finite = values[np.isfinite(values)]
        base = float(finite[0]) if len(finite) else 0.0
        with np.errstate(over="ignore"):
            return {**self._add("f32", (values - base).astype("<f4")), "base": base}

    def text(self) -> str:
        """Return all arrays as one text."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 7)).decode("ascii")

    def _add(self, kind: str, array: "NDArray[integer[object]] | NDArray[float64]") -> Packed:  # type: ignore[type-var]
        import numpy as np

        size = array.dtype.itemsize
        told: Packed = {"type": kind, "offset": self._size, "count": len(array)}
        # The most significant bytes hardly vary; next to each other they compress well.
        data = array.view(np.uint8).reshape(-1, size).T.tobytes()
        self._parts.append(data)
        self._size += len(data)
        return told
