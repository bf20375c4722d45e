"""Durations of frames sent once, against a simulated bus."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.motorapi.synchronization.bus_load import (
    CanTraffic,
    PeriodicMessage,
)
from motorhil.motorapi.synchronization.can_frame_length import longest
from motorhil.motorapi.synchronization.can_response_time import (
    BusLoad,
    response_times,
)
from motorhil.motorapi.synchronization.firing_time import longest_s, overload_of
from motorhil.motorapi.synchronization.offer import Firing, OneFrame


def test_full_bus_has_no_bound_and_names_the_message():
    traffic = CanTraffic(
        125_000, (PeriodicMessage(1, 8, 0.0012), PeriodicMessage(2, 8, 0.01))
    )  # 1.08 ms in 1.2 ms
    urgent, starving = response_times(BusLoad.of(traffic))
    assert urgent.response_ns is not None
    assert starving.response_ns is None
    assert overload_of(traffic) == "002h and messages of higher priority may fill the bus"
    assert overload_of(CanTraffic(1_000_000, traffic.messages)) == ""


def _firing(can_id: int, traffic: CanTraffic, bus: str = "can0") -> Firing:
    return Firing(bus, traffic, (OneFrame(can_id, 2),))


def test_frames_alone_on_the_bus_take_their_length():
    quiet = CanTraffic(1_000_000)
    assert longest_s([_firing(0x201, quiet)]) == pytest.approx(75e-6, abs=1e-12)
    assert longest_s([_firing(0x201, quiet), _firing(0x202, quiet)]) == pytest.approx(150e-6)
    assert longest_s([]) == 0.0


def test_long_identifier_and_fd_frames_take_their_own_length():
    quiet = CanTraffic(1_000_000, data_bitrate_bit_s=5_000_000)
    extended = OneFrame(0x8001, 8, extended=True)
    assert longest_s([Firing("b", quiet, (extended,))]) == pytest.approx(160e-6)  # Davis et al.
    fd = OneFrame(0x8001, 48, extended=True, fd=True, bit_rate_switch=True)
    expected = longest(48, extended=True, fd=True, switched=True).time_ns(1_000_000, 5_000_000)
    assert longest_s([Firing("b", quiet, (fd,))]) == pytest.approx(expected / 1e9)


def test_identifier_of_29_bits_yields_to_one_of_11_bits():
    busy = CanTraffic(1_000_000, (PeriodicMessage(0x400, 8, 1.0),))
    long = OneFrame(0x100 << 18, 2, extended=True)
    urgent = longest_s([Firing("b", busy, (long,))])
    late = longest_s([Firing("b", busy, (replace(long, can_id=0x401 << 18),))])
    alone = longest_s([Firing("b", CanTraffic(1_000_000), (long,))])
    assert urgent == late == pytest.approx(alone + 135e-6)  # it waits for it in either case


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


def _simulated(
    traffic: CanTraffic, offsets_ns: list[int], frames: list[tuple[int, int]], begin_ns: int
) -> int:
    """Return the duration of `frames`, in turn from `begin_ns` on [ns]; all of worst length."""
    bit_ns = 1_000_000_000 // traffic.bitrate_bit_s
    due = [
        [offset, round(message.period_s * 1e9), message.rank, longest(message.length).nominal]
        for offset, message in zip(offsets_ns, traffic.messages, strict=True)
    ]
    left = [(can_id << 19, longest(length).nominal) for can_id, length in frames]
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
