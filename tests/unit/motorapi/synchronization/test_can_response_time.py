"""Worst-case response times against published figures."""

from dataclasses import replace

import pytest

from motorhil.motorapi.synchronization.bus_load import (
    CanTraffic,
    PeriodicMessage,
)
from motorhil.motorapi.synchronization.can_response_time import (
    Arrival,
    BusLoad,
    Effort,
    ErrorModel,
    Message,
    are_in_time,
    response_between,
    response_times,
)
from tests.support.recordings.message_sets import MS, SAE, SAE_RATES, US, davis, sae


def test_davis_counter_example_misses_in_second_instance():
    a, b, c = response_times(davis())
    assert [one.response_ns for one in (a, b, c)] == [2.0 * MS, 3.0 * MS, 3.5 * MS]
    assert [one.is_in_time for one in (a, b, c)] == [True, True, False]
    assert (c.instance, c.busy_ns, c.blocking_ns) == (1, 7 * MS, 0)
    assert not are_in_time(davis())


def test_counter_example_of_davis_et_al_is_found():
    """Check their table: C misses its deadline of 3.25 ms in its second instance only."""
    messages = tuple(
        PeriodicMessage(can_id, 7, period_s)
        for can_id, period_s in ((1, 0.0025), (2, 0.0035), (3, 0.0035))
    )
    a, b, c = response_times(BusLoad.of(CanTraffic(125_000, messages)))
    assert (a.response_ns, b.response_ns, c.response_ns) == (2_000_000, 3_000_000, 3_500_000)
    assert c.instance == 1
    assert c.busy_ns == 7_000_000
    assert (a.instance, b.instance) == (0, 0)


@pytest.mark.parametrize("column", range(4))
def test_sae_benchmark_equals_published_figures(column: int):
    load = sae(SAE_RATES[column])
    found = [one.received_ns for one in response_times(load)]
    assert found == [row[2 + column] * US for row in SAE]
    used = (0.85744, 0.42872, 0.21436, 0.10718)[column]
    assert load.utilisation() == pytest.approx(used, abs=1e-9)  # a sum of floats


def test_error_costs_error_frame_and_longest_repetition():
    load = BusLoad(
        "can0", 1_000_000, (Message(1, 0, 10 * MS), Message(2, 8, 10 * MS), Message(3, 8, 10 * MS))
    )
    none, one, two = (
        [each.response_ns for each in response_times(load, ErrorModel(burst))]
        for burst in (0, 1, 2)
    )
    assert none == [190 * US, 325 * US, 325 * US]  # 135 + 55; 55 + 2 * 135
    assert one == [(190 + 31 + 55) * US, (325 + 31 + 135) * US, (325 + 31 + 135) * US]
    assert two == [(190 + 2 * 86) * US, (325 + 2 * 166) * US, (325 + 2 * 166) * US]


def test_repetition_of_more_urgent_frame_is_counted():
    load = BusLoad("can0", 1_000_000, (Message(1, 8, 10 * MS), Message(2, 0, 10 * MS)))
    found = response_times(load, ErrorModel(1))[1]
    assert found.response_ns == (135 + 55 + 31 + 135) * US


def test_repeated_errors_count_in_the_extended_window():
    load = BusLoad("can0", 1_000_000, (Message(1, 8, 10 * MS),))
    # 135 us, and 166 us for each error. One error occurs at once, then one every 200 us. There are
    # two in 135 + 166 us, three in 135 + 332 us, four in 135 + 498 us, and four in 135 + 664 us.
    found = response_times(load, ErrorModel(1, 200 * US))
    assert found[0].response_ns == (135 + 4 * 166) * US
    assert response_times(load, ErrorModel(1, 166 * US))[0].response_ns is None


def _queued(*ids: int, fifo: bool) -> BusLoad:
    messages = tuple(
        Message(one, 8, 10 * MS, deadline_ns=10 * MS, sender="node" if one < 0x300 else "other")
        for one in ids
    )
    return BusLoad("can0", 1_000_000, messages, fifo=frozenset({"node"} if fifo else ()))


def test_fifo_queue_delays_urgent_message():
    by_priority = response_times(_queued(0x100, 0x2FF, 0x300, fifo=False))
    one_queue = response_times(_queued(0x100, 0x2FF, 0x300, fifo=True))
    assert [one.response_ns for one in by_priority] == [270 * US, 405 * US, 405 * US]
    assert [one.response_ns for one in one_queue] == [405 * US, 405 * US, 405 * US]


