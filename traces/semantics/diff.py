"""Semantic differences between two recordings.

Each order of commands and reports in `Meaning` is compared, and motion. A quantity must be within a
tolerance of the other recording's value, within a tolerance of time.

Agreement between the devices of two recordings, object by object.

Both recordings have the same host: one is of a device, the other of its replacement. States agree
where both report the same ones in the same order. A measured or demanded quantity agrees at a
sample that is within the tolerance of `semantic_diff`. First the times of the first recording are
mapped to the second's by host frames that are in both. So a device that only answers later does not
differ in everything that follows. Measured quantities that vary from run to run (velocities,
currents, and others with many values in arbitrary order) are not compared, and the result says so.
"""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from difflib import SequenceMatcher
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.traces.decoding.events import CONTROLLER, FOREIGN
from motorhil.traces.semantics.model import COMMANDS, Item, Key, Meaning, Series

_MEASURED_MIN: Final = 32
"""The number of different values in both from which on a subject is a measured quantity."""
_TURN: Final = {"rad": math.tau, "deg": 360.0, "rev": 1.0}  # of units of described signals
_SURE: Final = 0.99  # of the tolerance: the rest covers the rounding of an interpolation


@final
@frozen
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
@frozen
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
    unit = key[2].rpartition("[")[2].removesuffix("]")
    least = 2.0 if unit not in _TURN else tolerance.position * _TURN[unit] / math.tau
    spread = max(max(one[1]) - min(one[1]), max(other[1]) - min(other[1]))
    return max(least, tolerance.share * spread)


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
    for now_ns, value in zip(*series, strict=True):
        there = _at(against, now_ns)
        if abs(value - there) < _SURE * allowed:  # no need to look at the values around
            continue
        ((_, distance),) = apart(([now_ns], [value]), against, time_ns)
        if distance > allowed:
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


@final
@frozen
class ObjectFidelity:
    """One object of one node.

    Attributes:
        key: bus, node, object.
        label: the same in words.
        first, second: number of reports in each recording; for states, number of changes.
        agreeing: number of reports that agree.
        worst: the largest distance of a quantity, in its own unit; None: it is a state.
        worst_ns: the time of the largest distance.
        is_compared: False if the object is only listed.
    """

    key: Key
    label: str
    first: int
    second: int
    agreeing: int
    worst: float | None = None
    worst_ns: int = 0
    is_compared: bool = True

    @property
    def of(self) -> int:
        """The number of reports that could agree; for a quantity, the first recording's samples."""
        if not self.is_compared:
            return 0
        is_there = self.worst is not None and self.first
        return self.first if is_there else max(self.first, self.second)

    @property
    def share(self) -> float:
        """The share that agrees, 0 to 1."""
        return self.agreeing / self.of if self.of else 1.0


def told_by_nodes(meaning: Meaning, foreign: bool = True) -> Meaning:
    """Return only the reports of devices, without commands and other records.

    Error messages are not reports of devices, but of the bus.

    Args:
        meaning: the meaning of a recording.
        foreign: True to compare frames of an unknown protocol too. Their identifiers do not show
            the sender. So they are only counted if the recorded direction is unknown.
    """
    kept = Meaning()
    kept.messages = meaning.messages
    kept.labels = meaning.labels
    kept.items = {
        key: items
        for key, items in meaning.items.items()
        if key[2] != COMMANDS
        and not key[2].startswith(CONTROLLER)
        and (key[1] is not None or (foreign and key[2].startswith(FOREIGN)))
    }
    kept.motions = {key: series for key, series in meaning.motions.items() if key[1] is not None}
    kept.unheeded = {key: count for key, count in meaning.unheeded.items() if count}
    if not foreign:
        strangers = [key for key in meaning.items if key[2].startswith(FOREIGN)]
        kept.unheeded |= {key: len(meaning.items[key]) for key in strangers}
    return kept


def retimed(meaning: Meaning, pairs: Sequence[tuple[int, int]]) -> Meaning:
    """Return the same meaning at other times.

    Args:
        meaning: the meaning of a recording.
        pairs: (old time, new time) [ns], at least one. Times between two pairs are interpolated;
            times before and after all pairs keep their distance to the nearest.
    """
    change = _change(sorted(pairs))
    moved = Meaning()
    moved.messages, moved.labels = meaning.messages, meaning.labels
    moved.unheeded = meaning.unheeded
    for key, items in meaning.items.items():
        moved.items[key] = [replace(item, time_ns=change(item.time_ns)) for item in items]
    for key, (times, values) in meaning.motions.items():
        moved.motions[key] = ([change(time_ns) for time_ns in times], values)
    return moved


def _change(pairs: list[tuple[int, int]]) -> Callable[[int], int]:
    froms = [before for before, _ in pairs]

    def change(time_ns: int) -> int:
        place = bisect_right(froms, time_ns)
        if place in (0, len(pairs)):
            before, now = pairs[min(place, len(pairs) - 1)]
            return now + time_ns - before
        (left, left_now), (right, right_now) = pairs[place - 1], pairs[place]
        return left_now + (time_ns - left) * (right_now - left_now) // (right - left)

    return change


def fidelity(first: Meaning, second: Meaning, tolerance: Tolerance) -> list[ObjectFidelity]:
    """Return the agreement of each object, those of the first recording in its order."""
    found: list[ObjectFidelity] = []
    labels = {**second.labels, **first.labels}
    for key in {**first.items, **second.items}:
        items, others = first.items.get(key, []), second.items.get(key, [])
        if is_measured(items) and is_measured(others):
            found.append(_not_compared(key, labels[key], len(items), len(others)))
            continue
        mine, theirs = [item.what for item in items], [item.what for item in others]
        agreeing = len(mine)
        if mine != theirs:  # matching takes the square of their length
            blocks = SequenceMatcher(None, mine, theirs, autojunk=False).get_matching_blocks()
            agreeing = sum(block.size for block in blocks)
        found.append(ObjectFidelity(key, labels[key], len(items), len(others), agreeing))
    for key in {**first.motions, **second.motions}:
        series, other = first.motions.get(key), second.motions.get(key)
        found.append(_motion_fidelity(key, labels[key], series, other, tolerance))
    for key in {**first.unheeded, **second.unheeded}:
        counts = first.unheeded.get(key, 0), second.unheeded.get(key, 0)
        found.append(_not_compared(key, labels[key], *counts))
    return found


def _not_compared(key: Key, label: str, first: int, second: int) -> ObjectFidelity:
    return ObjectFidelity(key, label, first, second, 0, is_compared=False)


def _motion_fidelity(
    key: Key, label: str, series: Series | None, other: Series | None, tolerance: Tolerance
) -> ObjectFidelity:
    if series is None or other is None:
        (times, _), is_first = series or other or ([0], []), series is not None
        counts = (len(times), 0) if is_first else (0, len(times))
        return ObjectFidelity(key, label, *counts, 0, float("inf"), times[0])
    allowed = allowed_of(key, series, other, tolerance)
    agreeing, worst, worst_ns = 0, 0.0, series[0][0]
    for time_ns, distance in apart(series, other, tolerance.time_ns):
        agreeing += distance <= allowed
        if distance > worst:
            worst, worst_ns = distance, time_ns
    return ObjectFidelity(key, label, len(series[0]), len(other[0]), agreeing, worst, worst_ns)
