"""Bounds of a group, one component at a time."""

import pytest

from motorhil.motorapi.synchronization.bus_load import CanTraffic, PeriodicMessage
from motorhil.motorapi.synchronization.offer import Firing, OneFrame, SyncOffer
from motorhil.motorapi.synchronization.quality import SyncLevel
from motorhil.motorapi.synchronization.skew import (
    Bound,
    Member,
    command_bound,
    end_bound,
    start_bound,
)

QUIET = CanTraffic(1_000_000)
FRAME_S = 75e-6  # two data bytes, maximum number of stuff bits
SYNC = OneFrame(0x080, 0)
SYNC_S = 55e-6


def offer(group: str, **rest) -> SyncOffer:
    values = {
        "latency_s": (0.0, 0.001),
        "firing": Firing("can0", QUIET, (OneFrame(0x201, 2),), 0.0, 1),
        "oscillator_ppm": 0.0,
        "end_s": (0.0, 0.001),
        **rest,
    }
    return SyncOffer(level=SyncLevel.TRIGGERED, group=group, reason="", **values)


def members(*offers: SyncOffer, durations=()) -> list[Member]:
    lasting = [*durations, *[None] * (len(offers) - len(durations))]
    return [Member(f"m{n}", one, lasting[n]) for n, one in enumerate(offers)]


def test_single_motor_has_zero_skew():
    group = members(offer("a", firing=None, latency_s=None))
    assert command_bound(group) == Bound(0.0)
    assert start_bound(group, Bound(0.0)) == Bound(0.0)
    assert end_bound(group, Bound(0.0)) == Bound(0.0)


def test_single_trigger_needs_no_bound_on_its_duration():
    group = members(offer("a", firing=None), offer("a", firing=None))
    assert command_bound(group) == Bound(0.0)


def test_later_triggers_determine_the_command_skew():
    group = members(offer("a"), offer("b"), offer("c"))
    assert command_bound(group).value_s == pytest.approx(2 * FRAME_S, abs=1e-12)


def test_frames_of_the_first_trigger_after_its_latch_count():
    slow = Firing("can0", QUIET, (OneFrame(0x601, 2), OneFrame(0x201, 2)), 0.01, 1)
    found = command_bound(members(offer("a", firing=slow), offer("b")))
    assert found.value_s == pytest.approx(0.01 + 2 * FRAME_S, abs=1e-12)


def test_trigger_without_a_bound_is_named_with_its_reason():
    group = members(offer("a"), offer("b", firing=None, no_firing_bound="nobody knows"))
    assert command_bound(group) == Bound(None, "m1: nobody knows")
    group = members(offer("a"), offer("b", firing=None))
    assert command_bound(group).reason == "m1: its hardware does not specify that time"


def test_latch_by_a_later_signal_adds_its_delay():
    later = offer("a", signals=1, signal_s=(0.004, 0.006))
    assert command_bound(members(offer("a"), later)).value_s == 0.006
    assert command_bound(members(later, later)) == Bound(0.0)
    unknown = offer("a", signals=1, signal_s=None, no_firing_bound="undeclared")
    assert command_bound(members(offer("a"), unknown)) == Bound(None, "m1: undeclared")


def burst(traffic: CanTraffic, period_s: float) -> SyncOffer:
    return offer(
        "a",
        firing=Firing("can0", traffic, (SYNC, SYNC), 2 * period_s, 0),
        signals=1,
        signal_s=(period_s, period_s),
        burst=OneFrame(0x301, 6),
        period_s=period_s,
    )


def test_burst_that_fits_between_signals_has_one_latch():
    assert command_bound(members(*[burst(QUIET, 0.001)] * 8)) == Bound(0.0)  # 8 x 115 us


def test_burst_that_may_not_fit_adds_a_period_and_the_delay():
    found = command_bound(members(*[burst(QUIET, 0.001)] * 9))
    assert found.value_s == pytest.approx(0.001 + SYNC_S, abs=1e-12)
    found = command_bound(members(*[burst(QUIET, 0.001)] * 18))  # 2.07 ms
    assert found.value_s == pytest.approx(0.002 + SYNC_S, abs=1e-12)


def test_signal_after_a_late_one_comes_sooner():
    late = CanTraffic(1_000_000, (PeriodicMessage(0x080, 0, 0.001, 0.000_1),))
    found = command_bound(members(*[burst(late, 0.001)] * 7))  # 0.8 ms, and they need not fit
    assert found.value_s is not None
    assert found.value_s > 0.001
    assert command_bound(members(*[burst(late, 0.001)] * 3)) == Bound(0.0)


def test_burst_on_an_unknown_bus_has_no_bound():
    unknown = offer("a", firing=None, burst=OneFrame(0x301, 6), no_firing_bound="undeclared")
    assert command_bound(members(unknown, unknown)) == Bound(None, "m0: undeclared")


def test_bus_full_of_higher_priority_has_no_bound():
    full = CanTraffic(1_000_000, (PeriodicMessage(1, 8, 0.000_135),))
    stuck = offer("b", firing=Firing("can0", full, (OneFrame(0x201, 2),), 0.0, 1))
    found = command_bound(members(offer("a"), stuck))
    assert found.reason.endswith("may delay the start for ever")


def test_start_skew_adds_the_difference_of_latencies():
    group = members(offer("a", latency_s=(0.001, 0.002)), offer("a", latency_s=(0.0, 0.0005)))
    assert start_bound(group, Bound(0.01)).value_s == pytest.approx(0.012, abs=1e-15)
    assert start_bound(group, Bound(None, "why")) == Bound(None, "why")
    untold = members(offer("a"), offer("a", latency_s=None, no_start_bound="no tick"))
    assert start_bound(untold, Bound(0.0)) == Bound(None, "m1: no tick")


def test_end_skew_adds_start_rounding_clocks_and_ticks():
    fast, slow = offer("a", oscillator_ppm=100.0), offer("a", oscillator_ppm=50.0)
    group = members(fast, slow, offer("a", oscillator_ppm=None), durations=(2.0, 2.001))
    late_s = 2.001 / (1.0 - 50e-6) + 0.001
    early_s = 2.0 / (1.0 + 100e-6)
    found = end_bound(group, Bound(0.003))
    assert found.value_s == pytest.approx(0.003 + late_s - early_s, abs=1e-12)


def test_motor_without_an_end_needs_no_clock():
    clockless = offer("a", oscillator_ppm=None, no_end_bound="no clock")
    assert end_bound(members(clockless, clockless, durations=(1.0,)), Bound(1.0)) == Bound(0.0)
    both = members(clockless, clockless, durations=(1.0, 1.0))
    assert end_bound(both, Bound(1.0)) == Bound(None, "m0: no clock")
    assert end_bound(both, Bound(None, "no start")) == Bound(None, "no start")
