"""Quantities over time: appended, reduced without visible loss, packed into one text.

Values are appended one by one, then read as numpy arrays. A reduction keeps first, last, lowest and
highest of each stretch of time. Tracks of a long recording are reduced while it is read, so that
their memory is bounded. The stretches then double; each contains two former ones, so no lowest or
highest value is lost. Arrays are packed as base64 of deflated bytes, sorted by significance.
"""

import base64
import zlib
from array import array
from bisect import bisect_left
from typing import TYPE_CHECKING, Final, final

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from numpy import float64, int64, integer
    from numpy.typing import NDArray

Packed = dict[str, object]
"""A packed array: type ("u8", "u16", "u32", "f32"), offset, count; for times, delta is true."""
TICKS_MAX: Final = (1 << 32) - 1
POINTS_MAX: Final = 1_500_000
"""Points of all quantities together; below this number all are in the page."""
FRAMES_MAX: Final = 1_500_000
"""Frames of all buses together; above, they are summed in cells of time and identifier."""
KEPT_MAX: Final = 2_000_000
"""Points of all tracks together while a recording is read; above, the tracks are reduced."""
STEPS_MAX: Final = 20_000
"""Bars in one row of a timeline; the remaining changes are counted as left out."""
STRETCH_NS: Final = 125_000
"""The shortest stretch of a reduction; the others are this one times a power of two."""
TIME_MAX_NS: Final = 1 << 62
"""Limit of drawn times; a stamp that far from the beginning is invalid."""


