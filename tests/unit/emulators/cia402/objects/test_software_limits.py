"""Software limits 607Dh in modes without position control: pv, tq, csv, cst.

Source: Danfoss, VLT servo drive ISD, programming guide MG36D1, object 607Dh. In these modes the
drive brakes with the quick stop deceleration when it passes the limit, and thus stops beyond it.
Yaskawa, Sigma-7 manual, 607Dh: a minimum not below the maximum means no limits.
"""

import struct

import pytest

from tests.support.cia402.bench import MS, NODE, Bench
from tests.support.cia402.homing_bench import DONE, Track, bench_on, home

LIMIT = 0x0800
PV, TQ, CSV, CST = 3, 4, 9, 10
QUICK = 1_000_000  # inc/s^2
NOWHERE = Track(negative=None, positive=None, home=None)


def count(bench: Bench) -> int:
    bench.truth("position_rad")
    return bench.drive.axis.count()


def bench_in(mode: int, low: int = -4_000, high: int = 4_000) -> Bench:
    bench = bench_on(NOWHERE, o6085=QUICK, o6084=20_000)
    bench.set(0x607D, 1, low, 4)
    bench.set(0x607D, 2, high, 4)
    bench.set(0x6060, 0, mode, 1)
    bench.run(20 * MS)
    return bench


def command(bench: Bench, mode: int, way: int) -> None:
    if mode in (PV, CSV):
        bench.set(0x60FF, 0, way * 40_000, 4)
    else:
        bench.set(0x6071, 0, way * 40, 2)


@pytest.mark.parametrize("way", [-1, 1])
@pytest.mark.parametrize("mode", [PV, TQ, CSV, CST])
def test_axis_passing_a_limit_is_braked_and_may_return(mode, way):
    bench = bench_in(mode)
    errors = bench.times(0x080 + NODE)
    command(bench, mode, way)
    while abs(count(bench)) <= 4_000:
        assert not bench.statusword() & LIMIT
        bench.run(MS)
    speed = abs(bench.drive.axis.velocity_inc_s())
    bench.run(MS)
    assert bench.statusword() & LIMIT
    bench.run(500 * MS)
    stood = count(bench)
    braking = speed * speed / 2 / QUICK
    assert 4_000 < way * stood < 4_000 + 1.3 * braking + 2 * speed / 1_000
    assert bench.drive.axis.velocity_inc_s() == pytest.approx(0, abs=600)
    assert bench.statusword() & LIMIT
    command(bench, mode, way)  # again, towards the limit
    bench.run(300 * MS)
    assert count(bench) == pytest.approx(stood, abs=20)
    command(bench, mode, -way)
    bench.run_while(lambda: bench.statusword() & LIMIT)
    assert way * count(bench) <= 4_000  # cleared at the tick at which the axis is inside again
    bench.run(100 * MS)
    assert bench.truth("state") == 4
    assert way * count(bench) < 3_900
    assert bench.times(0x080 + NODE) == errors  # this is not a fault


def test_limit_itself_is_allowed_and_one_increment_is_not():
    bench = bench_in(PV, -4_000, 40)
    bench.set(0x60FF, 0, 500, 4)
    seen = []
    for _ in range(200):
        bench.run(MS)
        word = bench.statusword()
        seen.append((count(bench), bool(word & LIMIT)))
    assert {place for place, _ in seen} >= {39, 40, 41}
    assert all(limited == (place > 40) for place, limited in seen)


def test_load_dragging_the_motor_beyond_a_limit_is_held():
    bench = bench_in(TQ)
    bench.set(0x6071, 0, 5, 2)
    bench.drive.stimulate("load_torque_n_m", 3.0, bench.now)
    bench.run_while(lambda: count(bench) > -4_000)
    bench.run(2_000 * MS)
    stood = count(bench)
    bench.run(500 * MS)
    assert count(bench) == pytest.approx(stood, abs=3)


@pytest.mark.parametrize(("low", "high"), [(0, 0), (4_000, -4_000), (500, 500)])
def test_minimum_not_below_maximum_is_no_limit(low, high):
    bench = bench_in(PV, low, high)
    assert not bench.drive._power_drive.inputs.is_gated
    command(bench, PV, 1)
    bench.run(500 * MS)
    assert count(bench) > 10_000
    assert not bench.statusword() & LIMIT


