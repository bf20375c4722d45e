"""Random inversion of bits, compared with the draws."""

import random

import pytest

from motorhil.emulators.can.bitlevel.episode import ALL_PORTS
from motorhil.emulators.can.bus.port import KIND_MASK, TOLD
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule, NoiseSource
from tests.support.can.deliveries import BIT, confirmed, run
from tests.support.can.faulty_bus import LEFT, SYNC, bus_with


def source(rate: float, seed: int) -> NoiseSource:
    rule = FaultRule("noise", FaultKind.NOISE, bit_error_rate=rate)
    return NoiseSource(rule, ALL_PORTS, random.Random(seed).random)


def places(rate: float, seed: int, bits: int) -> list[int]:
    """Return the inverted bits, one bit after another.

    A draw is used when the probability of no inversion so far is not above it. The products are in
    another order than the emulator's: equal except for their last digits.
    """
    draws = random.Random(seed)
    found: list[int] = []
    chance, spared = draws.random(), 1.0
    for bit in range(bits):
        spared *= 1.0 - rate
        if spared <= chance:
            found.append(bit)
            chance, spared = draws.random(), 1.0
    return found


@pytest.mark.parametrize(("rate", "bits"), [(0.1, 20_000), (1e-2, 50_000), (1e-4, 300_000)])
def test_bits_are_inverted_at_geometric_distances(rate, bits):
    expected = places(rate, 7, bits)
    assert source(rate, 7).within(bits) == expected
    assert len(expected) == pytest.approx(bits * rate, abs=5 * (bits * rate) ** 0.5)


def test_draw_of_zero_spares_very_many_bits():
    rule = FaultRule("noise", FaultKind.NOISE, bit_error_rate=0.1)
    assert NoiseSource(rule, ALL_PORTS, lambda: 0.95).within(3) == [0, 1, 2]  # 0.9 is not above it
    assert NoiseSource(rule, ALL_PORTS, lambda: 0.0).left > 2000  # until a product is 0


def test_look_ahead_does_not_change_places():
    expected = places(0.03, 3, 30_000)
    looked_at = source(0.03, 3)
    pace = random.Random(1)
    found: list[int] = []
    start = 0
    while start < 29_000:
        looked_at.within(pace.randrange(400))  # expected, but then does not come
        bits = pace.randrange(1, 300)
        assert looked_at.left == next(one for one in expected if one >= start) - start
        found += [start + place for place in looked_at.within(bits)]
        looked_at.pass_by(bits)
        start += bits
    assert found == [place for place in expected if place < start]


@pytest.mark.parametrize("seed", range(6))
def test_noise_counts_bits_between_frames(seed):
    """SYNC after SYNC, 51 bits with intermission by can-utils: the first struck one is known."""
    rule = FaultRule("noise", FaultKind.NOISE, bit_error_rate=1e-3)
    bus = bus_with(rule, seed=seed)
    first = places(1e-3, seed, 100_000)[0]
    deliveries = run(bus, [(0, LEFT, SYNC)] * (first // 51 + 5))
    errors_ns = [time_ns for time_ns, (_, _, kind) in deliveries if kind & KIND_MASK == TOLD]
    good = [time_ns for time_ns, _ in confirmed(deliveries, LEFT) if time_ns < errors_ns[0]]
    assert good == [(number * 51 + 48) * BIT for number in range(len(good))]
    assert first - 48 < len(good) * 51 <= first  # an error is reported in its frame
