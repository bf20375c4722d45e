"""Periods and jitter from recordings: they cover everything that was recorded."""

from cProfile import Profile

from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.harness.analysis.measured import Heard, measured
from motorhil.motorapi.synchronization.can_response_time import Arrival, Message
from tests.support.recordings.message_sets import MS, US


def _heard(times_ns: list[int]) -> Heard:
    heard = Heard(0x181, False)
    heard.add_kind(5, "left", False, False)
    heard.times_ns.extend(times_ns)
    return heard


def _most_in(message: Message, window_ns: int) -> int:
    """Return how many frames a closed window of this length can hold."""
    early_ns = message.jitter_ns + message.irregular_ns
    count = (window_ns + early_ns) // message.period_ns + 1
    return min(count, window_ns // message.distance_ns + 1) if message.distance_ns else count


def test_strict_period_has_no_jitter():
    found = measured(_heard([7 + 10 * MS * n for n in range(20)]), 200 * MS)
    message = found.message
    assert (message.period_ns, message.jitter_ns, message.irregular_ns) == (10 * MS, 0, 0)
    assert (message.arrival, message.deadline_ns) == (Arrival.PERIODIC, 10 * MS)
    assert (found.frames, found.least_ns, found.irregular) == (20, 10 * MS, 0)
    assert (message.length, message.sender, message.source) == (5, "left", "20 frames")


def test_jitter_is_the_advance_on_the_period():
    times = [10 * MS * n + (300 * US if n % 5 == 0 else 0) for n in range(1, 42)]
    message = measured(_heard(times), 420 * MS).message
    assert message.period_ns == 10 * MS
    assert message.jitter_ns == 300 * US


def test_boot_up_before_heartbeats_is_irregular():
    times = [90 * MS, *(100 * MS * n for n in range(1, 40))]
    found = measured(_heard(times), 4000 * MS)
    assert found.message.period_ns == 100 * MS
    assert (found.message.jitter_ns, found.message.irregular_ns) == (0, 90 * MS)
    assert found.irregular == 1


def test_pause_does_not_change_the_period():
    times = [10 * MS * n for n in range(30)] + [10 * MS * n for n in range(100, 130)]
    message = measured(_heard(times), 1300 * MS).message
    assert (message.period_ns, message.jitter_ns, message.irregular_ns) == (10 * MS, 0, 0)


def test_rows_repeated_with_their_stamps_are_measured_once():
    times = [10 * MS * n + n % 3 * US for n in range(30) for _ in range(100)]
    profile = Profile()
    profile.runcall(measured, _heard(times), 300 * MS)
    calls = sum(one.callcount for one in profile.getstats())
    assert calls < 30 * len(times)


def test_irregular_message_is_sporadic_with_least_distance():
    times = [0, 1 * MS, 50 * MS, 52 * MS, 300 * MS, 301 * MS, 700 * MS, 800 * MS, 1000 * MS]
    found = measured(_heard(times), 1000 * MS)
    assert found.message.arrival is Arrival.SPORADIC
    assert found.message.distance_ns == 1 * MS
    assert found.message.deadline_ns is None
    assert found.message.source == "9 frames"


def test_single_frame_has_recording_span_as_period():
    found = measured(_heard([5 * MS]), 80 * MS)
    assert (found.message.period_ns, found.least_ns) == (80 * MS, None)


@given(st.lists(st.integers(0, 400), min_size=1, max_size=40), st.booleans())
def test_measured_message_covers_all_frames(steps: list[int], regular: bool):
    times, now = [], 0
    for step in steps:
        now += (1000 + step % 50 if regular else step * 10) * US
        times.append(now)
    found = measured(_heard(times), max(1, times[-1] - times[0]))
    event(found.message.arrival.value)
    for first in range(len(times)):
        for last in range(first, len(times)):
            window_ns = times[last] - times[first]
            assert last - first + 1 <= _most_in(found.message, window_ns)
