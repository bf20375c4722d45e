"""A controller's own clock: exact in both directions, however long a run is."""

from fractions import Fraction

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from motorhil.emulators.plant.oscillator import IDEAL, ONE, Oscillator

CLOCKS = st.builds(Oscillator, st.integers(-(ONE // 10), ONE // 10), st.integers(0, 1_000_000_000))
DAY_NS = 86_400 * 10**9
TIMES = st.integers(0, 10 * DAY_NS)


def exact_ns(clock, true_ns):
    return clock.phase_ns + true_ns * (1 + Fraction(clock.error_1e12, 10**12))


@given(CLOCKS, TIMES)
@example(Oscillator(50_000_000), DAY_NS)  # 50 ppm, a day: 4.32 s
def test_own_time_is_rate_times_true_time_rounded_down(clock, true_ns):
    assert clock.own_ns(true_ns) == exact_ns(clock, true_ns) // 1


@given(CLOCKS, TIMES)
def test_true_time_is_first_nanosecond_of_own_time(clock, own_ns):
    true_ns = clock.true_ns(own_ns)
    assert clock.own_ns(true_ns) >= own_ns
    assert true_ns == 0 or clock.own_ns(true_ns - 1) < own_ns


@given(CLOCKS, TIMES, st.integers(0, 1000))
def test_own_time_never_runs_backwards(clock, true_ns, later_ns):
    assert clock.own_ns(true_ns + later_ns) >= clock.own_ns(true_ns)


def test_50_ppm_are_4_32_seconds_per_day():
    assert Oscillator(50_000_000).own_ns(DAY_NS) - DAY_NS == 4_320_000_000


def test_ideal_clock_shows_true_time():
    assert IDEAL.is_ideal()
    assert IDEAL.rate() == 1.0
    assert not Oscillator(1).is_ideal()
    assert not Oscillator(0, 1).is_ideal()
    assert IDEAL.own_ns(123) == IDEAL.true_ns(123) == 123


@pytest.mark.parametrize(
    ("clock", "told"),
    [
        (Oscillator(50_000_000), "its own clock runs 50 ppm fast"),
        (Oscillator(-1_500_000, 250_000), "its own clock runs 1.5 ppm slow and began at 0.25 ms"),
        (Oscillator(0, 1_000_000), "its own clock began at 1 ms"),
        (IDEAL, "its own clock shows the true time"),
    ],
)
def test_oscillator_is_described_in_words(clock, told):
    assert clock.told() == told
