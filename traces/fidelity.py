"""How far one recording's devices behave like another's, object by object.

Both recordings have the same host: one is of a device, the other of what is to stand for it. States
agree where both tell the same ones in the same order; a measured or demanded quantity agrees at a
sample where it is within the tolerance of `traces.semantic_diff`. Before, the first recording's
times are made the second's, by frames of the host that are in both: a device that answers later is
not different in all that follows.
"""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from difflib import SequenceMatcher
from typing import final

from traces.meaning import COMMANDS, Key, Meaning
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
    """

    key: Key
    label: str
    first: int
    second: int
    agreeing: int
    worst: float | None = None
    worst_ns: int = 0

    @property
    def share(self) -> float:
        """How much of it agrees, 0 to 1; `first` is at least 1."""
        of = self.first if self.worst is not None else max(self.first, self.second)
        return self.agreeing / of


def told_by_nodes(meaning: Meaning) -> Meaning:
    """What devices tell, without what they were told, and without what else is recorded."""
    kept = Meaning()
    kept.messages = meaning.messages
    kept.labels = meaning.labels
    kept.items = {
        key: items
        for key, items in meaning.items.items()
        if key[1] is not None and key[2] != COMMANDS
    }
    kept.motions = {key: series for key, series in meaning.motions.items() if key[1] is not None}
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
    """Of each object that the first recording's devices tell, in the order they first tell it."""
    found: list[ObjectFidelity] = []
    for key, items in first.items.items():
        others = second.items.get(key, [])
        if is_measured(items) and is_measured(others):
            continue
        mine, theirs = [item.what for item in items], [item.what for item in others]
        blocks = SequenceMatcher(None, mine, theirs, autojunk=False).get_matching_blocks()
        agreeing = sum(block.size for block in blocks)
        found.append(ObjectFidelity(key, first.labels[key], len(items), len(others), agreeing))
    for key, series in first.motions.items():
        found.append(_of_motion(key, first.labels[key], series, second.motions.get(key), tolerance))
    return found


def _of_motion(
    key: Key, label: str, series: Series, other: Series | None, tolerance: Tolerance
) -> ObjectFidelity:
    if other is None:
        return ObjectFidelity(key, label, len(series[0]), 0, 0, float("inf"), series[0][0])
    allowed = allowed_of(key, series, other, tolerance)
    agreeing, worst, worst_ns = 0, 0.0, series[0][0]
    for time_ns, distance in apart(series, other, tolerance.time_ns):
        agreeing += distance <= allowed
        if distance > worst:
            worst, worst_ns = distance, time_ns
    return ObjectFidelity(key, label, len(series[0]), len(other[0]), agreeing, worst, worst_ns)
