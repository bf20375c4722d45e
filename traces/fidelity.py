"""How far one recording's devices behave like another's, object by object.

Both recordings have the same host: one is of a device, the other of what is to stand for it. States
agree where both tell the same ones in the same order; a measured or demanded quantity agrees at a
sample where it is within the tolerance of `traces.semantic_diff`. Before, the first recording's
times are made the second's, by frames of the host that are in both: a device that answers later is
not different in all that follows. Measured quantities that differ from run to run (velocities,
currents, what takes on many values in no order that is due) are not compared, which is told.
"""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from difflib import SequenceMatcher
from typing import final

from traces.meaning import COMMANDS, Key, Meaning
from traces.said import CONTROLLER, FOREIGN
from traces.semantic_diff import Series, Tolerance, allowed_of, apart, is_measured


@final
@dataclass(frozen=True, slots=True)
class ObjectFidelity:
    """One object of one node.

    Attributes:
        key: bus, node, object.
        label: the same in words.
        first, second: how often it is told in each recording; states when they change.
        agreeing: how many of them agree.
        worst: the largest distance of a quantity, in its own unit; None: it is a state.
        worst_ns: when that is.
        is_compared: whether anything is said of it; else it is only there.
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
        """How many could agree: of a quantity the first recording's samples, where it has any."""
        if not self.is_compared:
            return 0
        is_there = self.worst is not None and self.first
        return self.first if is_there else max(self.first, self.second)

    @property
    def share(self) -> float:
        """How much of it agrees, 0 to 1."""
        return self.agreeing / self.of if self.of else 1.0


def told_by_nodes(meaning: Meaning) -> Meaning:
    """What devices tell, without what they were told, and without what else is recorded.

    Error messages are not told by devices, but by the bus they happen to be on.

    Frames that are of no protocol here are nobody's by their identifier, and a device's too: what
    the host sends of them is in both recordings.
    """
    kept = Meaning()
    kept.messages = meaning.messages
    kept.labels = meaning.labels
    kept.items = {
        key: items
        for key, items in meaning.items.items()
        if key[2] != COMMANDS
        and not key[2].startswith(CONTROLLER)
        and (key[1] is not None or key[2].startswith(FOREIGN))
    }
    kept.motions = {key: series for key, series in meaning.motions.items() if key[1] is not None}
    kept.unheeded = {key: count for key, count in meaning.unheeded.items() if count}
    return kept


def retimed(meaning: Meaning, pairs: Sequence[tuple[int, int]]) -> Meaning:
    """The same at other times.

    Args:
        meaning: what a recording means.
        pairs: (a time of it, the time it is to become) [ns], at least one; between two of them in
            proportion, before and behind them all at the same distance.
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
    """Of each object that devices tell, those of the first recording in the order it tells them."""
    found: list[ObjectFidelity] = []
    labels = {**second.labels, **first.labels}
    for key in {**first.items, **second.items}:
        items, others = first.items.get(key, []), second.items.get(key, [])
        if is_measured(items) and is_measured(others):
            found.append(_not_compared(key, labels[key], len(items), len(others)))
            continue
        mine, theirs = [item.what for item in items], [item.what for item in others]
        blocks = SequenceMatcher(None, mine, theirs, autojunk=False).get_matching_blocks()
        agreeing = sum(block.size for block in blocks)
        found.append(ObjectFidelity(key, labels[key], len(items), len(others), agreeing))
    for key in {**first.motions, **second.motions}:
        series, other = first.motions.get(key), second.motions.get(key)
        found.append(_of_motion(key, labels[key], series, other, tolerance))
    for key in {**first.unheeded, **second.unheeded}:
        counts = first.unheeded.get(key, 0), second.unheeded.get(key, 0)
        found.append(_not_compared(key, labels[key], *counts))
    return found


def _not_compared(key: Key, label: str, first: int, second: int) -> ObjectFidelity:
    return ObjectFidelity(key, label, first, second, 0, is_compared=False)


def _of_motion(
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