@pytest.mark.parametrize("mode", [1, 6, 7, 8])
def test_modes_with_position_control_are_not_gated(mode):
    bench = bench_in(mode)
    assert not bench.drive._power_drive.inputs.is_gated


def test_limits_count_from_home_whatever_its_position():
    bench = bench_on(NOWHERE, o6085=QUICK, o6098=37, o607C=-3_000)
    assert home(bench) == DONE
    bench.set(0x607D, 1, -4_000, 4)
    bench.set(0x607D, 2, 4_000, 4)
    bench.set(0x6060, 0, PV, 1)
    bench.run(20 * MS)
    named = bench.read(0x6064) - count(bench)
    assert abs(named) > 2_900
    command(bench, PV, 1)
    bench.run_while(lambda: not bench.statusword() & LIMIT)
    bench.run(500 * MS)
    home_called = 3_000
    assert 4_000 < bench.read(0x6064) - home_called < 5_000


def test_wider_limits_release_and_narrower_ones_stop():
    bench = bench_in(PV)
    command(bench, PV, 1)
    bench.run(500 * MS)
    assert bench.statusword() & LIMIT
    bench.set(0x607D, 2, 100_000, 4)
    assert not bench.statusword() & LIMIT
    command(bench, PV, 1)
    bench.run(300 * MS)
    beyond = count(bench)
    assert beyond > 8_000
    bench.set(0x607D, 2, 6_000, 4)
    assert bench.statusword() & LIMIT
    bench.run(300 * MS)
    assert beyond < count(bench) < beyond + 1_200
    bench.set(0x6060, 0, 1, 1)  # pp looks at its targets alone
    bench.run(20 * MS)
    assert not bench.statusword() & LIMIT


def test_polarity_inverts_the_limits():
    bench = bench_in(PV, -4_000, 6_000)
    bench.set(0x60FF, 0, 0, 4)
    bench.set(0x607E, 0, 0xC0, 1)
    command(bench, PV, 1)
    bench.run(600 * MS)
    assert 6_000 < bench.read(0x6064) < 7_200
    assert bench.statusword() & LIMIT


def test_repeated_set_points_beyond_a_limit_do_not_move():
    bench = bench_in(CSV)
    for _ in range(600):
        bench.send(0x500 + NODE, struct.pack("<Hi", 0x0F, 40_000))
        bench.sync()
        bench.run(MS)
    stood = count(bench)
    assert 4_000 < stood < 5_200
    for _ in range(200):
        bench.send(0x500 + NODE, struct.pack("<Hi", 0x0F, 40_000))
        bench.sync()
        bench.run(MS)
    assert count(bench) == pytest.approx(stood, abs=5)


@pytest.mark.parametrize("polarity", [0, 0x80])
@pytest.mark.parametrize(("target", "arrives"), [(9_000, 3_000), (-9_000, -5_000), (2_999, 2_999)])
def test_limits_and_zero_include_the_home_offset(target, arrives, polarity):
    """Check Elmo's DSP 402 guide, 607Dh: the effective limit is 607Dh minus the home offset."""
    bench = bench_on(NOWHERE, o6098=37, o607C=1_000, o607E=polarity)
    assert home(bench) == DONE
    assert bench.read(0x6064) == -1_000
    bench.controlword(0x0F)
    bench.set(0x607D, 1, -4_000, 4)
    bench.set(0x607D, 2, 4_000, 4)
    bench.set(0x6060, 0, 1, 1)
    bench.set(0x607A, 0, target, 4)
    bench.controlword(0x1F)
    assert bench.statusword() & LIMIT == (LIMIT if arrives != target else 0)
    bench.run(2_000 * MS)
    assert bench.read(0x6062) == arrives


def test_home_offset_moves_the_limits_of_other_modes():
    bench = bench_in(PV)
    bench.set(0x607C, 0, 1_000, 4)
    command(bench, PV, 1)
    while not bench.statusword() & LIMIT:
        bench.run(MS)
    assert 3_000 < count(bench) < 3_000 + 40 * 8  # some ms at 40 inc/ms, with three SDOs each
