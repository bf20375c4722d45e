"""A host's choices about a motion: direction, end, unit, polarity, limits. CiA 402-2."""

import struct
from collections.abc import Mapping
from math import pi
from pathlib import Path

import pytest

from motorhil.emulators.canopen.object_dictionary import ObjectDictionary
from motorhil.emulators.cia402.objects.dictionary import DriveObjects
from motorhil.emulators.cia402.objects.units import Units
from motorhil.emulators.cia402.settings import read_settings
from motorhil.emulators.plant.presets import PRESETS
from tests.support.cia402.bench import MS, NODE, Bench

LIGHT = {"preset": "wheel_60w", "load_inertia_kg_m2": 0.0}
LIMIT, REACHED, SLIPPAGE = 0x0800, 0x0400, 0x2000
INVALID = 0x0609_0030
TURN = 1_000  # of the axis with a position range: 0..999


def standing(mode: int = 1, plant: Mapping[str, object] = LIGHT, **objects: int) -> Bench:
    bench = Bench(objects={"6065h": 0xFFFF_FFFF, **objects}, plant=plant)
    bench.enable(mode)
    bench.run(20 * MS)
    return bench


def go(bench: Bench, target: int, word: int = 0x1F, wait_ms: int = 2_000) -> None:
    bench.send(0x400 + NODE, struct.pack("<Hi", 0x0F, target))
    bench.send(0x400 + NODE, struct.pack("<Hi", word, target))
    bench.run(wait_ms * MS)


# --- 6082h, 6086h, 60F2h


def test_6082h_target_is_passed_at_the_end_velocity():
    bench = standing(**{"6081h": 40_000, "6082h": 10_000})
    go(bench, 20_000, wait_ms=0)
    before, demand = 0.0, 0.0
    while demand < 20_000:
        bench.run(1 * MS)
        before, demand = demand, bench.truth("demand_inc")
        assert demand - before <= 41
        assert demand >= 20_000 or not bench.statusword() & REACHED
        demand = max(demand, bench.truth("demand_inc"))
    bench.run(20 * MS)
    at = bench.truth("demand_inc")
    bench.run(100 * MS)
    assert bench.truth("demand_inc") - at == pytest.approx(1_000, abs=1)  # the motion continues
    assert bench.statusword() & REACHED
    bench.set(0x6082, 0, 0, 4)
    go(bench, 0)
    assert bench.truth("demand_inc") == 0
    assert bench.statusword() & REACHED


@pytest.mark.parametrize(
    ("end", "target"), [(40_000, 100), (100, 50), (1, 30_000), (90_000, 9_000)]
)
def test_6082h_any_end_velocity_is_held_afterwards(end, target):
    bench = standing(**{"6081h": 40_000, "6082h": end})
    go(bench, target)
    at = bench.truth("demand_inc")
    bench.run(1000 * MS)
    assert bench.truth("demand_inc") - at == pytest.approx(min(end, 40_000), abs=1)


def test_6082h_with_software_limits_stops_at_the_target():
    bench = standing(**{"6082h": 10_000, "607Dh:1": -5_000, "607Dh:2": 5_000})
    go(bench, 3_000)
    assert bench.truth("demand_inc") == 3_000


@pytest.mark.parametrize(
    ("index", "value", "size"),
    [
        (0x6086, 1, 2),
        (0x6086, -1, 2),
        (0x6088, 1, 2),
        (0x60F2, 3, 2),
        (0x60F2, 4, 2),
        (0x60F2, 0x10, 2),
        (0x60F2, 0x100, 2),
        (0x607E, 0x20, 1),
        (0x607E, 0x01, 1),
    ],
)
def test_values_without_behaviour_are_rejected(index, value, size):
    bench = Bench()
    bench.boot()
    assert bench.write(index, 0, value, size) == INVALID


# --- limits and statusword bit 11


def test_velocity_above_607fh_is_limited_and_reported():
    bench = standing(**{"607Fh": 20_000, "6081h": 50_000})
    go(bench, 50_000, wait_ms=500)
    assert bench.read(0x606B) == pytest.approx(20_000, abs=1)
    assert bench.statusword() & LIMIT
    bench.set(0x6081, 0, 20_000, 4)
    go(bench, 0, word=0x3F)
    assert not bench.statusword() & LIMIT


def test_new_607fh_applies_to_the_present_move():
    bench = standing(**{"6081h": 40_000})
    go(bench, 60_000, wait_ms=500)
    assert bench.read(0x606B) == pytest.approx(40_000, rel=0.01)
    bench.set(0x607F, 0, 10_000, 4)
    bench.run(200 * MS)
    assert bench.read(0x606B) == pytest.approx(10_000, rel=0.01)


