"""Interpolated position: records from a buffer, one per period, linear. CiA 402-2, ip."""

import struct

import pytest

from motorhil.emulators.cia402.state_machine import PdsState
from tests.support.cia402.bench import MS, NODE, Bench

LIGHT = {"preset": "wheel_60w", "load_inertia_kg_m2": 0.0}
ACTIVE, REACHED = 0x1000, 0x0400
FULL = 0x0800_0022  # cannot be stored because of the device's state (CiA 301)


def interpolating(word: int = 0x1F, **settings: object) -> Bench:
    """Return a bench with 60C2h 10 ms, enabled in ip with this controlword."""
    settings.setdefault("objects", {})
    objects = {"60C2h:1": 10, "6065h": 0xFFFF_FFFF, **settings.pop("objects")}
    bench = Bench(objects=objects, plant=LIGHT, **settings)
    bench.enable(mode=7)
    bench.controlword(word)
    return bench


def record(bench: Bench, position: int) -> int:
    return bench.write(0x60C1, 1, position, 4)


def every(bench: Bench, step_ms: int, count: int) -> list[float]:
    values = []
    for _ in range(count):
        bench.run(step_ms * MS)
        values.append(bench.truth("demand_inc"))
    return values


def test_clearing_bit_4_brakes_before_the_record():
    bench = interpolating(word=0x0F, objects={"60C2h:1": 200, "6084h": 1_000_000})
    assert record(bench, 20_000) == 0
    bench.controlword(0x1F)
    bench.sync()
    (begun,) = every(bench, 50, 1)
    bench.controlword(0x0F)
    (ended,) = every(bench, 200, 1)
    speed = 20_000 / 0.2
    assert ended - begun == pytest.approx(speed * speed / 2e6 + speed * 1e-3, abs=speed * 1e-3)


def test_each_sync_takes_one_record_linearly():
    bench = interpolating(word=0x0F)
    for position in (100, 300, 200):
        assert record(bench, position) == 0
    bench.controlword(0x1F)
    seen = []
    for _ in range(4):
        bench.sync()
        seen.append(every(bench, 1, 10))
    assert seen[0] == [10.0 * k for k in range(10)]
    assert seen[1] == [100 + 20.0 * k for k in range(10)]
    assert seen[2] == [300 - 10.0 * k for k in range(10)]
    assert seen[3] == [200] * 10


def test_record_by_synchronous_rpdo_is_taken_at_its_sync():
    bench = interpolating(objects={"1402h:2": 1, "1602h:2": 0x60C1_0120})
    for cycle, position in enumerate((50, 120, 90)):
        bench.send(0x400 + NODE, struct.pack("<Hi", 0x1F, position))
        bench.sync()
        assert every(bench, 10, 1) != [position] or cycle == 0
        bench.run(1 * MS)
        assert bench.truth("demand_inc") == position


def test_without_sync_the_drive_keeps_time_itself():
    bench = interpolating(word=0x0F)
    for position in (100, 200, 300):
        record(bench, position)
    bench.run_until((bench.now // MS + 1) * MS)
    bench.controlword(0x1F)
    assert every(bench, 1, 32)[::8] == [0, 80, 160, 240]
    bench.run(50 * MS)
    assert bench.truth("demand_inc") == 300
    record(bench, 400)  # a waiting drive continues with the next record
    bench.run(20 * MS)
    assert bench.truth("demand_inc") == 400


def test_bit_12_follows_bit_4_and_bit_10_the_buffer_end():
    bench = interpolating(word=0x0F)
    assert bench.statusword() & (ACTIVE | REACHED) == 0
    record(bench, 500)
    record(bench, 600)
    bench.controlword(0x1F)
    bench.run(5 * MS)
    assert bench.statusword() & (ACTIVE | REACHED) == ACTIVE
    bench.run(200 * MS)
    assert bench.statusword() & (ACTIVE | REACHED) == ACTIVE | REACHED
    bench.controlword(0x0F)
    assert bench.statusword() & ACTIVE == 0


def test_buffer_is_kept_without_bit_4_and_under_halt():
    bench = interpolating(word=0x0F)
    record(bench, 100)
    record(bench, 400)
    bench.sync()
    bench.run(50 * MS)
    assert bench.truth("demand_inc") == 0
    bench.controlword(0x1F)
    bench.sync()
    bench.run(5 * MS)
    bench.controlword(0x11F)
    bench.run(500 * MS)
    stood = bench.truth("demand_inc")
    assert 0 < stood < 400
    assert bench.statusword() & (ACTIVE | REACHED) == REACHED
    bench.controlword(0x1F)
    bench.sync()
    bench.run(20 * MS)
    assert bench.truth("demand_inc") == 400


def test_full_buffer_rejects_and_ring_drops_the_oldest():
    bench = interpolating(word=0x0F)
    bench.set(0x60C4, 2, 2, 4)
    assert [record(bench, p) for p in (10, 20, 30)] == [0, 0, FULL]
    assert bench.read(0x60C4, 4) == 2
    bench.set(0x60C4, 3, 1, 1)
    assert record(bench, 30) == 0
    bench.controlword(0x1F)
    bench.run(15 * MS)
    assert 20 < bench.truth("demand_inc") < 30  # from 20 to 30: 10 was the oldest


def test_60c4h_6_clears_and_disables_the_buffer():
    bench = interpolating(word=0x0F)
    record(bench, 10)
    bench.set(0x60C4, 6, 0, 1)
    assert bench.read(0x60C4, 4) == 0
    assert record(bench, 20) == FULL
    bench.set(0x60C4, 6, 1, 1)
    assert record(bench, 30) == 0


@pytest.mark.parametrize(("index", "value", "size"), [(0x60C0, -1, 2), (0x60C0, 1, 2)])
def test_values_without_behaviour_are_rejected(index, value, size):
    bench = interpolating()
    assert bench.write(index, 0, value, size) == 0x0609_0030


def test_missing_sync_is_a_fault_in_ip():
    bench = interpolating(cyclic={"sync_lost_periods": 3})
    bench.sync()
    bench.run(30 * MS - 1)
    assert bench.truth("state") == PdsState.OPERATION_ENABLED
    bench.run(1)
    assert bench.truth("state") != PdsState.OPERATION_ENABLED
