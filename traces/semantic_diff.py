"""Semantic differences between two recordings.

Each order of commands and reports in `Meaning` is compared, and motion. A quantity must be within a
tolerance of the other recording's value, within a tolerance of time.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, final

from traces.meaning import Item, Key, Meaning

_MEASURED_MIN: Final = 32
"""The number of different values in both from which on a subject is a measured quantity."""

Series = tuple[list[int], list[float]]


@final
@dataclass(frozen=True, slots=True)
class Tolerance:
    """Tolerances of motion.

    Attributes:
        position: of motors [rad or m].
        time_ns: of all times.
        share: of a quantity's own range, for quantities in drive units (at least two of them).
    """

    position: float = 0.01
    time_ns: int = 50_000_000
    share: float = 0.01


@final
@dataclass(frozen=True, slots=True)
class Difference:
    """The first difference of one order or quantity; None: nothing there in that recording.

    Attributes:
        key: the subject.
        label: the subject in words.
        first, second: the report in each recording.
    """

    key: Key
    label: str
    first: Item | None
    second: Item | None

    @property
    def time_ns(self) -> int:
        """The time at which it begins."""
        return min(item.time_ns for item in (self.first, self.second) if item is not None)

    def __str__(self) -> str:
        return f"{self.label}: {_told(self.first)}, but {_told(self.second)}"


def differences(first: Meaning, second: Meaning, tolerance: Tolerance) -> list[Difference]:
    """Return the first difference of each order and quantity, by time; empty if none."""
    found: list[Difference] = []
    labels = {**second.labels, **first.labels}
    for key in {**first.items, **second.items}:
        one, other = first.items.get(key, []), second.items.get(key, [])
        if is_measured(one) and is_measured(other):
            continue
        difference = _of_items(key, labels[key], one, other)
        if difference is not None:
            found.append(difference)
    for key in {**first.motions, **second.motions}:
        pair = first.motions.get(key), second.motions.get(key)
        difference = _of_motion(key, labels[key], pair, tolerance)
        if difference is not None:
            found.append(difference)
    return sorted(found, key=lambda difference: difference.time_ns)


def is_measured(items: list[Item]) -> bool:
    """Return True if the reports have so many values that they are a measured quantity."""
    if len(items) < _MEASURED_MIN or len({item.what[0] for item in items}) > 1:
        return False
    return len(dict.fromkeys(item.what for item in items)) >= _MEASURED_MIN


def _of_items(key: Key, label: str, one: list[Item], other: list[Item]) -> Difference | None:
    for number in range(max(len(one), len(other))):
        first = one[number] if number < len(one) else None
        second = other[number] if number < len(other) else None
        if first is None or second is None or first.what != second.what:
            return Difference(key, label, first, second)
    return None


def _of_motion(
    key: Key, label: str, pair: tuple[Series | None, Series | None], tolerance: Tolerance
) -> Difference | None:
    one, other = pair
    if one is None or other is None:
        (times, values) = one or other or ([0], [0.0])
        there = Item(times[0], (), f"{values[0]:g}")
        return Difference(key, label, *((there, None) if one else (None, there)))
    allowed = allowed_of(key, one, other, tolerance)
    for series, against, turned in ((other, one, True), (one, other, False)):
        found = _first_apart(series, against, allowed, tolerance.time_ns)
        if found is not None:
            here, there = found
            return Difference(key, label, *((there, here) if turned else (here, there)))
    return None


def allowed_of(key: Key, one: Series, other: Series, tolerance: Tolerance) -> float:
    """Return the tolerance between the two, in the quantity's own unit."""
    if key[1] is None and key[2] == "position":
        return tolerance.position
    spread = max(max(one[1]) - min(one[1]), max(other[1]) - min(other[1]))
    return max(2.0, tolerance.share * spread)


def apart(series: Series, against: Series, time_ns: int) -> Iterator[tuple[int, float]]:
    """Yield (time [ns], distance) of each sample from the other series within `time_ns`.

    The other series is interpolated linearly; before its first and after its last sample it is
    constant.
    """
    times, values = against
    for now_ns, value in zip(*series, strict=True):
        early, late = now_ns - time_ns, now_ns + time_ns
        begin, end = bisect_left(times, early), bisect_right(times, late)
        near = [*values[begin:end], _at(against, early), _at(against, late)]
        yield now_ns, max(min(near) - value, value - max(near), 0.0)


def _first_apart(
    series: Series, against: Series, allowed: float, time_ns: int
) -> tuple[Item, Item] | None:
    """Return the first sample that deviates from the other series, and the other's value."""
    for (now_ns, distance), value in zip(apart(series, against, time_ns), series[1], strict=True):
        if distance > allowed:
            there = _at(against, now_ns)
            return Item(now_ns, (), f"{value:g}"), Item(now_ns, (), f"{there:g}")
    return None


def _at(series: Series, time_ns: int) -> float:
    times, values = series
    place = bisect_right(times, time_ns)
    if place == 0 or place == len(times):
        return values[min(place, len(times) - 1)]
    before, behind = times[place - 1], times[place]
    share = (time_ns - before) / (behind - before)
    return values[place - 1] + share * (values[place] - values[place - 1])


def _told(item: Item | None) -> str:
    return "nothing" if item is None else f"{item.text} at {item.time_ns / 1e9:.6f} s"
