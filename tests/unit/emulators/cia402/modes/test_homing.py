"""Homing on the present position (35, 37). Statusword & 3400h: p402.py's Homing.STATES.

For homing over switches and index pulse see test_homing_methods.
"""

import pytest
from canopen.profiles.p402 import Homing

from tests.support.cia402.bench import MS, Bench

IN_PROGRESS, INTERRUPTED, DONE = 0x0000, 0x0400, 0x1400
ERROR_MOVING, ERROR_AT_REST = 0x2000, 0x2400


def homing(bench: Bench) -> int:
    return bench.statusword() & 0x3400


@pytest.fixture
def bench() -> Bench:
    """Return a bench standing at 5000 increments, in hm."""
    bench = Bench()
    bench.enable(mode=1)
    bench.set(0x607A, 0, 5_000, 4)
    bench.controlword(0x1F)
    bench.controlword(0x0F)
    bench.run(1000 * MS)
    bench.set(0x6060, 0, 6, 1)
    bench.run(50 * MS)
    return bench


def test_status_bits_match_the_canopen_table():
    table = {name: bits for name, (_, bits) in Homing.STATES.items()}
    assert table["IN PROGRESS"] == IN_PROGRESS
    assert table["INTERRUPTED"] == INTERRUPTED
    assert table["TARGET REACHED"] == DONE
    assert table["ERROR VELOCITY IS NOT ZERO"] == ERROR_MOVING
    assert table["ERROR VELOCITY IS ZERO"] == ERROR_AT_REST


@pytest.mark.parametrize("method", [35, 37])
def test_present_position_becomes_zero_a_tick_later(bench, method):
    bench.set(0x6098, 0, method, 1)
    assert homing(bench) == INTERRUPTED  # not started
    assert bench.truth("position_inc") == pytest.approx(5_000, abs=10)
    where = bench.truth("position_rad")
    count = len(bench.sent)
    at = bench.now
    bench.controlword(0x1F)
    assert bench.hex_since(count)[0] == "185#3702"  # in progress
    due = (at // MS + 1) * MS
    bench.run_until(due - 1)
    assert bench.truth("position_inc") != 0
    bench.run_until(due)
    assert bench.truth("position_inc") == 0
    assert homing(bench) == DONE
    bench.run(500 * MS)
    assert bench.truth("position_rad") == pytest.approx(where, abs=1e-3)  # the motor has not moved
    bench.controlword(0x0F)
    assert homing(bench) == DONE


def test_zero_is_home_plus_the_home_offset(bench):
    """Check CiA 402-2, 607Ch: zero is home plus the offset; home's position is minus the offset.

    Mitsubishi's MR-J5 gives it in numbers: the position of home (Pr. PT08) is -607Ch.
    """
    bench.set(0x607C, 0, -1234, 4)
    bench.controlword(0x1F)
    bench.run(5 * MS)
    assert bench.read(0x6064) == 1234


def test_moves_after_homing_count_from_the_new_zero(bench):
    bench.controlword(0x1F)
    bench.run(5 * MS)
    bench.controlword(0x0F)
    before = bench.truth("position_rad")
    bench.set(0x6060, 0, 1, 1)
    bench.set(0x607A, 0, 1_000, 4)
    bench.controlword(0x1F)
    bench.run(1000 * MS)
    assert bench.truth("demand_inc") == 1_000
    turned = (bench.truth("position_rad") - before) / 6.283185307179586 * 66 * 2000
    assert turned == pytest.approx(1_000, abs=15)


def test_second_homing_needs_an_edge(bench):
    bench.controlword(0x1F)
    bench.run(5 * MS)
    bench.set(0x607C, 0, 77, 4)
    bench.controlword(0x1F)  # a level, not an edge
    bench.run(5 * MS)
    assert bench.read(0x6064) == 0
    bench.controlword(0x0F)
    bench.controlword(0x1F)
    bench.run(5 * MS)
    assert bench.read(0x6064) == -77


def test_clearing_bit_4_interrupts_homing(bench):
    bench.controlword(0x1F)
    bench.controlword(0x0F)
    assert homing(bench) == INTERRUPTED
    bench.run(100 * MS)
    assert homing(bench) == INTERRUPTED
    assert bench.read(0x6064) != 0


def test_halt_interrupts_homing(bench):
    bench.controlword(0x1F)
    bench.controlword(0x011F)
    bench.run(100 * MS)
    assert homing(bench) == INTERRUPTED


def test_methods_without_behaviour_are_rejected(bench):
    for method in (15, 16, 31, 32, 36, -1):
        assert bench.write(0x6098, 0, method, 1) == 0x0609_0030
    assert bench.read(0x6098) == 37
    assert bench.write(0x6098, 0, 0, 1) == 0


@pytest.mark.parametrize("method", [0, 36])  # 0, no method: the default of 8 of 17 vendors' files
def test_method_from_the_file_fails_as_a_homing_error(method):
    bench = Bench(objects={"6098h": method})
    bench.enable(mode=6)
    bench.run(10 * MS)
    bench.controlword(0x1F)
    assert homing(bench) == ERROR_AT_REST
    bench.set(0x6098, 0, 35, 1)
    bench.controlword(0x0F)
    bench.controlword(0x1F)
    bench.run(5 * MS)
    assert homing(bench) == DONE


def test_homing_of_a_moving_axis_fails():
    bench = Bench()
    bench.enable(mode=3)
    bench.set(0x60FF, 0, 30_000, 4)
    bench.run(300 * MS)
    bench.set(0x6060, 0, 6, 1)
    bench.controlword(0x1F)
    assert homing(bench) == ERROR_MOVING
    bench.run(300 * MS)
    assert homing(bench) == ERROR_AT_REST


def test_mode_and_start_in_one_pdo_start_homing(bench):
    bench.set(0x6060, 0, 1, 1)
    bench.run(50 * MS)
    bench.send(0x305, bytes.fromhex("1F0006"))  # RPDO 2: 6040h, 6060h
    bench.run(5 * MS)
    assert homing(bench) == DONE


def test_homing_attained_survives_mode_change_and_power_off(bench):
    bench.controlword(0x1F)
    bench.run(5 * MS)
    bench.set(0x6060, 0, 1, 1)
    bench.set(0x6060, 0, 6, 1)
    assert homing(bench) == DONE
    bench.controlword(0x06)
    bench.run(50 * MS)
    assert homing(bench) == DONE
    bench.nmt(0x81)
    bench.run(500 * MS)
    assert homing(bench) == 0
