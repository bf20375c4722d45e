"""An I/O node uses its own clock, its motors true time."""

from pathlib import Path

import pytest

from motorhil.emulators.cia401.node import IoNode, build
from motorhil.emulators.controller import ControllerContext
from motorhil.emulators.firmware.clock import OwnTime
from tests.support.cia402.bench import BOOT_UP, MS, NODE, Bench
from tests.support.cia402.io_bench import IoBench

S = 1000 * MS


def new(**oscillator):
    table = {"node_id": NODE, "oscillator": oscillator, "objects": {"1017h": 100}}
    return build(table, ControllerContext(name="io", folder=Path(), seed=1))


def bench_with(ppm):
    bench = IoBench()
    Bench.__init__(bench, drive=new(ppm=ppm))
    return bench


def test_ideal_clock_needs_no_wrapper():
    assert isinstance(new(), IoNode)
    assert isinstance(new(ppm_max=50), OwnTime)


@pytest.mark.parametrize("ppm", [-250, 250])
def test_heartbeats_use_own_clock(ppm):
    bench = bench_with(ppm)
    bench.run(100 * S)
    times = bench.times(0x700 + NODE)
    mean_ns = (times[-1] - times[0]) / (len(times) - 1)
    assert mean_ns == pytest.approx(100 * MS / (1 + ppm / 1e6), abs=1)


@pytest.mark.parametrize("ppm", [-100_000, 100_000])
def test_amplifier_enable_time_uses_own_clock(ppm):
    bench = bench_with(ppm)
    bench.run(2 * BOOT_UP)
    bench.nmt(0x01)
    bench.enables(0xFF)
    asked = bench.now
    bench.run_while(lambda: bench.truth("ready") == 0.0)
    assert abs(bench.now - asked - 5 * MS / (1 + ppm / 1e6)) < 2


@pytest.mark.parametrize("ppm", [-100_000, 100_000])
def test_motors_move_in_true_time(ppm):
    """A load turns the motor: 36, 40 and 44 ticks of the three clocks are 10 ms each."""
    own, true = bench_with(ppm), bench_with(0)
    for bench in (own, true):
        bench.run(S)
        bench.drive.stimulate("load_torque_n_m", 5.0, bench.now)
    for _ in range(20):
        for bench in (own, true):
            bench.run(10 * MS)
        assert own.truth("position_rad") == pytest.approx(true.truth("position_rad"), rel=1e-9)
    assert abs(own.truth("position_rad")) > 0.01