def test_pv_reports_a_velocity_above_607fh():
    bench = standing(3, **{"607Fh": 20_000})
    for velocity, told in ((20_000, False), (20_001, True), (-20_001, True), (-20_000, False)):
        bench.set(0x60FF, 0, velocity, 4)
        bench.run(400 * MS)
        assert abs(bench.read(0x606B)) == 20_000
        assert bool(bench.statusword() & LIMIT) is told


def test_60c5h_and_60c6h_limit_the_ramps():
    bench = standing(**{"6083h": 400_000, "6084h": 400_000, "60C5h": 100_000, "60C6h": 50_000})
    bench.set(0x6081, 0, 20_000, 4)
    start = bench.now
    go(bench, 20_000, wait_ms=100)
    assert bench.read(0x606B) == pytest.approx(10_000, rel=0.03)
    bench.run_while(lambda: not bench.statusword() & REACHED)
    # 0.2 s up, 0.4 s down: 6000 increments; 14,000 at 20,000 per second
    assert (bench.now - start) / 1e9 == pytest.approx(0.2 + 0.4 + 0.7, abs=0.05)


def test_6073h_limits_the_current_of_every_loop():
    bench = standing(3, **{"6073h": 50, "6083h": 4_000_000})
    bench.set(0x60FF, 0, 100_000, 4)
    most = 0.0
    for _ in range(100):
        bench.run(1 * MS)
        most = max(most, abs(bench.truth("current_a")))
    assert most == pytest.approx(0.05 * bench.drive.settings.plant.current_max_a, rel=0.06)


def test_tq_obeys_6080h_and_its_changes_immediately():
    bench = standing(4, **{"6080h": 600})
    bench.set(0x6071, 0, 100, 2)
    turn = bench.drive.settings.plant.encoder_increments_rev
    for rpm in (600, 300):
        bench.set(0x6080, 0, rpm, 4)
        bench.run(2000 * MS)
        turns_s = bench.read(0x606C) / turn
        assert turns_s == pytest.approx(rpm / 60, abs=500 / turn)  # half an increment each tick
        assert bench.statusword() & LIMIT


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("torque", [100, 1000])
def test_tq_comes_to_6080h_and_stays_there(preset: str, torque: int):
    """The speed stays within the resolution of its measurement: half an increment each tick."""
    bench = standing(4, plant={"preset": preset}, **{"6080h": 3_000})
    bench.set(0x6071, 0, torque, 2)
    speeds = []
    for _ in range(4_000):
        bench.run(1 * MS)
        speeds.append(motor_rpm(bench))
    resolution = 0.5 * 60_000 / bench.drive.settings.plant.encoder_increments_rev
    assert max(speeds) < 3_000 + resolution
    assert min(speeds[-1_000:]) > 3_000 - resolution


@pytest.mark.parametrize("preset", PRESETS)
def test_tq_default_6080h_does_not_reduce_the_speed(preset: str):
    bench = standing(4, plant={"preset": preset})
    bench.set(0x6071, 0, 1_000, 2)
    bench.run(4_000 * MS)
    plant = bench.drive.settings.plant
    no_load_rpm = plant.no_load_speed_rad_s() * 60 / (2 * pi)
    assert motor_rpm(bench) == pytest.approx(no_load_rpm, abs=0.01)
    assert no_load_rpm <= bench.read(0x6080) < no_load_rpm + 1.0


def motor_rpm(bench: Bench) -> float:
    """Return the true speed of the motor."""
    output_rad_s = bench.truth("velocity_rad_s")
    return output_rad_s * bench.drive.settings.plant.gear_ratio * 60 / (2 * pi)


def test_pv_slippage_above_60f8h_is_reported_while_it_lasts():
    bench = standing(3, **{"60F8h": 3_000})
    bench.set(0x60FF, 0, 20_000, 4)
    bench.run(500 * MS)
    assert not bench.statusword() & SLIPPAGE
    stall = 1.2 * bench.drive.settings.plant.current_max_a
    stall *= bench.drive.settings.plant.torque_constant_n_m_a * 66
    bench.drive.stimulate("load_torque_n_m", stall, bench.now)
    bench.run(200 * MS)
    assert bench.statusword() & SLIPPAGE
    bench.drive.stimulate("load_torque_n_m", 0, bench.now)
    bench.run(1000 * MS)
    assert not bench.statusword() & SLIPPAGE


# --- 607Eh


