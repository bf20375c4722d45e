"""A PR-mode drive, tested through its registers; positions and times computed here.

Source: drives.md 7.1 A (agreement of several public drivers).
"""

from math import pi
from pathlib import Path

import pytest

from motorhil.emulators.controller import ControllerContext, SettingError
from motorhil.emulators.leadshine_pr.drive import build
from motorhil.emulators.modbus.rtu import with_crc
from tests.support.modbus.bench import ModbusBench, Refused

STATUS, TRIGGER, FEEDBACK, ALARM, CONTROL = 0x1003, 0x6002, 0x1014, 0x2203, 0x1801
PATH0 = 0x6200
ABSOLUTE, RELATIVE, VELOCITY = 0x0001, 0x0041, 0x0002
GEAR = 66.0  # of the plant preset


@pytest.fixture
def bench():
    return ModbusBench(build)


def path(bench, mode, position=0, rpm=600, ms=50, dwell=0, number=0):
    at = PATH0 + 8 * number
    bench.write(at, mode, position >> 16, position, rpm, ms, ms, dwell, 0)


def enable(bench):
    bench.write(0x000F, 1)


def test_drive_is_at_rest_without_current_until_enabled(bench):
    assert bench.read(STATUS) == 0x0030
    assert bench.truth()["current_a"] == 0.0
    enable(bench)
    assert bench.read(STATUS) == 0x0032  # as in the field


@pytest.mark.parametrize("target", [20_000, -35_000])
def test_absolute_path_ends_at_target(bench, target):
    enable(bench)
    path(bench, ABSOLUTE, target)
    bench.write(TRIGGER, 0x10)
    assert bench.read(STATUS) == 0x0006  # enabled, running: as in the field
    assert bench.read(TRIGGER) == 0x100
    bench.run_ms(1000)
    assert bench.read(STATUS) == 0x0032
    assert bench.read(FEEDBACK, 2) == pytest.approx(target, abs=30)  # an increment is 5 pulses
    assert bench.read(0x602C, 2) == target
    expected_rad = target / 10_000 * 2 * pi / GEAR
    assert bench.truth()["position_rad"] == pytest.approx(expected_rad, abs=0.001)


def test_path_takes_time_of_its_trapezoid(bench):
    enable(bench)
    # 600 rpm = 10 rev/s, 100 ms per 1000 rpm: a ramp of 60 ms, and 3 revolutions in total
    path(bench, ABSOLUTE, 30_000, rpm=600, ms=100)
    begun_ns = bench.world.queue.now_ns
    bench.write(TRIGGER, 0x10)
    bench.run_ms(300 + 60 - 22)  # 3 rev / 10 rev/s + one ramp; the request took 20 ms
    assert bench.truth()["demand_inc"] < 6000
    bench.run_ms(6)
    assert bench.truth()["demand_inc"] == 6000
    assert bench.world.queue.now_ns - begun_ns < 400_000_000


def test_relative_path_moves_by_distance_at_each_trigger(bench):
    enable(bench)
    path(bench, RELATIVE, 5_000)
    for count in (1, 2, 3):
        bench.write(TRIGGER, 0x10)
        bench.run_ms(700)
        assert bench.read(0x602C, 2) == 5_000 * count


def test_one_request_sets_and_starts_motion(bench):
    enable(bench)
    bench.write(PATH0, ABSOLUTE, 0, 10_000, 600, 50, 50, 0, 0x10)
    bench.run_ms(700)
    assert bench.read(0x602C, 2) == 10_000


def test_path_uses_registers_at_trigger(bench):
    enable(bench)
    path(bench, ABSOLUTE, 10_000)
    bench.write(TRIGGER, 0x10)
    path(bench, ABSOLUTE, 90_000)
    bench.run_ms(700)
    assert bench.read(0x602C, 2) == 10_000


def test_velocity_path_runs_until_stopped(bench):
    enable(bench)
    path(bench, VELOCITY, rpm=-300, ms=20)
    bench.write(TRIGGER, 0x10)
    bench.run_ms(300)
    assert bench.read(0x1046, 2) == pytest.approx(-300, abs=16)
    assert bench.read(STATUS) == 0x0016  # at its speed, and running
    bench.write(TRIGGER, 0x40)
    bench.run_ms(300)
    assert bench.read(STATUS) == 0x0032
    assert bench.truth()["velocity_rad_s"] == 0.0