@final
class Track:
    """One quantity: times [ns from the recording's beginning] and values, in order of arrival.

    Attributes:
        held: True if a value holds until the next one; False if it samples a smooth quantity.
        last: the latest value; None: there is none.
        omitted: number of points that reductions have removed.
    """

    __slots__ = ("held", "last", "omitted", "times_ns", "values")

    def __init__(self, held: bool = False) -> None:
        self.times_ns: array[int] = array("q")
        self.values: array[float] = array("d")
        self.held: bool = held
        self.last: float | None = None
        self.omitted: int = 0

    def __len__(self) -> int:
        return len(self.times_ns)

    def add(self, time_ns: int, value: float) -> None:
        """Append a value; an unchanged value of a held quantity is skipped."""
        if self.held and value == self.last:
            return
        self.last = value
        self.times_ns.append(time_ns)
        self.values.append(value)

    def extend(self, times: "NDArray[int64]", values: "NDArray[float64]") -> None:
        """Append many values of a quantity that is not held."""
        self.times_ns.frombytes(times.tobytes())
        self.values.frombytes(values.tobytes())

    def replace(self, times: "NDArray[int64]", values: "NDArray[float64]") -> None:
        """Replace all points by these, which represent them."""
        self.omitted += max(0, len(self.times_ns) - len(times))
        self.times_ns = array("q", times.tobytes())
        self.values = array("d", values.tobytes())

    def since(self, time_ns: int) -> "Track":
        """Return a copy from the last time before `time_ns` on; times must ascend.

        All points with that last time are in it: two of them are a step.
        """
        part = Track(self.held)
        begin = bisect_left(self.times_ns, time_ns)
        if begin:
            begin = bisect_left(self.times_ns, self.times_ns[begin - 1])
        part.times_ns, part.values = self.times_ns[begin:], self.values[begin:]
        part.last = self.last
        return part

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
        times_ns, codes: the times [ns] and the numbers, of the first `STEPS_MAX` changes.
        last: the present number; None: unknown.
        left_out: number of later changes.
    """

    __slots__ = ("codes", "last", "left_out", "times_ns")

    def __init__(self) -> None:
        self.times_ns: array[int] = array("q")
        self.codes: array[int] = array("q")
        self.last: int | None = None
        self.left_out: int = 0

    def __len__(self) -> int:
        return len(self.times_ns)

    def add(self, time_ns: int, code: int) -> bool:
        """Append a state; return True if it differs from the previous one."""
        if code == self.last:
            return False
        self.last = code
        if len(self.codes) > STEPS_MAX:
            self.left_out += 1
            return True
        self.times_ns.append(time_ns)
        self.codes.append(code)
        return True

    def since(self, time_ns: int) -> "Steps":
        """Return a copy from the last change before `time_ns` on."""
        begin = len(self.times_ns)
        while begin > 0:
            begin -= 1
            if self.times_ns[begin] < time_ns:
                break
        part = Steps()
        part.times_ns, part.codes = self.times_ns[begin:], self.codes[begin:]
        part.last = self.last
        return part


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


def remarkable(
    times: "NDArray[int64]",
    columns: "Sequence[NDArray[float64]]",
    rates: "Sequence[NDArray[float64]]",
    width_ns: int,
) -> "NDArray[int64]":
    """Return the places of the points that remain in a reduction to stretches of `width_ns`.

    In each stretch the first and the last point remain, and the lowest and the highest of each
    column. A rate belongs to two points, its own and the next; of the extremes of `rates` both
    remain.

    Shapes: (n,) each, n > 0, times ascending.
    """
    import numpy as np

    group = times // width_ns
    starts = np.flatnonzero(np.diff(group, prepend=group[0] - 1))
    sizes = np.diff(np.append(starts, len(times)))
    kept = [starts, starts + sizes - 1]
    for values in (*columns, *rates):
        for extreme in (np.fmin, np.fmax):
            places = np.flatnonzero(values == np.repeat(extreme.reduceat(values, starts), sizes))
            first = places[np.flatnonzero(np.diff(group[places], prepend=group[0] - 1))]
            kept.append(first)
            if any(values is one for one in rates):
                kept.append(np.minimum(first + 1, len(times) - 1))
    return np.unique(np.concatenate(kept))


def differences(
    times_ns: "NDArray[int64]", values: "NDArray[float64]", step_ns: int | None = None
) -> "NDArray[float64]":
    """Return the rate [1/s] from each point to the next; 0 after the last one.

    Two points at the same time are a step after a pause in the recording. The step took one
    sampling period at most; the shortest distance between two points is used for it.

    Args:
        times_ns: the times [ns], ascending.
        values: the values.
        step_ns: the shortest distance [ns]; None: that of these points.
    """
    import numpy as np

    if len(times_ns) < 2:
        return np.zeros(len(times_ns))
    steps = np.diff(times_ns)
    shortest_ns = shortest_step_ns(times_ns) if step_ns is None else step_ns
    rates = np.diff(values) / (np.maximum(steps, shortest_ns or 1) / 1e9)
    return np.append(rates, 0.0)


def shortest_step_ns(times_ns: "NDArray[int64]") -> int | None:
    """Return the shortest distance of two times that differ [ns]; None: there is none."""
    import numpy as np

    steps = np.diff(times_ns)
    positive = steps[steps > 0]
    return int(positive.min()) if len(positive) else None


def difference(one: Track, other: Track) -> "tuple[NDArray[int64], NDArray[float64]]":
    """Return one minus the other at every time of either, from the first common time on."""
    import numpy as np

    (t1, v1), (t2, v2) = one.sorted(), other.sorted()
    times = np.unique(np.concatenate((t1, t2)))
    times = times[times >= max(t1[0], t2[0])]
    return times, held_at(times, t1, v1) - held_at(times, t2, v2)


def held_at(
    times: "NDArray[int64]", changes: "NDArray[int64]", values: "NDArray[float64]"
) -> "NDArray[float64]":
    """Return the values of a held quantity at these times, from its first change on."""
    import numpy as np

    return values[np.searchsorted(changes, times, "right") - 1]


def reduce_rows(tracks: "Iterable[Track]", rated: "Collection[Track]", width_ns: int) -> None:
    """Reduce tracks to stretches of this duration; those with the same times keep the same ones.

    Of the tracks in `rated` the largest and the smallest slope remain as well.
    """
    alike: dict[bytes, list[Track]] = {}
    for track in tracks:
        if len(track):
            alike.setdefault(track.times_ns.tobytes(), []).append(track)
    for group in alike.values():
        times = group[0].sorted()[0]
        columns = [track.sorted()[1] for track in group]
        rates = [
            differences(times, values)
            for track, values in zip(group, columns, strict=True)
            if track in rated
        ]
        kept = remarkable(times, columns, rates, width_ns)
        for track, values in zip(group, columns, strict=True):
            track.replace(times[kept], values[kept])


def reduce_held(pair: "Sequence[Track]", width_ns: int) -> None:
    """Reduce two held quantities, so that the extremes of their difference remain as well."""
    import numpy as np

    points = [track.sorted() for track in pair]
    times = np.unique(np.concatenate([one[0] for one in points]))
    columns = [held_at(np.maximum(times, one[0][0]), *one) for one in points]
    kept = remarkable(times, (*columns, columns[0] - columns[1]), (), width_ns)
    for track, (changes, _), values in zip(pair, points, columns, strict=True):
        own = kept[times[kept] >= changes[0]]
        track.replace(times[own], values[own])


def cells(
    times: "NDArray[int64]",
    keys: "NDArray[int64]",
    weights: "NDArray[int64]",
    counts: "NDArray[int64]",
    width_ns: int,
) -> "tuple[NDArray[int64], NDArray[int64], NDArray[int64], NDArray[int64]]":
    """Sum frames by time and identifier: (begins [ns], keys, weights, counts), by time.

    The begin of a cell is that of its stretch of time.

    Shapes: (n,) each.
    """
    import numpy as np

    codes = times // width_ns * (1 << 16) + keys
    order = np.argsort(codes, kind="stable")
    codes = codes[order]
    starts = np.flatnonzero(np.diff(codes, prepend=codes[:1] - 1))
    found = codes[starts]
    sums = np.add.reduceat(weights[order], starts)
    return (found >> 16) * width_ns, found & 0xFFFF, sums, np.add.reduceat(counts[order], starts)


def cell_width_ns(
    times: "NDArray[int64]", keys: "NDArray[int64]", budget: int, width_ns: int = STRETCH_NS
) -> int:
    """Return the shortest width, from `width_ns` on, with at most `budget` cells [ns]."""
    import numpy as np

    while True:
        codes = np.sort(times // width_ns * (1 << 16) + keys)
        if np.count_nonzero(np.diff(codes)) < budget or width_ns > 1 << 60:
            return width_ns
        width_ns *= 2


@final
class Packer:
    """Packer of arrays, with times in ticks; the whole recording has at most 2^32 of them.

    Attributes:
        tick_ns: duration of a tick [ns].
    """

    def __init__(self, span_ns: int) -> None:
        self.tick_ns: int = max(1, -(-span_ns // TICKS_MAX))
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

    def data(self) -> bytes:
        """Return all arrays."""
        return b"".join(self._parts)

    def text(self) -> str:
        """Return all arrays as one text."""
        return base64.b64encode(zlib.compress(self.data(), 7)).decode("ascii")

    def _add(self, kind: str, array: "NDArray[integer[object]] | NDArray[float64]") -> Packed:  # type: ignore[type-var]
        import numpy as np

        size = array.dtype.itemsize
        told: Packed = {"type": kind, "offset": self._size, "count": len(array)}
        # The most significant bytes hardly vary; next to each other they compress well.
        data = array.view(np.uint8).reshape(-1, size).T.tobytes()
        self._parts.append(data)
        self._size += len(data)
        return told
