from hypothesis import given
from hypothesis import strategies as st

from motorhil.harness.replay.frames import Lateness

DELAYS = st.lists(st.integers(0, 2_000) | st.integers(0, 10**12), min_size=1, max_size=200)


@given(DELAYS, st.sampled_from([0.01, 0.5, 0.99, 1.0]))
def test_quantile_is_at_most_a_32nd_too_large(delays, share):
    late = Lateness()
    for delay in delays:
        late.add(delay)
    exact = next(d for k, d in enumerate(sorted(delays), 1) if k >= share * len(delays))
    assert exact <= late.quantile_ns(share) <= exact + exact / 32
    assert (late.count, late.worst_ns, late.last_ns) == (len(delays), max(delays), delays[-1])


def test_lateness_without_delays_is_zero():
    late = Lateness()
    assert (late.quantile_ns(0.5), late.worst_ns, late.last_ns) == (0, 0, 0)
    late.add(-5)
    assert (late.count, late.worst_ns, late.quantile_ns(1.0)) == (1, 0, 0)


def test_table_size_is_bounded():
    late = Lateness()
    for delay in range(0, 10_000_000, 97):
        late.add(delay)
    assert len(late._counts) < 700
