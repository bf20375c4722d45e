"""Profile velocity: 60FFh applies live, with ramps. CiA 402-2, profile velocity mode."""

import struct

import pytest

from tests.support.cia402.bench import MS, NODE, Bench

TARGET_REACHED = 0x0400
SPEED_IS_ZERO = 0x1000
A = 409_600


def ask(bench: Bench, velocity: int, word: int = 0x0F) -> None:
    """Send 60FFh in RPDO 4 (6040h, 60FFh)."""
    bench.send(0x500 + NODE, struct.pack("<Hi", word, velocity))


@pytest.fixture
def bench() -> Bench:
    bench = Bench(plant={"preset": "wheel_60w", "load_inertia_kg_m2": 0.0})
    bench.enable(mode=3)
    bench.run(50 * MS)
    return bench


def test_velocity_follows_the_ramp_and_is_reached(bench):
    assert bench.statusword() & (SPEED_IS_ZERO | TARGET_REACHED) == SPEED_IS_ZERO | TARGET_REACHED
    ask(bench, 40_000)
    at = bench.now
    assert not bench.statusword() & TARGET_REACHED
    bench.run_until(at + 50 * MS)
    assert bench.read(0x606B) == pytest.approx(A * 0.05, abs=A / 1000 + 1)  # at most one tick late
    assert not bench.statusword() & (SPEED_IS_ZERO | TARGET_REACHED)
    bench.run_until(at + 40_000 * 1000 // A * MS + 50 * MS)
    assert bench.read(0x606B) == 40_000
    assert bench.read(0x606C) == pytest.approx(40_000, abs=2_000)
    assert bench.statusword() & TARGET_REACHED
    before = bench.truth("position_rad")
    bench.run(1000 * MS)
    turned = (bench.truth("position_rad") - before) / 6.283185307179586 * 66 * 2000
    assert turned == pytest.approx(40_000, rel=1e-3)


def test_new_velocity_applies_immediately_across_zero(bench):
    ask(bench, 20_000)
    bench.run(200 * MS)
    at = bench.now
    ask(bench, -20_000)
    bench.run_until(at + 48 * MS)
    assert bench.truth("demand_inc") > 0
    bench.run_until(at + 150 * MS)
    assert bench.read(0x606B) == -20_000
    assert bench.statusword() & TARGET_REACHED


def test_velocity_by_sdo_applies_too(bench):
    bench.set(0x60FF, 0, 10_000, 4)
    bench.run(200 * MS)
    assert bench.read(0x606C) == pytest.approx(10_000, abs=2_000)


def test_new_ramp_applies_immediately(bench):
    ask(bench, 40_960)
    bench.run(50 * MS)
    bench.set(0x6083, 0, 4_096_000, 4)
    bench.run(10 * MS)
    assert bench.read(0x606B) == 40_960


def test_halt_ramps_down_and_motion_continues_afterwards(bench):
    ask(bench, 30_000)
    bench.run(200 * MS)
    ask(bench, 30_000, word=0x010F)
    bench.run(1 * MS)
    assert not bench.statusword() & TARGET_REACHED
    bench.run(200 * MS)
    assert bench.truth("velocity_rad_s") == pytest.approx(0.0, abs=1e-3)
    assert bench.statusword() & (SPEED_IS_ZERO | TARGET_REACHED) == SPEED_IS_ZERO | TARGET_REACHED
    ask(bench, 30_000)
    bench.run(200 * MS)
    assert bench.read(0x606B) == 30_000


def test_enabling_ramps_to_the_present_target_velocity():
    bench = Bench()
    bench.operational()
    bench.set(0x6060, 0, 3, 1)
    bench.set(0x60FF, 0, 10_000, 4)
    bench.run(100 * MS)
    assert bench.truth("velocity_rad_s") == 0
    bench.enable()
    bench.run(200 * MS)
    assert bench.read(0x606B) == 10_000


def test_max_velocity_limits_the_demand(bench):
    bench.set(0x607F, 0, 15_000, 4)
    ask(bench, -40_000)
    bench.run(300 * MS)
    assert bench.read(0x606B) == -15_000
    bench.set(0x607F, 0, 20_000, 4)
    bench.run(300 * MS)
    assert bench.read(0x606B) == -20_000


def test_velocity_unit_is_that_of_the_rig():
    bench = Bench(units={"velocity_unit_inc_s": 2000 / 60, "acceleration_unit_inc_s2": 2000 / 60})
    bench.enable(mode=3)
    ask(bench, 300)  # rpm
    bench.run(300 * MS)
    assert bench.read(0x606B) == 300
    assert bench.read(0x6069 if bench.drive.od.has_index(0x6069) else 0x606C) != 0
    before = bench.truth("position_rad")
    bench.run(2000 * MS)
    turned = (bench.truth("position_rad") - before) / 6.283185307179586 * 66
    assert turned == pytest.approx(10.0, rel=2e-3)  # 300 rpm for 2 s


def test_change_from_pv_to_pp_stops_the_motor(bench):
    ask(bench, 30_000)
    bench.run(200 * MS)
    bench.set(0x6060, 0, 1, 1)
    bench.run(300 * MS)
    assert bench.read(0x6061) == 1
    assert bench.truth("velocity_rad_s") == pytest.approx(0.0, abs=1e-3)
    assert bench.statusword() & TARGET_REACHED


def test_bit_12_is_cleared_after_the_threshold_time(bench):
    """606Fh: exceeded for longer than 6070h, it clears bit 12; below it, the bit is set."""
    bench.set(0x6070, 0, 200, 2)
    ask(bench, 40_000)
    bench.run(150 * MS)
    assert bench.read(0x606C) > bench.read(0x606F, signed=False)
    assert bench.statusword() & SPEED_IS_ZERO
    bench.run(100 * MS)
    assert not bench.statusword() & SPEED_IS_ZERO
    ask(bench, 0)
    bench.run(110 * MS)
    assert bench.statusword() & SPEED_IS_ZERO  # at once, not 200 ms later
