"""The ten defects found in the best-known open CiA 402 emulator (field.md 3.1): none is here.

Source of the list: ros2_canopen `canopen_fake_slaves`, cia402_slave.hpp and motion_generator.cpp.
"""

import struct
from collections.abc import Sequence
from itertools import pairwise

import pytest
from canopen import import_od

from motorhil.emulators.canopen.object_dictionary import ObjectDictionary
from motorhil.emulators.cia402.objects.dictionary import DriveObjects
from motorhil.emulators.cia402.settings import OWN_EDS, read_settings
from tests.support.cia402.bench import MS, NODE, Bench

LIGHT = {"preset": "wheel_60w", "load_inertia_kg_m2": 0.0}


def demands(bench: Bench, milliseconds: int) -> list[float]:
    values = []
    for _ in range(milliseconds):
        bench.run(1 * MS)
        values.append(bench.truth("demand_inc"))
    return values


def differences(values: Sequence[float]) -> list[float]:
    return [after - before for before, after in pairwise(values)]


def moving(mode: int = 1, **settings: object) -> Bench:
    bench = Bench(plant=LIGHT, **settings)
    bench.enable(mode)
    bench.run(20 * MS)
    return bench


def go(bench: Bench, target: int, word: int = 0x1F) -> None:
    bench.send(0x400 + NODE, struct.pack("<Hi", word, target))


def test_1_velocity_and_acceleration_are_not_swapped():
    bench = moving()
    bench.set(0x6081, 0, 20_000, 4)  # 20 increments per tick
    bench.set(0x6083, 0, 500_000, 4)  # half an increment per tick more in each tick
    bench.set(0x6084, 0, 250_000, 4)
    go(bench, 10_000)
    speeds = differences(demands(bench, 700))
    assert max(speeds) == 20
    changes = differences(speeds)
    assert max(changes) <= 2  # 0.5, from rounded positions
    assert speeds.index(20) in range(38, 43)  # 20,000 / 500,000 = 40 ms
    assert speeds[-100:] == [0] * 100


def test_2_pp_needs_an_edge_and_implements_its_bits():
    bench = moving()
    bench.set(0x607A, 0, 3_000, 4)
    assert max(demands(bench, 200)) == 0  # no edge, no motion
    go(bench, 3_000)
    assert bench.statusword() & 0x1000
    bench.controlword(0x0F)
    assert not bench.statusword() & 0x1000
    assert demands(bench, 600)[-1] == 3_000
    go(bench, 500, word=0x5F)  # relative
    bench.controlword(0x0F)
    assert demands(bench, 600)[-1] == 3_500
    go(bench, 10_000)
    bench.controlword(0x0F)
    bench.run(150 * MS)
    bench.controlword(0x010F)  # halt
    assert demands(bench, 600)[-1] < 10_000
    bench.controlword(0x0F)
    assert demands(bench, 600)[-1] == 10_000


@pytest.mark.parametrize(("word", "state"), [(0x06, 2), (0x00, 1), (0x02, 1)])
def test_3_motion_ends_when_the_drive_is_disabled(word, state):
    bench = moving()
    go(bench, 50_000)
    bench.run(200 * MS)
    bench.controlword(word)
    bench.run(30_000 * MS)
    assert bench.truth("state") == state
    assert 0 < bench.truth("position_inc") < 45_000
    assert bench.truth("velocity_rad_s") == 0.0
    assert bench.truth("current_a") == pytest.approx(0.0, abs=1e-9)


def test_4_faults_occur_are_reported_and_can_be_reset():
    bench = moving(objects={"6065h": 300, "6066h": 5})
    bench.drive.stimulate("load_torque_n_m", 40.0, bench.now)
    bench.run(300 * MS)
    assert bench.truth("state") == 7
    assert bench.last(0x085)[:2] == bytes.fromhex("1186")
    assert bench.read(0x603F, signed=False) == 0x8611
    bench.drive.stimulate("load_torque_n_m", 0.0, bench.now)
    bench.controlword(0x80)
    assert bench.truth("state") == 1
    bench.enable()


def test_5_quick_stop_changes_the_velocity():
    bench = moving(mode=3)
    bench.send(0x500 + NODE, struct.pack("<Hi", 0x0F, 40_000))
    bench.run(300 * MS)
    before = bench.truth("velocity_rad_s")
    bench.controlword(0x02)
    bench.run(30 * MS)
    assert bench.truth("velocity_rad_s") < 0.6 * before
    bench.run(300 * MS)
    assert bench.truth("velocity_rad_s") == pytest.approx(0.0, abs=0.01)