@pytest.mark.parametrize(("polarity", "sign"), [(0x00, 1), (0x80, -1), (0x40, 1), (0xC0, -1)])
def test_607eh_bit_7_inverts_positions(polarity, sign):
    bench = standing(**{"607Eh": polarity, "607Dh:1": -4_000, "607Dh:2": 9_000})
    go(bench, 3_000)
    assert bench.truth("demand_inc") == 3_000 * sign
    assert bench.read(0x6062) == 3_000
    assert bench.read(0x6064) == pytest.approx(3_000, abs=10)
    go(bench, -5_000)
    assert bench.read(0x6062) == -4_000  # the limits are in host coordinates too
    assert bench.truth("demand_inc") == -4_000 * sign
    assert bench.statusword() & (LIMIT | REACHED) == LIMIT | REACHED


@pytest.mark.parametrize("mode", [3, 9])
@pytest.mark.parametrize(("polarity", "sign"), [(0x80, 1), (0x40, -1)])
def test_607eh_bit_6_inverts_velocities(polarity, sign, mode):
    bench = standing(mode, **{"607Eh": polarity})
    bench.set(0x60FF, 0, 15_000, 4)
    bench.run(300 * MS)
    assert bench.truth("velocity_rad_s") * sign > 0
    assert bench.read(0x606B) == 15_000
    assert bench.read(0x606C) == pytest.approx(15_000, rel=0.05)


# --- 607Bh


def around(**objects: int) -> Bench:
    return standing(**{"607Bh:1": 0, "607Bh:2": TURN - 1, **objects})


def test_607bh_positions_wrap_around():
    bench = around(**{"60F2h": 1})
    for move, shown in ((700, 700), (700, 400), (-900, 500)):
        go(bench, move, word=0x5F)  # relative to the demand
        assert bench.read(0x6062) == shown
    assert bench.truth("demand_inc") == 500
    go(bench, -1_500, word=0x5F)
    assert (bench.truth("demand_inc"), bench.read(0x6062)) == (-1_000, 0)


@pytest.mark.parametrize(
    ("way", "ends"),
    [
        (0, (900, 100, 600)),  # as a linear axis
        (1, (-100, -900, -1_400)),  # negative only
        (2, (900, 1_100, 1_600)),  # positive only
        (3, (-100, 100, -400)),  # the shortest
    ],
)
def test_60f2h_selects_the_direction_of_rotation(way, ends):
    bench = around(**{"60F2h": way << 6})
    for target, end in zip((900, 100, 600), ends, strict=True):
        go(bench, target)
        assert bench.truth("demand_inc") == end
        assert bench.read(0x6062) == target


def test_csp_moves_across_the_wrap_of_607bh():
    bench = standing(8, **{"607Bh:1": 0, "607Bh:2": TURN - 1, "60C2h:1": 10})
    for cycle in range(1, 31):
        bench.set(0x607A, 0, 90 * cycle % TURN, 4)
        bench.run(9 * MS)
    bench.run(20 * MS)
    assert bench.truth("demand_inc") == 2_700
    assert bench.read(0x6062) == 700


@pytest.mark.parametrize(
    ("raw", "demand_inc", "way", "target_inc"),
    [
        (-(1 << 31) + 50, (1 << 31) + 100, 0, (1 << 31) + 50),  # shown as -2^31 + 100
        ((1 << 31) - 9, -(1 << 31) - 20, 0, -(1 << 31) - 9),
        (-(1 << 31) + 3, (1 << 31) - 5, 3, (1 << 31) + 3),
        (5, -7, 0, 5),
        (2_000_000_000, -2_000_000_000, 0, 2_000_000_000),  # the long way, as a linear axis
    ],
)
def test_positions_repeat_after_32_bits(raw, demand_inc, way, target_inc):
    units = Units(1, 1, 1.0, 1.0)
    assert units.turned_inc(raw, demand_inc, way) == target_inc
    assert units.position_raw(target_inc) == raw


def test_following_error_does_not_wrap():
    for load, sign in ((3.0, 1), (-3.0, -1)):
        bench = around()
        bench.drive.stimulate("load_torque_n_m", load, bench.now)
        bench.run(3 * MS)
        assert 0 < sign * bench.read(0x60F4) < TURN // 2
        assert (bench.read(0x6064) > TURN // 2) is (sign > 0)  # pushed below 0, or above


def test_objects_missing_in_a_file_limit_nothing():
    """Check that without 607Dh, 6084h and 6099h there are defaults that prevent no motion."""
    objects = DriveObjects(ObjectDictionary(), read_settings({"node_id": 1}, Path()))
    motion, homing = objects.motion, objects.homing
    assert motion.within_limits_inc(10**9) == 10**9
    assert motion.within_limits_inc(-(10**9)) == -(10**9)
    assert motion.deceleration_inc_s2() == motion.acceleration_inc_s2() > 0.0
    assert (
        0.0 < homing.zero_speed_inc_s() < homing.switch_speed_inc_s() < motion.velocity_max_inc_s()
    )