def test_quick_stop_is_faster_than_path_deceleration(bench):
    enable(bench)
    path(bench, ABSOLUTE, 100_000, rpm=1200, ms=500)
    bench.write(TRIGGER, 0x10)
    bench.run_ms(700)
    before = bench.truth()["demand_inc"]
    bench.write(TRIGGER, 0x40)
    bench.run_ms(100)
    assert bench.read(STATUS) == 0x0032
    assert bench.truth()["demand_inc"] - before < 20 * 2000 * 0.06  # not its own 600 ms ramp


def test_path_waits_for_running_one_unless_it_interrupts(bench):
    enable(bench)
    path(bench, ABSOLUTE, 30_000)
    path(bench, ABSOLUTE, 0, number=1)
    bench.write(TRIGGER, 0x10)
    bench.write(TRIGGER, 0x11)
    bench.run_ms(270)
    assert bench.truth()["demand_inc"] > 5500
    bench.run_ms(1000)
    assert bench.read(0x602C, 2) == 0
    path(bench, ABSOLUTE | 0x10, 0, number=1)
    bench.write(TRIGGER, 0x10)
    bench.write(TRIGGER, 0x11)
    assert bench.truth()["path"] == 1
    bench.run_ms(1000)
    assert bench.read(0x602C, 2) == 0
    assert bench.truth()["path"] == -1


def test_jumping_paths_follow_after_dwell(bench):
    enable(bench)
    path(bench, ABSOLUTE | 0x4000 | 2 << 8, 10_000, dwell=200)
    path(bench, RELATIVE, 2_000, number=2)
    bench.write(TRIGGER, 0x10)
    bench.run_ms(220)
    assert bench.read(STATUS) == 0x0016  # the command is done, the path dwells
    bench.run_ms(1000)
    assert bench.read(0x602C, 2) == 12_000


def test_paths_without_motion_in_a_circle_end_with_warning(bench):
    enable(bench)
    path(bench, 0x4000 | 1 << 8, 0)
    path(bench, 0x4000, 0, number=1)
    bench.write(TRIGGER, 0x10)
    assert bench.told() == ["paths without a motion jump in a circle; the last one ends"]
    assert bench.truth()["path"] == -1
    path(bench, ABSOLUTE, 10_000, number=2)
    bench.write(TRIGGER, 0x12)
    bench.run_ms(700)
    assert bench.read(0x602C, 2) == 10_000


def test_trigger_without_current_is_ignored_and_reported(bench):
    path(bench, ABSOLUTE, 10_000)
    bench.write(TRIGGER, 0x10)
    bench.run_ms(500)
    assert bench.read(0x602C, 2) == 0
    assert "trigger 010h ignored: the motor is not enabled" in bench.told()


def test_direction_register_reverses_motion(bench):
    bench.write(0x0007, 1)
    enable(bench)
    path(bench, ABSOLUTE, 10_000)
    bench.write(TRIGGER, 0x10)
    bench.run_ms(700)
    assert bench.read(0x602C, 2) == 10_000
    assert bench.truth()["position_rad"] < -0.09


def test_pulses_per_revolution_scale_positions(bench):
    bench.write(0x0001, 2000)
    enable(bench)
    path(bench, ABSOLUTE, 2000)
    bench.write(TRIGGER, 0x10)
    bench.run_ms(700)
    assert bench.truth()["demand_inc"] == 2000
    assert bench.read(0x602C, 2) == 2000


@pytest.mark.parametrize("way", [0x4001, 0x4002])
def test_jog_lasts_while_it_is_repeated(bench, way):
    enable(bench)
    for _ in range(5):
        bench.write(CONTROL, way)  # every 20 ms
    assert bench.read(STATUS) & 0x0004
    bench.run_ms(100)
    assert bench.read(STATUS) == 0x0032
    moved = bench.truth()["demand_inc"]
    assert moved > 50 if way == 0x4001 else moved < -50


SWITCHES = {"switches": {"home_rad": 0.3, "limit_forward_rad": 0.5, "limit_backward_rad": -0.4}}


