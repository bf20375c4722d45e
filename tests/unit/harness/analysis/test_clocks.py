"""Clocks in recordings: known periods, errors and jitter are recovered."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.harness.analysis.measured import clock_of
from tests.support.recordings.message_sets import MS, US


def test_clock_error_is_measured_in_ppm():
    """A period of 10 ms by a clock that is 40 ppm fast is 400 ns shorter."""
    clock = clock_of([7 + (10 * MS - 400) * n for n in range(1000)])
    assert clock.period_ns == 10 * MS - 400
    assert clock.nominal_ns == 10 * MS
    assert clock.error_ppm == pytest.approx(40.0, abs=0.01)
    assert (clock.peak_to_peak_ns, clock.deviation_ns, clock.is_told) == (0, 0, False)


def test_jitter_is_the_residual_of_the_fit():
    """Frames are 3 us early and late, symmetrically: 6 us peak to peak, deviation 3 us."""
    late = (-3, 3, 3, -3)
    clock = clock_of([10 * MS * n + late[n % 4] * US for n in range(400)])
    assert clock.period_ns == pytest.approx(10 * MS, rel=1e-12)
    assert clock.peak_to_peak_ns == pytest.approx(6 * US)
    assert clock.deviation_ns == pytest.approx(3 * US)


def test_drift_and_pause_are_not_jitter():
    grid = [(5 * MS + 50) * n for n in range(200)]
    clock = clock_of([*grid, *(grid[-1] + 777 * MS + at for at in grid)])
    assert clock.period_ns == 5 * MS + 50
    assert clock.peak_to_peak_ns == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    ("period_ns", "nominal_ns"),
    [(9_999_000, 10 * MS), (12_500_100, 12_500 * US), (1_000_050, MS), (12_345_678, None)],
)
def test_nominal_period_is_the_nearest_round_one(period_ns, nominal_ns):
    assert clock_of([period_ns * n for n in range(20)]).nominal_ns == nominal_ns


def test_stated_period_takes_precedence_if_near():
    times = [9_999_000 * n for n in range(20)]
    told = clock_of(times, [5 * MS, 9_990_000])
    assert (told.nominal_ns, told.is_told) == (9_990_000, True)
    assert told.error_ppm == pytest.approx(-900.09, abs=0.01)
    assert not clock_of(times, [5 * MS]).is_told


def test_drift_is_the_difference_of_clock_errors():
    fast, slow = (clock_of([period * n for n in range(50)]) for period in (9_999_800, 10_000_500))
    drift_ppm = fast.drift_ppm(slow)
    assert drift_ppm == pytest.approx(70.0, abs=0.01)
    assert clock_of([5 * MS * n for n in range(50)]).drift_ppm(slow) is None


@given(
    st.integers(100_000, 100 * MS),
    st.lists(st.integers(-100, 100), min_size=20, max_size=60),
)
def test_measured_jitter_is_bounded_by_true_jitter(period_ns: int, late_us: list[int]):
    late_ns = [one * period_ns // 2000 for one in late_us]
    clock = clock_of([10**15 + period_ns * n + late for n, late in enumerate(late_ns)])
    put_in_ns = max(late_ns) - min(late_ns)
    assert clock.deviation_ns <= put_in_ns / 2 + 1e-3
    assert clock.deviation_ns <= clock.peak_to_peak_ns + 1e-3
    assert abs(clock.period_ns - period_ns) * (len(late_ns) - 1) <= 1.5 * put_in_ns + 1e-3
