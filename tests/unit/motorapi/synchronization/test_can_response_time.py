"""Worst-case times on a CAN bus, against published figures and a simulation."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.synchronization.bus_load import (
    CanTraffic,
    NodeTraffic,
    PeriodicMessage,
    worst_of,
)
from motorhil.motorapi.synchronization.can_response_time import (
    Firing,
    OneFrame,
    least_frame_bits,
    longest_s,
    overload_of,
    response_times,
    worst_frame_bits,
    worst_frame_ns,
)
from tests.support.can.published import SAE

# Frame bits with intermission, minimum and maximum: can-utils canframelen.c and Linux
# include/linux/can/length.h, which follow Davis et al. 2007, by data bytes 0 to 8.
LENGTHS = {
    False: (
        (47, 55, 63, 71, 79, 87, 95, 103, 111),
        (55, 65, 75, 85, 95, 105, 115, 125, 135),
    ),
    True: (
        (67, 75, 83, 91, 99, 107, 115, 123, 131),
        (80, 90, 100, 110, 120, 130, 140, 150, 160),
    ),
}


@pytest.mark.parametrize("extended", [False, True])
def test_frame_lengths_equal_those_of_kernel_and_can_utils(extended: bool):
    least, worst = LENGTHS[extended]
    for length in range(9):
        assert worst_frame_bits(length, extended=extended) == worst[length]
        assert least_frame_bits(length, extended=extended) + 3 == least[length]


def test_counter_example_of_davis_et_al_is_found():
    """Check their table: C misses its deadline of 3.25 ms in its second instance only."""
    messages = tuple(
        PeriodicMessage(can_id, 7, period_s)
        for can_id, period_s in ((1, 0.0025), (2, 0.0035), (3, 0.0035))
    )
    a, b, c = response_times(CanTraffic(125_000, messages))
    assert (a.response_s, b.response_s, c.response_s) == (0.002, 0.003, 0.0035)
    assert c.instance == 1
    assert c.busy_s == 0.007
    assert (a.instance, b.instance) == (0, 0)


@pytest.mark.parametrize("column", range(4))
def test_sae_benchmark_is_exact_to_the_microsecond(column: int):
    rate = (125_000, 250_000, 500_000, 1_000_000)[column]
    messages = tuple(
        PeriodicMessage(place + 1, row[1], row[0] / 1e3) for place, row in enumerate(SAE)
    )
    found = response_times(CanTraffic(rate, messages))
    received_us = [round((one.received_s or 0.0) * 1e6) for one in found]
    assert received_us == [row[2 + column] for row in SAE]


@pytest.mark.parametrize(
    ("length", "bits"),
    [(0, (67, 91)), (8, (147, 171)), (16, (227, 251)), (20, (272, 296)), (64, (712, 736))],
)
def test_can_fd_frame_lengths_equal_those_of_the_kernel(length: int, bits: tuple[int, int]):
    """Check the longest frames. Source: Linux include/linux/can/length.h (can-physics, 6.3)."""
    slow, fast = (CanTraffic(1_000_000, data_bitrate_bit_s=rate) for rate in (1_000_000, 5_000_000))
    for extended, worst, nominal in zip((False, True), bits, (33, 57), strict=True):
        plain = PeriodicMessage(1, length, 1.0, extended=extended, fd=True)
        switched = replace(plain, bit_rate_switch=True)
        for one in (plain, switched):
            assert worst_frame_ns(one, slow) == worst * 1000
        assert worst_frame_ns(plain, fast) == worst * 1000
        assert worst_frame_ns(switched, fast) == nominal * 1000 + (worst - nominal) * 200


def test_can_fd_frame_without_switch_is_the_worst():
    classical = PeriodicMessage(1, 8, 0.01)
    switched = PeriodicMessage(1, 8, 0.02, fd=True, bit_rate_switch=True)
    assert worst_of([classical, switched]) == (PeriodicMessage(1, 8, 0.01, fd=True),)


def test_equal_base_identifiers_let_the_11_bit_one_win():
    short = PeriodicMessage(0x123, 0, 1.0)
    long = PeriodicMessage(0x123 << 18, 0, 1.0, extended=True)
    before = PeriodicMessage(0x122 << 18 | 0x3FFFF, 0, 1.0, extended=True)
    assert before.rank < short.rank < long.rank < PeriodicMessage(0x124, 0, 1.0).rank


def test_full_bus_has_no_bound_and_names_the_message():
    traffic = CanTraffic(
        125_000, (PeriodicMessage(1, 8, 0.0012), PeriodicMessage(2, 8, 0.01))
    )  # 1.08 ms in 1.2 ms
    urgent, starving = response_times(traffic)
    assert urgent.response_s is not None
    assert starving.response_s is None
    assert overload_of(traffic) == "002h and messages of higher priority may fill the bus"
    assert overload_of(CanTraffic(1_000_000, traffic.messages)) == ""


def test_jitter_permits_several_frames_at_once():
    one = PeriodicMessage(1, 8, 0.001)
    plain = CanTraffic(1_000_000, (one, PeriodicMessage(2, 8, 0.1)))
    shaken = CanTraffic(1_000_000, (replace(one, jitter_s=0.002), PeriodicMessage(2, 8, 0.1)))
    assert response_times(plain)[1].response_s == pytest.approx(270e-6, abs=1e-12)  # ns, as float
    assert response_times(shaken)[1].response_s == pytest.approx(540e-6, abs=1e-12)


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (lambda: PeriodicMessage(0x800, 8, 1.0), "can_id = 2048: must be 0 to 7FFh"),
        (lambda: PeriodicMessage(True, 8, 1.0), "can_id = True"),
        (lambda: PeriodicMessage(1, 9, 1.0), "length = 9: a frame has 0 to 8 data bytes"),
        (
            lambda: PeriodicMessage(1, 9, 1.0, fd=True),
            "length = 9: a CAN FD frame has 0 to 8, 12, 16, 20, 24, 32, 48, 64",
        ),
        (
            lambda: PeriodicMessage(1, 8, 1.0, bit_rate_switch=True),
            "bit_rate_switch = True: requires a CAN FD frame",
        ),
        (
            lambda: CanTraffic(500_000, data_bitrate_bit_s=250_000),
            "data_bitrate_bit_s = 250000: must be 500000 to 20000000 bit/s",
        ),
        (lambda: PeriodicMessage(1, 8, 0.0), "period_s = 0.0: must be 1e-6 to 1e6 s"),
        (lambda: PeriodicMessage(1, 8, float("nan")), "period_s = nan"),
        (lambda: PeriodicMessage(1, 8, 1.0, -1.0), "jitter_s = -1.0: must be 0 to 1e6 s"),
        (lambda: CanTraffic(0), "bitrate_bit_s = 0"),
        (
            lambda: CanTraffic(1000, (PeriodicMessage(1, 8, 1.0), PeriodicMessage(1, 0, 2.0))),
            "001h is declared twice",
        ),
    ],
)
def test_invalid_messages_raise(message, said: str):
    with pytest.raises(UsageError, match=said):
        message()


def test_message_declared_twice_counts_as_the_worse_one():
    own = NodeTraffic(sent=(PeriodicMessage(0x181, 6, 0.002),))
    declared = CanTraffic(1_000_000, (PeriodicMessage(0x181, 8, 0.01, 0.001),))
    assert declared.with_own([own], None).messages == (PeriodicMessage(0x181, 8, 0.002, 0.001),)


# --- frames that are sent once -------------------------------------------------------------------


def _firing(can_id: int, traffic: CanTraffic, bus: str = "can0") -> Firing:
    return Firing(bus, traffic, (OneFrame(can_id, 2),))


def test_frames_alone_on_the_bus_take_their_length():
    quiet = CanTraffic(1_000_000)
    assert longest_s([_firing(0x201, quiet)]) == pytest.approx(75e-6, abs=1e-12)
    assert longest_s([_firing(0x201, quiet), _firing(0x202, quiet)]) == pytest.approx(150e-6)
    assert longest_s([]) == 0.0


def test_each_frame_waits_for_one_of_lower_priority():
    busy = CanTraffic(1_000_000, (PeriodicMessage(0x400, 8, 1.0),))
    assert longest_s([_firing(0x201, busy)]) == pytest.approx((75 + 135) * 1e-6)
    assert longest_s([_firing(0x201, busy)] * 3) == pytest.approx(3 * (75 + 135) * 1e-6)


def test_heartbeat_in_the_queue_lets_lower_priority_pass():
    """Queue the frame behind a heartbeat, which waits for all messages of higher priority."""
    others = (PeriodicMessage(0x400, 8, 1.0), PeriodicMessage(0x401, 8, 1.0))
    heartbeat = PeriodicMessage(0x77F, 1, 1.0)
    plain = CanTraffic(1_000_000, (*others, heartbeat))
    queued = replace(plain, queued=frozenset((heartbeat.rank,)))
    assert longest_s([_firing(0x201, plain)]) == pytest.approx((75 + 135) * 1e-6)
    # One heartbeat may be ahead; of each other message one may have waited, and one more come.
    expected = 75 + 135 + 65 + 2 * 2 * 135
    assert longest_s([_firing(0x201, queued)]) == pytest.approx(expected * 1e-6)
    # Before the second frame one more heartbeat may have come.
    expected += 75 + 135 + 65
    assert longest_s([_firing(0x201, queued)] * 2) == pytest.approx(expected * 1e-6)


def test_bus_full_of_higher_priority_has_no_bound():
    full = CanTraffic(1_000_000, (PeriodicMessage(1, 8, 0.000135),))
    assert longest_s([_firing(0x201, full)]) is None


def test_half_full_buses_in_turn_have_a_bound():
    """Use two buses that together need more than all of the time."""
    half = CanTraffic(1_000_000, (PeriodicMessage(1, 8, 0.000_2),))
    one, other = _firing(0x201, half, "a"), _firing(0x201, half, "b")
    alone_s = longest_s([one])
    assert alone_s is not None
    assert longest_s([one, other]) == pytest.approx(2 * alone_s, abs=1e-12)


def test_idle_time_counts_fully_and_admits_more_frames():
    busy = CanTraffic(1_000_000, (PeriodicMessage(1, 8, 0.001),))
    waiting = replace(_firing(0x201, busy), idle_s=0.01)
    found = longest_s([waiting])
    assert found is not None
    assert found == pytest.approx(0.01 + 75e-6 + 12 * 135e-6)


# --- against a bus that is simulated here, frame by frame ----------------------------------------


def _simulated(
    traffic: CanTraffic, offsets_ns: list[int], frames: list[tuple[int, int]], begin_ns: int
) -> int:
    """Return the duration of `frames`, in turn from `begin_ns` on [ns]; all of worst length."""
    bit_ns = 1_000_000_000 // traffic.bitrate_bit_s
    due = [
        [offset, round(message.period_s * 1e9), message.rank, worst_frame_bits(message.length)]
        for offset, message in zip(offsets_ns, traffic.messages, strict=True)
    ]
    left = [(can_id << 19, worst_frame_bits(length)) for can_id, length in frames]
    queued_ns, now_ns = begin_ns, 0
    while left:
        ready = [(one[2], place) for place, one in enumerate(due) if one[0] <= now_ns]
        if queued_ns <= now_ns:
            ready.append((left[0][0], -1))
        if not ready:
            now_ns = min(queued_ns, *(one[0] for one in due)) if due else queued_ns
            continue
        _, place = min(ready)
        if place < 0:
            now_ns += left.pop(0)[1] * bit_ns
            queued_ns = now_ns + 1  # all waiting frames have won the bus by then
        else:
            now_ns += due[place][3] * bit_ns
            due[place][0] += due[place][1]
    return now_ns - begin_ns


MESSAGES = st.lists(
    st.tuples(
        st.integers(1, 0x57F), st.integers(0, 8), st.sampled_from((1, 2, 5, 10)), st.integers(0)
    ),
    unique_by=lambda one: one[0],
    max_size=6,
)


@given(
    MESSAGES,
    st.lists(st.tuples(st.integers(0x201, 0x27F), st.integers(0, 8)), min_size=1, max_size=6),
    st.integers(0, 20_000_000),
)
def test_frames_sent_once_never_exceed_the_prediction(messages, frames, begin_ns):
    traffic = CanTraffic(
        500_000,
        tuple(
            PeriodicMessage(can_id, length, period_ms / 1e3)
            for can_id, length, period_ms, _ in messages
            if can_id not in [one for one, _ in frames]
        ),
    )
    offsets_ns = [
        offset % (period_ms * 1_000_000)
        for can_id, _, period_ms, offset in messages
        if can_id not in [one for one, _ in frames]
    ]
    if overload_of(traffic):
        return
    firings = [Firing("b", traffic, (OneFrame(can_id, length),)) for can_id, length in frames]
    bound_s = longest_s(firings)
    assert bound_s is not None
    took_ns = _simulated(traffic, offsets_ns, frames, begin_ns)
    assert took_ns <= bound_s * 1e9 + len(frames)  # the nanosecond of delay of each queued frame