@pytest.mark.parametrize(("mode", "edge_rad"), [(0x0005, 0.3), (0x0001, 0.5), (0x0000, -0.4)])
def test_homing_finds_switch_edge_and_sets_its_position(mode, edge_rad):
    bench = ModbusBench(build, SWITCHES)
    enable(bench)
    bench.write(0x600A, mode)
    bench.write_32(0x600B, 1234)
    bench.write(TRIGGER, 0x20)
    bench.run_ms(100)
    assert not bench.read(STATUS) & 0x0040
    bench.run_ms(4000)
    assert bench.read(STATUS) == 0x0072
    truth = bench.truth()
    edge = 1234 + (truth["position_rad"] - edge_rad) / (2 * pi) * GEAR * 10_000
    assert bench.read(FEEDBACK, 2) == pytest.approx(edge, abs=20)  # a tick at 50 rpm is 8 pulses


def test_homing_may_begin_on_switch():
    bench = ModbusBench(build, {**SWITCHES, "initial_position_rad": 0.35})
    enable(bench)
    bench.write(0x600A, 0x0005)
    bench.write(TRIGGER, 0x20)
    bench.run_ms(100)
    assert bench.truth()["position_rad"] < 0.35  # it has moved backwards at once
    bench.run_ms(4000)
    assert bench.read(STATUS) == 0x0072
    assert bench.truth()["position_rad"] < 0.3


def test_limit_switch_stops_motion_into_it():
    bench = ModbusBench(build, SWITCHES)
    enable(bench)
    path(bench, ABSOLUTE, 300_000)
    bench.write(TRIGGER, 0x10)
    bench.run_ms(3000)
    assert bench.truth()["position_rad"] == pytest.approx(0.5, abs=0.02)
    assert bench.told() == ["stopped at the forward limit switch"]
    path(bench, ABSOLUTE, 0)
    bench.write(TRIGGER, 0x10)  # moving back is allowed
    bench.run_ms(3000)
    assert bench.read(0x602C, 2) == 0


def test_present_position_may_be_set_to_zero(bench):
    enable(bench)
    path(bench, ABSOLUTE, 10_000)
    bench.write(TRIGGER, 0x10)
    bench.run_ms(700)
    bench.write(TRIGGER, 0x21)
    assert abs(bench.read(FEEDBACK, 2)) < 10
    assert bench.read(STATUS) == 0x0072


def test_alarm_removes_current_until_reset(bench):
    enable(bench)
    bench.stimulate("alarm", 0x01)
    assert bench.read(ALARM) == 0x01
    assert bench.read(STATUS) == 0x0031
    path(bench, ABSOLUTE, 10_000)
    bench.write(TRIGGER, 0x10)
    bench.run_ms(300)
    assert bench.read(0x602C, 2) == bench.read(FEEDBACK, 2) != 10_000
    bench.write(CONTROL, 0x1111)
    assert bench.read(STATUS) == 0x0032
    assert bench.told()[-1] == "alarm reset"


def test_excessive_load_causes_following_error(bench):
    enable(bench)
    bench.stimulate("load_torque_n_m", 40.0)
    path(bench, ABSOLUTE, 100_000, rpm=3000)
    bench.write(TRIGGER, 0x10)
    bench.run_ms(2000)
    assert bench.read(ALARM) == 0x20
    assert bench.read(STATUS) & 0x0003 == 0x0001


def test_saved_parameters_survive_power_cycle(bench):
    bench.write(0x0001, 4000)
    bench.write(CONTROL, 0x2211)
    bench.write(0x0001, 8000)
    bench.stimulate("power", 0)
    bench.run_ms(100)
    bench.stimulate("power", 1)
    bench.run_ms(600)
    assert bench.read(0x0001) == 4000
    bench.write(CONTROL, 0x2222)
    bench.stimulate("power", 0)
    bench.stimulate("power", 1)
    bench.run_ms(600)
    assert bench.read(0x0001) == 10_000


