"""A drive whose timers fire slightly late: bounded, determined by the seed, however observed."""

from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motorhil.emulators.cia402.drive import build
from motorhil.emulators.controller import ControllerContext, SettingError
from motorhil.emulators.firmware.clock import LateWakes, lateness_ns
from tests.support.cia402.bench import MS, NODE, Bench

HEARTBEAT = 0x700 + NODE


def bench_with(seed=1, **oscillator):
    table = {
        **{"node_id": NODE, "oscillator": oscillator, "objects": {"1017h": 10}},
        "plant": {"preset": "wheel_60w", "load_inertia_kg_m2": 0.0},
    }
    return Bench(drive=build(table, ControllerContext(name="drive", folder=Path(), seed=seed)))


def heartbeats(seed=1, **oscillator):
    bench = bench_with(seed, **oscillator)
    bench.run(5_000 * MS)
    return bench.times(HEARTBEAT)[1:]


def test_heartbeats_are_late_within_the_jitter_and_vary():
    exact = heartbeats()
    late = [at - due for at, due in zip(heartbeats(jitter_s=0.001), exact, strict=False)]
    # Each heartbeat is timed from the one before.
    gaps = [b - a for a, b in pairwise(heartbeats(jitter_s=0.001))]
    assert len(gaps) > 400
    assert all(9 * MS <= gap <= 11 * MS for gap in gaps)
    assert min(late) >= 0
    assert len(set(gaps)) > 300
    assert max(gaps) - min(gaps) > 0.7 * MS


def test_jitter_depends_on_the_seed_and_is_off_by_default():
    assert heartbeats(seed=3, jitter_s=0.001) == heartbeats(seed=3, jitter_s=0.001)
    assert heartbeats(seed=3, jitter_s=0.001) != heartbeats(seed=4, jitter_s=0.001)
    assert {b - a for a, b in pairwise(heartbeats(ppm=0.0))} == {10 * MS}
    assert not isinstance(bench_with(ppm=5.0).drive.inner, LateWakes)


@given(st.integers(0, 1 << 62), st.integers(0, 1 << 60), st.integers(0, 10**8))
def test_lateness_is_within_its_bound(seed, due_ns, jitter_ns):
    assert 0 <= lateness_ns(seed, due_ns, jitter_ns) <= jitter_ns


def day(looks):
    """Return the frames of a jittering drive in a move, with the truth observed in between."""
    bench = bench_with(jitter_s=0.003, ppm=200.0)
    bench.run(400 * MS)
    bench.nmt(0x01)
    for k, word in enumerate((0x06, 0x07, 0x0F)):
        bench.run_until((410 + k) * MS)
        bench.controlword(word)
    bench.run_until(450 * MS)
    bench.set(0x6060, 0, 1, 1)
    bench.set(0x607A, 0, 3_000, 4)
    bench.controlword(0x1F)
    for at in looks:
        if at > bench.now:
            bench.run_until(at)
            bench.truth("position_inc")
    bench.run_until(1_200 * MS)
    bench.run(10 * MS)
    return bench.sent, bench.truth("position_inc")


@settings(max_examples=12)
@given(st.lists(st.integers(460 * MS, 1_100 * MS), max_size=60))
def test_observing_changes_nothing(looks):
    sent, position = day(())
    assert day(sorted(looks)) == (sent, position)
    assert position == 3_000


@pytest.mark.parametrize("value", [-1e-9, 0.11, "a"])
def test_impossible_jitter_is_rejected(value):
    with pytest.raises(SettingError) as caught:
        bench_with(jitter_s=value)
    assert caught.value.path == ("oscillator", "jitter_s")
