"""Cyclic synchronous position: targets at SYNC, linear in between. CiA 402-2, csp."""

import struct
from itertools import pairwise

import pytest

from tests.support.cia402.bench import MS, NODE, Bench

FOLLOWS = 0x1000
FOLLOWING_ERROR = 0x2000


def target(bench: Bench, position: int, word: int = 0x0F) -> None:
    """Send 607Ah in RPDO 3 (6040h, 607Ah)."""
    bench.send(0x400 + NODE, struct.pack("<Hi", word, position))


@pytest.fixture
def bench() -> Bench:
    """Return a bench with RPDO 3 synchronous (type 1), in csp, enabled."""
    bench = Bench(
        objects={"1402h:2": 1, "6065h": 0xFFFF_FFFF},
        plant={"preset": "wheel_60w", "load_inertia_kg_m2": 0.0},
    )
    bench.enable(mode=8)
    bench.run(10 * MS)
    return bench


def test_target_takes_effect_at_sync_and_not_before(bench):
    target(bench, 100)
    bench.run(5 * MS)
    assert bench.truth("demand_inc") == 0
    bench.sync()
    bench.run(2 * MS)
    assert bench.truth("demand_inc") == 100


def test_demand_is_linear_over_the_sync_period(bench):
    for cycle in range(5):
        target(bench, 40 * cycle)
        bench.sync()
        demands = []
        for _ in range(4):
            bench.run(1 * MS)
            demands.append(bench.truth("demand_inc"))
        if cycle >= 2:  # the period is known from the second SYNC on
            start = 40 * (cycle - 1)
            # a profile begins at the tick after the command, and ends where the next begins
            assert demands == [start, start + 10, start + 20, start + 30]


def test_demand_is_linear_over_60c2h(bench):
    bench.set(0x60C2, 1, 8, 1)
    target(bench, 80)
    bench.sync()
    demands = []
    for _ in range(10):
        bench.run(1 * MS)
        demands.append(bench.truth("demand_inc"))
    assert demands == [0, 10, 20, 30, 40, 50, 60, 70, 80, 80]


@pytest.mark.parametrize(
    ("value", "exponent", "ns"), [(1, -3, MS), (50, -4, 5 * MS), (3, -2, 30 * MS)]
)
def test_60c2h_is_value_times_a_power_of_ten(bench, value, exponent, ns):
    bench.set(0x60C2, 1, value, 1)
    bench.set(0x60C2, 2, exponent, 1)
    target(bench, 200)
    bench.sync()
    begins = (bench.now // MS + 1) * MS
    bench.run_until(begins + ns - 1)
    assert bench.truth("demand_inc") < 200
    bench.run_until(begins + ns)
    assert bench.truth("demand_inc") == 200


def test_sync_jitter_does_not_change_the_period(bench):
    times = [0, 4.1, 8.0, 12.2, 16.1, 20.0]  # intervals of 4.1, 3.9, 4.2, 3.9, 3.9 ms
    start = bench.now
    for cycle, offset in enumerate(times):
        bench.run_until(start + round(offset * MS))
        target(bench, 40 * cycle)
        bench.sync()
    bench.run_until(start + 23 * MS)
    assert bench.truth("demand_inc") == 180  # half way after 2 of 4 ticks


def test_statusword_shows_command_following(bench):
    assert bench.statusword() & FOLLOWS
    target(bench, 0, word=0x010F)
    bench.sync()
    assert not bench.statusword() & FOLLOWS  # halt
    target(bench, 500, word=0x010F)
    bench.sync()
    bench.run(20 * MS)
    assert bench.truth("demand_inc") == 0
    target(bench, 500)
    bench.sync()
    assert bench.statusword() & FOLLOWS
    target(bench, 500)
    bench.sync()
    bench.run(30 * MS)
    assert bench.truth("demand_inc") == 500


def test_target_reached_bit_is_not_used(bench):
    target(bench, 10)
    bench.sync()
    bench.run(100 * MS)
    assert not bench.statusword() & 0x0400


def test_enabling_does_not_jump_to_an_old_target():
    bench = Bench(objects={"607Ah": 5000})
    bench.enable(mode=8)
    bench.run(100 * MS)
    assert bench.truth("position_inc") == 0


def test_software_limits_limit_the_demand(bench):
    bench.set(0x607D, 1, -100, 4)
    bench.set(0x607D, 2, 100, 4)
    target(bench, 150)
    bench.sync()
    bench.run(50 * MS)
    assert bench.truth("demand_inc") == 100
    word = bench.statusword()
    assert word & 0x0800  # internal limit active
    assert not word & FOLLOWS  # the drive does not follow the target


def test_jump_too_large_to_follow_is_a_following_error():
    bench = Bench(objects={"1402h:2": 1, "6065h": 500, "6066h": 5})
    bench.enable(mode=8)
    target(bench, 30_000)
    bench.sync()
    bench.run(50 * MS)
    assert bench.last(0x085)[:3] == bytes.fromhex("118621")


@pytest.mark.parametrize("by", [0x607F, 0x6080])
def test_target_too_fast_is_limited_by_607fh_and_6080h(bench, by):
    """Check that the demand catches up later, as in ABB's ACSM1 in synchron control."""
    rpm_inc_s = bench.drive.settings.plant.encoder_increments_rev / 60
    bench.set(by, 0, 20_000 if by == 0x607F else round(20_000 / rpm_inc_s), 4)
    most = 20.5  # inc in a tick, with a tolerance of one rpm
    target(bench, 300)  # within a tick
    bench.sync()
    demands = [0.0]
    for _ in range(10):
        bench.run(1 * MS)
        demands.append(bench.truth("demand_inc"))
    assert bench.statusword() & (0x0800 | FOLLOWS) == 0x0800
    assert demands[-1] == pytest.approx(9 * 20, abs=5)
    steps = [after - before for before, after in pairwise(demands)]
    assert all(0 <= step <= most + 1 for step in steps)
    bench.run(10 * MS)
    assert bench.truth("demand_inc") == 300
    target(bench, 320)
    bench.sync()
    bench.run(25 * MS)
    assert bench.truth("demand_inc") == 320
    assert bench.statusword() & (0x0800 | FOLLOWS) == FOLLOWS


def test_set_point_at_the_speed_limit_is_not_limited(bench):
    bench.set(0x607F, 0, 20_000, 4)
    for cycle in range(20):
        target(bench, 80 * cycle)
        bench.sync()
        bench.run(4 * MS)
        assert not bench.statusword() & 0x0800 or cycle < 3  # until the period is known
    assert bench.truth("demand_inc") == pytest.approx(80 * 19, abs=81)


@pytest.mark.parametrize("way", [-1, 1])
@pytest.mark.parametrize("option", [1, 2])
@pytest.mark.parametrize("ticks", [1, 7, 14, 15, 40])
def test_halt_after_a_jump_ends_within_software_limits(bench, way, option, ticks):
    bench.set(0x605D, 0, option, 2)
    bench.set(0x607D, 1, -4_000, 4)
    bench.set(0x607D, 2, 4_000, 4)
    bench.set(0x6084, 0, 1_000_000, 4)
    target(bench, way * 20_000)
    bench.sync()
    bench.run(ticks * MS)
    target(bench, way * 20_000, word=0x010F)
    bench.sync()
    for _ in range(200):
        bench.run(1 * MS)
        assert way * bench.truth("demand_inc") <= 4_000
    assert way * bench.truth("demand_inc") == pytest.approx(4_000, abs=1)
    before = bench.truth("demand_inc")
    bench.run(50 * MS)
    assert bench.truth("demand_inc") == before