def test_fifo_queue_is_delayed_by_message_between():
    between = replace(
        _queued(0x100, 0x2FF, fifo=True),
        messages=(
            *_queued(0x100, 0x2FF, fifo=True).messages,
            Message(0x200, 8, 10 * MS, sender="urgent"),
        ),
    )
    found = {one.message.identifier: one.response_ns for one in response_times(between)}
    assert found == {0x100: 405 * US, 0x200: 405 * US, 0x2FF: 405 * US}


def test_sporadic_message_is_timed_from_queueing():
    burst = Message(1, 0, 10 * MS, 20 * MS, distance_ns=1 * MS, arrival=Arrival.SPORADIC)
    one, other = response_times(BusLoad("can0", 1_000_000, (burst, Message(2, 0, 10 * MS))))
    assert one.response_ns == 110 * US  # never two at once: their minimum distance is 1 ms
    assert other.response_ns == 110 * US
    together = replace(burst, distance_ns=0)
    one, other = response_times(BusLoad("can0", 1_000_000, (together, Message(2, 0, 10 * MS))))
    assert one.response_ns == (55 + 3 * 55) * US  # three at once
    assert other.response_ns == (3 * 55 + 55) * US


def test_starving_message_has_no_bound_and_is_late():
    load = BusLoad(
        "can0",
        125_000,
        (Message(1, 8, 1_200 * US), Message(2, 8, 10 * MS, deadline_ns=10 * MS)),
    )
    urgent, starving = response_times(load)
    assert urgent.response_ns is not None
    assert (starving.response_ns, starving.is_in_time) == (None, False)


def test_response_between_equals_response_times():
    load = sae(125_000)
    for place, found in enumerate(response_times(load)):
        higher, lower = load.messages[:place], load.messages[place + 1 :]
        again = response_between(load, reversed(higher), load.messages[place], lower)
        assert again.response_ns == found.response_ns


def test_jitter_permits_several_frames_at_once():
    one = PeriodicMessage(1, 8, 0.001)
    plain = CanTraffic(1_000_000, (one, PeriodicMessage(2, 8, 0.1)))
    shaken = CanTraffic(1_000_000, (replace(one, jitter_s=0.002), PeriodicMessage(2, 8, 0.1)))
    assert response_times(BusLoad.of(plain))[1].response_ns == 270_000
    assert response_times(BusLoad.of(shaken))[1].response_ns == 540_000


def test_jitters_that_nobody_has_are_not_computed_for_ever():
    """As from the time stamps of a damaged recording: it took more than any test may."""
    hour_ns = 3_600_000_000_000
    load = BusLoad(
        "can0",
        500_000,
        (
            Message(0x100, 8, 1_000_000, jitter_ns=1000 * hour_ns),
            Message(0x101, 8, 200_000_003, irregular_ns=900 * hour_ns),
            Message(0x102, 8, 2_000_000, jitter_ns=7 * hour_ns, sender="a"),
            Message(0x103, 8, 3_000_001, jitter_ns=5 * hour_ns, sender="a"),
        ),
        fifo=frozenset({"a"}),
    )
    assert [one.response_ns for one in response_times(load)][2:] == [None] * 2


def test_queues_late_beyond_deadlines_end_the_analysis():
    """Errors every 166 us leave so little of the bus that queues settle after a second only."""
    mine = [
        Message(0x180 + n, 6, 1_998_000, deadline_ns=20 * MS, sender=f"{n}", arrival=arrival)
        for n, arrival in ((1, Arrival.SPORADIC), (2, Arrival.SPORADIC))
    ]
    beats = [Message(0x700 + n, 1, 99_900_000, sender=f"{n}") for n in (1, 2)]
    load = BusLoad("can0", 1_000_000, (*mine, *beats), fifo=frozenset(("1", "2")))
    effort = Effort()
    begun = effort.left
    assert not are_in_time(load, ErrorModel(1, 166_000), effort)
    assert begun - effort.left < 200_000


def test_frame_waits_behind_very_many_that_are_late_together():
    """Davis et al. 2007, (5): the least w with w = C ceil((w + J + a bit) / T), and its own C."""
    takes_ns, period_ns, late_ns = 135 * US, 140 * US, 400 * MS
    late, last = Message(0x10, 8, period_ns, jitter_ns=late_ns), Message(0x20, 0, 1000 * MS)
    waits_ns, again_ns = -1, 0
    while again_ns > waits_ns:
        waits_ns = again_ns
        again_ns = takes_ns * -(-(waits_ns + late_ns + US) // period_ns)
    load = BusLoad("late", 1_000_000, (late, last))
    (found,) = response_times(load, asked=(last.rank,))
    assert found.response_ns == waits_ns + 55 * US