def test_6_profile_velocity_uses_ramps():
    bench = moving(mode=3)
    bench.set(0x6083, 0, 100_000, 4)
    bench.send(0x500 + NODE, struct.pack("<Hi", 0x0F, 20_000))
    velocities = []
    for _ in range(20):
        bench.run(10 * MS)
        velocities.append(bench.read(0x606B))  # the read itself takes 1 ms
    assert velocities[0] < 2_000
    assert all(step <= 1_100 + 1 for step in differences([0, *velocities]))  # 11 ms at 100,000
    assert velocities[-1] == 20_000


def test_7_csp_waits_for_sync_and_keeps_every_increment():
    bench = moving(mode=8, objects={"1402h:2": 1, "60C2h:1": 10})
    for position in (1, 2, 3, 1234, 1235):
        before = bench.truth("demand_inc")
        bench.send(0x400 + NODE, struct.pack("<Hi", 0x0F, position))
        bench.run(5 * MS)
        assert bench.truth("demand_inc") == before  # no SYNC yet
        bench.sync()
        bench.run(12 * MS)
        assert bench.truth("demand_inc") == position
    bench.set(0x607D, 1, -10, 4)
    bench.set(0x607D, 2, 1235, 4)
    for position, reached, limited in ((1235, 1235, False), (1236, 1235, True)):
        bench.send(0x400 + NODE, struct.pack("<Hi", 0x0F, position))
        bench.sync()
        bench.run(50 * MS)
        assert bench.truth("demand_inc") == reached
        assert bool(bench.statusword() & 0x0800) is limited  # reported, not silently ignored


@pytest.mark.parametrize("period_ms", [2, 5, 20])
def test_8_interpolation_takes_the_time_in_60c2h(period_ms):
    bench = moving(mode=8)
    bench.set(0x60C2, 1, period_ms, 1)
    go(bench, 500, word=0x0F)
    values = demands(bench, period_ms + 3)
    assert values.index(500) == period_ms
    assert values[1 + period_ms // 2 - 1] == pytest.approx(500 * (period_ms // 2) / period_ms)


def test_9_homing_takes_drive_time_and_can_fail():
    bench = moving()
    go(bench, 2_000)
    bench.run(600 * MS)
    bench.set(0x6060, 0, 6, 1)
    bench.controlword(0x0F)
    bench.controlword(0x1F)
    assert bench.statusword() & 0x3400 in (0x0000, 0x1400)
    bench.run(2 * MS)
    assert bench.statusword() & 0x3400 == 0x1400
    assert bench.read(0x6064) == 0

    bench = moving(objects={"6098h": 36})  # a method without behaviour
    bench.set(0x6060, 0, 6, 1)
    bench.controlword(0x1F)
    bench.run(1000 * MS)
    assert bench.statusword() & 0x3400 == 0x2400


def scenario() -> list[tuple[int, int, bytes]]:
    bench = moving()
    go(bench, 12_345)
    bench.run(100 * MS)
    bench.drive.stimulate("load_torque_n_m", 3.0, bench.now)
    bench.run(900 * MS)
    bench.controlword(0x02)
    bench.run(500 * MS)
    return bench.sent


def test_10_drive_does_not_poll_and_is_deterministic():
    assert scenario() == scenario()
    bench = Bench()
    bench.operational()
    bench.run(100 * MS)
    assert bench.drive.next_deadline_ns() is None  # at rest there is no deadline
    bench.enable(mode=1)
    bench.run(1000 * MS)
    assert bench.drive.next_deadline_ns() is None  # standing in position: the same


# Facts about the drive: they are only read, and have a meaning to the host only.
CONSTANTS = {0x60E3, 0x6402, 0x67FF, 0x6086}


def test_11_every_object_of_our_file_has_an_effect():
    """Check that an object without reader or writer is one the drive itself uses."""
    behind = ObjectDictionary()
    DriveObjects(behind, read_settings({"node_id": 1}, OWN_EDS.parent))
    missing = -(1 << 70)
    drive = Bench().drive
    for variable in drive.od:
        if not 0x6000 <= variable.index <= 0x67FF or variable.index in CONSTANTS:
            continue
        if variable.subindex == 0 and len(drive.od.subindices(variable.index)) > 1:
            continue  # the number of sub-indices
        assert (
            variable.reader is not None
            or variable.writer is not None
            or behind.integer(variable.index, variable.subindex, missing) != missing
        ), f"{variable.index:04X}h:{variable.subindex} does nothing"


def test_our_file_reads_the_same_in_the_canopen_parser():
    theirs = import_od(str(OWN_EDS), node_id=NODE)
    ours = Bench().drive.od
    assert [index for index in sorted(theirs) if index >= 0x1000] == list(ours.indices())
    for variable in ours:
        entry = theirs.get_variable(variable.index, variable.subindex)
        assert entry.data_type == variable.data_type
        assert entry.access_type == variable.access
        assert entry.pdo_mappable == variable.pdo_mappable
        if isinstance(entry.default, int):
            assert entry.default == variable.default
