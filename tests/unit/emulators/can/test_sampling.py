"""Sampling of bits, compared with a receiver in continuous time."""

from fractions import Fraction

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.controller_config import (
    ONE,
    USUAL_TIMING,
    BitTiming,
    CanNode,
    first_misread,
)
from motorhil.emulators.can.frame import pack
from tests.support.can import frame_bits as wire
from tests.support.can.deliveries import heard, run

TIMINGS = st.sampled_from(
    [BitTiming(), BitTiming(16, 12, 4), BitTiming(8, 7, 1), BitTiming(25, 20, 2)]
)

PPM = st.integers(-100_000, 100_000) | st.sampled_from([-90_000, -40_000, 30_000, 60_000, 99_000])


def levels_of(frame: wire.Fields) -> bytes:
    return bytes(int(bit) for bit in wire.on_the_wire(frame))


def misread_in_time(levels: bytes, drift: Fraction, timing: BitTiming) -> int | None:
    """Return the first bit misread by a receiver with sample points and resynchronisation."""
    bit = 1 + drift  # its bit time, where the sender's is 1
    sample = bit * timing.sample / timing.quanta
    jump = Fraction(timing.jump, timing.quanta)
    edges = [
        place for place in range(1, len(levels)) if levels[place - 1] == 1 and levels[place] == 0
    ]
    begins = Fraction(0)
    for number, sent in enumerate(levels):
        if number in edges:  # an edge at or near the expected time: shift the bit towards it
            error = begins - number
            begins -= max(-jump, min(jump, error))
        place = int(begins + sample) if begins + sample >= 0 else 0
        if levels[min(place, len(levels) - 1)] != sent:
            return number
        begins += bit
    return None


@given(wire.fields(), TIMINGS, PPM)
def test_misread_bit_equals_continuous_receiver(frame, timing, ppm):
    levels = levels_of(frame)
    found = first_misread(levels, ppm * ONE // 1_000_000, timing)
    event("misread" if found is not None else "read")
    assert found == misread_in_time(levels, Fraction(ppm, 1_000_000), timing)


@given(wire.fields(), TIMINGS, st.integers(0, 100))
def test_no_frame_is_misread_within_tolerance(frame, timing, percent):
    drift = timing.tolerance_1e12() * percent // 100
    for error in (drift, -drift):
        assert first_misread(levels_of(frame), error, timing) is None


def test_frame_with_rarest_edges_is_misread_beyond_tolerance():
    """Runs of five: an edge every ten bits, and each leaves more of the drift uncorrected."""
    frame = wire.Fields(0x078, False, False, 8, bytes([0x3C]) * 8)
    worst = bytes([0] * 5 + [1] * 5) * 10
    timing = BitTiming()
    tolerance = timing.tolerance_1e12()
    assert first_misread(worst, tolerance, timing) is None
    # In bit times: 0.09375 of drift in ten bits, 0.0625 of it corrected. In bit 29 the sample is 2
    # * 0.03125 + 9 * 0.009375 + 0.0082 late, and the margin is 0.125.
    assert first_misread(worst, tolerance * 3 // 2, timing) == 29
    assert first_misread(levels_of(frame), tolerance * 8, timing) is not None


# Hartwich & Bassemir: df <= SJW / (20 NBT) and min(PS1, PS2) / (2 (13 NBT - PS2)) for each of two
# clocks, so twice that between them.
@pytest.mark.parametrize(
    ("timing", "ppm"),
    [(BitTiming(16, 14, 1), 6250), (BitTiming(16, 14, 2), 9708), (BitTiming(16, 12, 4), 19607)],
)
def test_tolerance_equals_both_conditions(timing, ppm):
    assert timing.tolerance_1e12() // 1_000_000 == ppm


@pytest.mark.parametrize(
    ("quanta", "sample", "jump", "told"),
    [
        (16, 16, 1, "sample point 16"),
        (16, 1, 1, "sample point 1"),
        (16, 14, 3, "jump width 3"),
        (16, 14, 0, "jump width 0"),
    ],
)
def test_invalid_bit_timing_is_refused(quanta, sample, jump, told):
    with pytest.raises(ValueError, match=told):
        BitTiming(quanta, sample, jump)


def two_nodes(ppm: float, timing: BitTiming = USUAL_TIMING) -> CanBus:
    bus = CanBus("can0", 500_000, FaultPlan((), lambda: 1.0))
    bus.attach("true", CanNode(timing=timing))
    bus.attach("off", CanNode(clock_error_1e12=round(ppm * 1e6), timing=timing))
    return bus


# 00000000h, 8 bytes of 00h: 127 bits (can-physics.md 6.2), 124 of them up to the end of frame.
@pytest.mark.parametrize(
    ("port", "ppm", "end_ns"),
    [(0, 100.0, 248_000), (1, 100.0, 247_975), (1, -100.0, 248_024), (1, 5000.0, 246_766)],
)
def test_frame_duration_follows_sender_clock(port, ppm, end_ns):
    bus = two_nodes(ppm)
    deliveries = run(bus, [(0, port, pack(0, bytes(8)))])
    assert [time_ns for time_ns, _ in deliveries] == [end_ns]
    assert bus.statistics.frames == 1


def test_nodes_with_distant_clocks_cannot_communicate():
    bus = two_nodes(40_000.0)
    deliveries = run(bus, [(0, 0, pack(0, bytes(8)))], until_ns=100_000_000)
    assert heard(deliveries, 1) == []
    assert "too far apart" in bus.take_fault_events()[0][2]
    assert bus.node(0).confinement.tec >= 128
    assert bus.statistics.frames == 0


def test_wide_jump_and_early_sample_point_allow_communication():
    """The receiver is the slow one: it samples late, with a margin of an eighth of a bit."""
    fives = pack(0x078, bytes([0x3C]) * 8)
    wide = two_nodes(15_000.0, BitTiming(8, 6, 2))
    assert [frame for _, frame in heard(run(wide, [(0, 1, fives)]), 0)] == [fives]
    assert wide.node(1).confinement.tec == 0
    narrow = two_nodes(15_000.0)
    assert heard(run(narrow, [(0, 1, fives)], until_ns=10_000_000), 0) == []
    assert narrow.node(1).confinement.tec >= 128
