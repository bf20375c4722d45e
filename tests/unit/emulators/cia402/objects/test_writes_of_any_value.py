"""No write that the dictionary admits, in any order and mode, fails later."""

import random

import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from motorhil.emulators.canopen.object_dictionary import integer_range, is_integer, length_bits
from tests.support.cia402.bench import MS, Bench

CONTROLWORDS = ((0x80, 6, 7, 15), (0x1F,), (0x5F,), (0x3F,), (0x0F, 0x1F), (2,), (0x10F,))
MODES = (1, 3, 4, 6, 7, 8, 9, 10)
COMMUNICATION = 0x2000  # below: whom the node hears, which other tests write


def extremes(low: int, high: int, draw: random.Random) -> int:
    return draw.choice((0, 1, 2, -1, low, high, high // 2, draw.randint(low, high)))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_drive_lives_through_any_writes(seed: int):
    draw = random.Random(seed)
    bench = Bench(timing={"boot_up_s": 0.01})
    od = bench.drive.od
    places = [one for one in od if one.is_writable() and is_integer(one.data_type)]
    places = [one for one in places if one.index >= COMMUNICATION]
    assert len(places) > 50
    bench.run_until(20 * MS)
    bench.nmt(1)
    accepted = 0
    for _ in range(draw.randrange(5, 25)):
        what = draw.random()
        if what < 0.6:
            one = draw.choice(places)
            value = extremes(*integer_range(one.data_type), draw)
            size = length_bits(one.data_type) // 8
            accepted += not bench.write(one.index, one.subindex, value, size)
        elif what < 0.7:
            bench.write(0x6060, 0, draw.choice(MODES), 1)
        elif what < 0.9:
            for word in draw.choice(CONTROLWORDS):
                bench.controlword(word)
            bench.run(draw.choice((1, 20, 200)) * MS)
        else:
            bench.sync()
            bench.run(draw.choice((1, 20, 200)) * MS)
    bench.run(300 * MS)
    event(f"accepted writes: {min(accepted, 5)}{'+' * (accepted > 5)}")


@pytest.mark.parametrize("subindex", [1, 2])
def test_gains_of_zero_do_not_end_a_rig(subindex: int):
    bench = Bench(timing={"boot_up_s": 0.01})
    bench.run_until(20 * MS)
    bench.write(0x60F6, subindex, 0, 4)
    for word in (6, 7, 15):
        bench.controlword(word)
    bench.run(100 * MS)
