"""Similarity of two recordings' devices, with figures computed by hand."""

import pytest

from motorhil.traces.semantics.diff import (
    ObjectFidelity,
    Tolerance,
    differences,
    fidelity,
    retimed,
    told_by_nodes,
)
from motorhil.traces.semantics.model import COMMANDS, Item, Meaning

STATE = ("can0", 1, "6041h statusword")
POSITION = ("can0", 1, "6064h position actual value")
MS = 1_000_000


def meaning(items=None, motions=None):
    made = Meaning()
    for key, values in (items or {}).items():
        made.items[key] = [Item(time_ns, (key[2], value), str(value)) for time_ns, value in values]
        made.labels[key] = key[2]
    for key, samples in (motions or {}).items():
        made.motions[key] = ([at for at, _ in samples], [float(value) for _, value in samples])
        made.labels[key] = key[2]
    return made


def states(*values):
    return meaning({STATE: list(enumerate(values))})


@pytest.mark.parametrize(
    ("first", "second", "agreeing", "share"),
    [
        ("abcd", "abcd", 4, 1.0),
        ("abcd", "abd", 3, 0.75),
        ("ab", "abcd", 2, 0.5),  # additional reports count as well
        ("abcd", "", 0, 0.0),
    ],
)
def test_states_agree_in_same_order(first, second, agreeing, share):
    (found,) = fidelity(states(*first), states(*second), Tolerance())
    assert (found.first, found.second, found.agreeing) == (len(first), len(second), agreeing)
    assert (found.share, found.worst) == (share, None)


def test_quantity_samples_within_tolerance_agree():
    """In increments, at least 2 of them are allowed; the worst is reported at its first time."""
    first = meaning(None, {POSITION: [(0, 0), (1000 * MS, 2), (2000 * MS, 9), (3000 * MS, 9)]})
    second = meaning(None, {POSITION: [(0, 0), (3000 * MS, 0)]})
    (found,) = fidelity(first, second, Tolerance())
    assert found == ObjectFidelity(POSITION, POSITION[2], 4, 2, 2, 9.0, 2000 * MS)
    assert found.share == 0.5


def test_quantity_missing_in_other_recording_disagrees():
    first = meaning(None, {POSITION: [(5, 0), (6, 0)]})
    (found,) = fidelity(first, meaning(), Tolerance())
    assert (found.share, found.second, found.worst, found.worst_ns) == (0.0, 0, float("inf"), 5)


def test_measured_quantity_is_not_compared():
    one, other = states(*range(40)), states(*range(100, 140))
    (found,) = fidelity(one, other, Tolerance())
    assert not found.is_compared
    assert differences(one, other, Tolerance()) == []
    assert fidelity(one, states(1), Tolerance()) != []


def test_only_reports_of_nodes_are_kept():
    command, event = ("can0", 1, COMMANDS), ("events", None, "left")
    axis = ("left", None, "position")
    kept = told_by_nodes(
        meaning(
            {STATE: [(0, "a")], command: [(0, "b")], event: [(0, "c")]},
            {POSITION: [(0, 1)], axis: [(0, 1)]},
        )
    )
    assert (list(kept.items), list(kept.motions)) == ([STATE], [POSITION])


@pytest.mark.parametrize(
    ("at", "becomes"),
    [(0, 90), (10, 100), (15, 110), (20, 120), (40, 420), (60, 720), (61, 721), (100, 760)],
)
def test_retimed_interpolates_and_extrapolates(at, becomes):
    """10 becomes 100, 20 becomes 120, 60 becomes 720; the order of pairs does not matter."""
    pairs = [(20, 120), (60, 720), (10, 100)]
    moved = retimed(meaning({STATE: [(at, "a")]}, {POSITION: [(at, 1)]}), pairs)
    assert [item.time_ns for item in moved.items[STATE]] == [becomes]
    assert moved.motions[POSITION] == ([becomes], [1.0])
    assert moved.labels == {STATE: STATE[2], POSITION: POSITION[2]}


def test_difference_equal_to_tolerance_is_none():
    flat = meaning(None, {POSITION: [(0, 0), (1000 * MS, 0)]})
    for value, count in ((2, 0), (2.001, 1)):
        there = meaning(None, {POSITION: [(0, 0), (1000 * MS, value)]})
        assert len(differences(flat, there, Tolerance())) == count
    motor = ("left", None, "position")
    flat = meaning(None, {motor: [(0, 0), (1000 * MS, 0)]})
    for value, count in ((0.01, 0), (0.0101, 1)):
        there = meaning(None, {motor: [(0, 0), (1000 * MS, value)]})
        assert len(differences(flat, there, Tolerance())) == count


def test_quantity_can_be_shifted_within_time_tolerance():
    """At 1 per second, 0.04 ahead is 40 ms early."""
    motor = ("left", None, "position")
    line = meaning(None, {motor: [(0, 0), (1000 * MS, 1)]})
    for ahead, count in ((0.04, 0), (-0.04, 0), (0.065, 1), (-0.065, 1)):
        there = meaning(None, {motor: [(0, 0), (500 * MS, 0.5 + ahead), (1000 * MS, 1)]})
        assert len(differences(line, there, Tolerance())) == count


def test_differences_are_sorted_by_time():
    later = ("can0", 1, "error register")
    one = meaning({STATE: [(5, "a")], later: [(3, "x")]}, {POSITION: [(0, 0), (1, 0)]})
    other = meaning({STATE: [(5, "b")], later: [(3, "y")]}, {POSITION: [(0, 9), (1, 9)]})
    assert [one.time_ns for one in differences(one, other, Tolerance())] == [0, 3, 5]


def test_many_values_of_several_objects_keep_order():
    commands = meaning({("can0", 1, COMMANDS): []})
    others = meaning({("can0", 1, COMMANDS): []})
    for number in range(40):
        for one, value in ((commands, number), (others, -number)):
            item = Item(number, (f"object {number % 2}", value), str(value))
            one.items["can0", 1, COMMANDS].append(item)
    assert len(differences(commands, others, Tolerance())) == 1
