from itertools import pairwise

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.media.load import BusyTime

# Gap before and length of each busy period; gaps of 0 join periods.
PERIODS = st.lists(st.tuples(st.integers(0, 5), st.integers(1, 6)), max_size=12)


def _fill(periods: list[tuple[int, int]], entries_max: int = 1000) -> tuple[BusyTime, list[bool]]:
    """Return the same data twice: as periods, and as one flag per nanosecond."""
    busy = BusyTime(entries_max)
    flags: list[bool] = []
    for gap, length in periods:
        flags += [False] * gap
        busy.add(len(flags), len(flags) + length)
        flags += [True] * length
    return busy, flags + [False] * 30


@given(PERIODS, st.integers(0, 40), st.integers(1, 40))
def test_load_of_window_is_its_busy_part(periods, from_ns, length_ns):
    busy, flags = _fill(periods)
    expected = sum(flags[from_ns : from_ns + length_ns]) / length_ns
    assert busy.load(from_ns, from_ns + length_ns) == expected


@given(PERIODS, st.integers(1, 30))
def test_peak_is_load_of_fullest_window(periods, window_ns):
    busy, flags = _fill(periods)
    padded = [False] * window_ns + flags  # a window may begin before time 0
    sums = [sum(padded[at : at + window_ns]) for at in range(len(padded))]
    assert busy.peak_load(window_ns) == max(sums) / window_ns


@given(PERIODS)
def test_busy_time_is_sum_of_periods(periods):
    busy, flags = _fill(periods)
    assert busy.busy_ns() == sum(flags) == busy.busy_ns(until_ns=len(flags))


def test_new_medium_was_never_busy():
    busy = BusyTime()
    assert busy.load(0, 1) == 0.0
    assert busy.peak_load(1) == 0.0
    assert busy.busy_ns() == 0


def test_long_run_takes_one_megabyte():
    busy = BusyTime()
    for start_ns in range(0, 3_000_000, 10):  # more frames than were ever kept
        busy.add(start_ns, start_ns + 5)
    assert 16 * len(busy._ends_ns) <= 1 << 20
    assert busy.busy_ns() == 1_500_000


def test_adjacent_periods_take_no_memory():
    busy = BusyTime()
    for start_ns in range(0, 1000, 10):
        busy.add(start_ns, start_ns + 10)
    assert len(busy._ends_ns) <= 1
    assert busy.load(0, 1000) == 1.0


@pytest.mark.parametrize("until_ns", [9, 10])
def test_empty_window_has_no_load(until_ns):
    with pytest.raises(ValueError, match="empty"):
        BusyTime().load(10, until_ns)


def test_empty_window_has_no_peak():
    with pytest.raises(ValueError, match="0 ns is empty"):
        BusyTime().peak_load(0)


@given(
    st.lists(st.tuples(st.integers(1, 5), st.integers(1, 6)), min_size=20, max_size=80),
    st.integers(1, 60),
)
def test_bounded_memory_keeps_the_totals_and_bounds_the_error(periods, window_ns):
    busy, flags = _fill(periods, 8)
    ends_ns = list(busy._ends_ns)
    assert len(ends_ns) <= 8
    event(f"entries for several periods: {busy._spread}")
    assert busy.busy_ns() == sum(flags)
    for end_ns in ends_ns:  # exact between entries
        assert busy.busy_ns(end_ns) == sum(flags[:end_ns])
    for at in range(ends_ns[busy._spread - 1] if busy._spread else 0, len(flags)):
        assert busy.busy_ns(at) == sum(flags[:at])  # and wherever the periods are kept
    counts = [busy.busy_ns(at) for at in range(len(flags))]
    assert all(0 <= later - earlier <= 1 for earlier, later in pairwise(counts))
    padded = [False] * window_ns + flags
    exact_ns = max(sum(padded[at : at + window_ns]) for at in range(len(padded)))
    sums_ns = [0, *(sum(flags[:end_ns]) for end_ns in ends_ns)]
    most_ns = max(later - earlier for earlier, later in pairwise(sums_ns))
    assert abs(round(busy.peak_load(window_ns) * window_ns) - exact_ns) <= 2 * most_ns