def test_power_up_ends_listen_only_and_clears_counters(bench):
    """Source: MODBUS Application Protocol V1.1b3, 6.8.1, sub-functions 04 and 11."""
    with pytest.raises(ValueError, match="not enough values"):
        bench.ask("08 0004 0000")
    with pytest.raises(ValueError, match="not enough values"):
        bench.read(STATUS)
    bench.stimulate("power", 0)
    bench.stimulate("power", 1)
    bench.run_ms(600)
    bench.read(STATUS)
    assert bench.ask("08 000B 0000") == bytes.fromhex("08 000B 0002")


def test_unpowered_drive_is_silent(bench):
    bench.stimulate("power", 0)
    with pytest.raises(ValueError, match="not enough values"):
        bench.read(STATUS)


@pytest.mark.parametrize(
    ("pdu", "code"),
    [
        ("06 1003 0001", "02h"),  # read-only
        ("03 1801 0001", "02h"),  # write-only
        ("06 0001 0001", "03h"),  # out of range
        ("03 0000 0001", "02h"),
        ("01 0000 0001", "01h"),  # no coils
        ("17 0001 0001 0001 0001 02 0001", "01h"),
    ],
)
def test_unsupported_request_is_refused(bench, pdu, code):
    with pytest.raises(Refused, match=code):
        bench.ask(pdu)


def test_register_map_has_vendor_addresses():
    rows = {row.name: row for row in build.registers()}
    assert rows["path15_special"].address == 0x627F
    assert rows["path3_position"].address == 0x6219
    assert rows["input2_function"].address == 0x0149
    assert all(row.behaviour or row.unit or row.name for row in rows.values())


@pytest.mark.parametrize(
    ("table", "place"),
    [
        ({"unit": 0}, ("unit",)),
        ({"units": 1}, ("units",)),
        ({"registers": {"6300h": 1}}, ("registers", "6300h")),
        ({"registers": {"peak_current": 9999}}, ("registers", "peak_current")),
        ({"switches": {"home": 1}}, ("switches", "home")),
        ({"timing": {"reply_s": -1}}, ("timing", "reply_s")),
    ],
)
def test_wrong_setting_is_refused_with_its_keys(table, place):
    with pytest.raises(SettingError) as caught:
        ModbusBench(build, table)
    assert caught.value.path == place


def test_rig_sets_registers_by_name_or_address():
    bench = ModbusBench(build, {"registers": {"force_enable": 1, "0001h": 5000}})
    assert bench.read(STATUS) == 0x0032
    assert bench.read(0x0001) == 5000


@pytest.mark.parametrize("interrupts", [0x10, 0x00])
def test_relative_path_starts_from_commanded_position(bench, interrupts):
    bench.write(0x0191, 8)  # 0.8 A hold this load, but cannot lift it
    enable(bench)
    bench.stimulate("load_torque_n_m", 1.5)
    path(bench, ABSOLUTE, 500)
    bench.write(TRIGGER, 0x10)
    bench.run_ms(150)
    assert bench.read(FEEDBACK, 2) < 250
    assert bench.read(STATUS) == 0x0016  # commanded, but not reached
    path(bench, RELATIVE | interrupts, 500)
    bench.write(TRIGGER, 0x10)
    bench.run_ms(150)
    assert bench.read(0x602C, 2) == (1000 if interrupts else 500)  # it waits for the previous one


def test_set_zero_in_motion_is_ignored(bench):
    enable(bench)
    path(bench, ABSOLUTE, 30_000)
    bench.write(TRIGGER, 0x10)
    bench.write(TRIGGER, 0x21)
    bench.run_ms(1000)
    assert bench.read(0x602C, 2) == 30_000
    assert bench.read(STATUS) == 0x0032


@pytest.mark.parametrize(("reply_s", "answers"), [(0, 1), (0.001, 0)])
def test_drive_without_delay_responds_at_once(reply_s, answers):
    table = {"unit": 1, "timing": {"boot_up_s": 0, "reply_s": reply_s}}
    drive = build(table, ControllerContext("drive", Path(), 1))
    drive.start(0)
    drive.receive(with_crc(bytes.fromhex("01 03 1003 0001")), 1_000_000)
    assert len(drive.take_output()) == answers
    assert drive.next_deadline_ns() == (None if answers else 2_000_000)
    drive.expire(2_000_000)
    assert len(drive.take_output()) == 1 - answers
