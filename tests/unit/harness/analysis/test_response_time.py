"""Worst-case response times against published figures and motorapi's implementation."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.harness.analysis.message import (
    FD_LENGTHS,
    Arrival,
    BusLoad,
    Message,
    longest,
    shortest,
)
from motorhil.harness.analysis.response_time import (
    ErrorModel,
    are_in_time,
    more_errors_probability,
    response_between,
    response_times,
)
from motorhil.motorapi.synchronization import can_response_time as bus_timing
from motorhil.motorapi.synchronization.bus_load import CanTraffic, PeriodicMessage
from tests.support.can.published import FD_BITS, MS, SAE, SAE_RATES, US
from tests.support.recordings.message_sets import davis, sae


def test_davis_counter_example_misses_in_second_instance():
    a, b, c = response_times(davis())
    assert [one.response_ns for one in (a, b, c)] == [2.0 * MS, 3.0 * MS, 3.5 * MS]
    assert [one.is_in_time for one in (a, b, c)] == [True, True, False]
    assert (c.instance, c.busy_ns, c.blocking_ns) == (1, 7 * MS, 0)
    assert not are_in_time(davis())


@pytest.mark.parametrize("column", range(4))
def test_sae_benchmark_equals_published_figures(column: int):
    load = sae(SAE_RATES[column])
    found = [one.received_ns for one in response_times(load)]
    assert found == [row[2 + column] * US for row in SAE]
    used = (0.85744, 0.42872, 0.21436, 0.10718)[column]
    assert load.utilisation() == pytest.approx(used, abs=1e-9)  # a sum of floats


@pytest.mark.parametrize("length", FD_LENGTHS)
def test_fd_frame_lengths_equal_the_kernels(length: int):
    for extended in (False, True):
        bounds = [make(length, extended=extended, fd=True).nominal for make in (shortest, longest)]
        if length in FD_BITS:
            assert bounds == list(FD_BITS[length][2 * extended : 2 * extended + 2])
        for make, bound in zip((shortest, longest), bounds, strict=True):
            split = make(length, extended=extended, fd=True, switched=True)
            assert split.nominal + split.data == bound
            assert split.time_ns(1_000_000, 1_000_000) == bound * 1000
            assert split.nominal in ((49, 57) if extended else (30, 33))


TIMES = (
    st.integers(500, 50_000).map(lambda us: us / 1e6),
    st.integers(0, 5_000).map(lambda us: us / 1e6),
)
IDENTIFIERS = st.integers(0, 0x7FF)
MESSAGES = st.lists(
    st.builds(PeriodicMessage, IDENTIFIERS, st.integers(0, 8), *TIMES, st.booleans())
    | st.builds(
        PeriodicMessage,
        IDENTIFIERS,
        st.sampled_from(FD_LENGTHS),
        *TIMES,
        st.booleans(),
        st.just(True),
        st.booleans(),
    ),
    min_size=1,
    max_size=8,
    unique_by=lambda one: one.rank,
)


@given(
    MESSAGES,
    st.sampled_from([1_000_000, 500_000, 125_000]),
    st.sampled_from([None, 2_000_000, 5_000_000]),
)
def test_response_times_equal_those_of_motorapi(
    messages: list[PeriodicMessage], rate: int, data_rate: int | None
):
    traffic = CanTraffic(rate, tuple(messages), data_bitrate_bit_s=data_rate)
    theirs = bus_timing.response_times(traffic)
    ours = response_times(
        BusLoad(
            "can0",
            rate,
            tuple(
                Message(
                    one.can_id,
                    one.length,
                    round(one.period_s * 1e9),
                    round(one.jitter_s * 1e9),
                    extended=one.extended,
                    fd=one.fd,
                    switched=one.bit_rate_switch,
                )
                for one in messages
            ),
            data_rate,
        )
    )
    for mine, other in zip(ours, theirs, strict=True):
        assert mine.message.rank == other.message.rank
        if other.response_s is None:  # that one examines 1000 instances at most
            assert mine.response_ns is None or mine.busy_ns > 500_000 * 1000
        else:
            assert mine.response_ns == round(other.response_s * 1e9)


# --- errors: Tindell's bound by hand


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


def test_more_errors_probability_equals_poisson_tail():
    # 1000 bits at 1e-3: a Poisson number of mean 1.0005. Its tail by the series, to three digits.
    assert more_errors_probability(0, 1000, 1e-3) == pytest.approx(0.6323, abs=1e-3)  # 1 - 0.999^n
    assert more_errors_probability(0, 1000, 1e-3) == pytest.approx(1 - 0.999**1000, rel=1e-9)
    assert more_errors_probability(2, 1000, 1e-3) == pytest.approx(0.0805, abs=1e-3)
    assert more_errors_probability(3, 100, 1e-6) == pytest.approx(1e-16 / 24, rel=1e-3)
    assert more_errors_probability(5, 100, 0.0) == 0.0


# --- cost of a queue


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
