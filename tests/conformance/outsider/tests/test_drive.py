"""Tests of the emulated drive, frame by frame."""

import struct

import pytest
from conftest import MS, Bench
from hypothesis import given, settings
from hypothesis import strategies as st
from motorhil.emulators.controller import SettingError

IDLE, CLOSED_LOOP, HOMING = 1, 8, 11
SUCCESS, BUSY, CANCELLED, DISARMED, WITHOUT_ENDSTOP, INVALID = 0, 1, 2, 3, 12, 13
ESTOP, WATCHDOG, OVERSPEED, MISSING = 1 << 25, 1 << 24, 1 << 15, 1 << 3
REV = 2000  # increments


def u32(*values):
    return struct.pack(f"<{len(values)}I", *values)


def f32(*values):
    return struct.pack(f"<{len(values)}f", *values)


def armed(control=3, mode=5, **table):
    bench = Bench(**table).run(600)
    bench.tell(0x0F, f32(50.0, 8.0)).tell(0x11, f32(10.0)).tell(0x12, f32(20.0, 20.0))
    bench.tell(0x0B, u32(control, mode)).tell(7, u32(CLOSED_LOOP))
    assert bench.heartbeat() == (0, CLOSED_LOOP, BUSY, control != 3 or mode != 5)
    return bench


def test_cyclic_messages_start_after_boot():
    bench = Bench().run(1000)
    beats = [at for at, command, _ in bench.heard if command == 1]
    estimates = [at for at, command, _ in bench.heard if command == 9]
    assert beats == [500.0, 600.0, 700.0, 800.0, 900.0, 1000.0]
    assert estimates == [500.0 + 10 * k for k in range(51)]


def test_drive_is_silent_before_boot():
    bench = Bench().run(499).tell(7, u32(CLOSED_LOOP)).tell(1, flags=0x4000_0000)
    assert bench.heard == []


@pytest.mark.parametrize("command", [0, 1, 3, 9, 0x14, 0x15, 0x17, 0x1C, 0x1D])
def test_remote_frame_is_answered(command):
    assert len(Bench().run(510).ask(command)) == 8


def test_version_is_firmware_0_6_10_and_protocol_2():
    answer = Bench().run(510).ask(0)
    assert (answer[0], *answer[4:7]) == (2, 0, 6, 10)


def test_trapezoid_is_done_after_its_theoretical_time():
    bench = armed()
    began = bench.now
    bench.tell(0x0C, f32(5.0) + bytes(4))  # 5 rev at 10 rev/s, 20 rev/s^2: a triangle of 1 s
    assert bench.heartbeat()[3] == 0
    bench.run(999)
    assert bench.heartbeat()[3] == 0
    bench.run(3)
    assert bench.heartbeat()[3] == 1
    assert bench.now - began == 1002 * MS
    bench.run(100)
    assert abs(bench.truth("position_inc") - 5 * REV) <= 2


def test_new_target_replaces_target_during_motion():
    bench = armed()
    bench.tell(0x0C, f32(5.0) + bytes(4)).run(400).tell(0x0C, f32(-1.0) + bytes(4)).run(3000)
    assert abs(bench.truth("position_inc") + REV) <= 2


def test_position_passthrough_steps_at_once():
    bench = armed(3, 1)
    bench.tell(0x0C, f32(0.1) + bytes(4)).run(150)
    assert abs(bench.truth("position_inc") - 0.1 * REV) <= 2


def test_velocity_input_is_ramped_or_at_once():
    bench = armed(2, 2, velocity_ramp_rev_s2=10.0)
    bench.tell(0x0D, f32(5.0, 0.0)).run(250)
    assert struct.unpack("<ff", bench.ask(9))[1] == pytest.approx(2.5, abs=0.3)
    bench.run(600)
    assert struct.unpack("<ff", bench.ask(9))[1] == pytest.approx(5.0, abs=0.3)
    bench.tell(0x0B, u32(2, 1)).tell(0x0D, f32(1.0, 0.0)).run(100)
    assert struct.unpack("<ff", bench.ask(9))[1] == pytest.approx(1.0, abs=0.3)


def test_torque_equals_current_times_constant():
    bench = armed(1, 1)
    bench.tell(0x0E, f32(0.01)).run(20)
    target, estimate = struct.unpack("<ff", bench.ask(0x1C))
    assert target == pytest.approx(0.01, rel=1e-3)
    assert estimate == pytest.approx(0.01, rel=0.05)
    assert struct.unpack("<ff", bench.ask(0x14))[1] == pytest.approx(0.01 / 0.0259, rel=0.05)


def test_torque_mode_keeps_velocity_limit():
    bench = armed(1, 1)
    bench.tell(0x0F, f32(4.0, 8.0)).tell(0x0E, f32(0.1)).run(2000)
    assert 3.0 < struct.unpack("<ff", bench.ask(9))[1] < 4.5


def test_exceeded_velocity_tolerance_disarms():
    bench = armed(2, 1)
    bench.tell(0x0D, f32(20.0, 0.0)).run(300).tell(0x0F, f32(10.0, 8.0)).run(20)
    assert bench.heartbeat()[:3] == (OVERSPEED, IDLE, DISARMED)


def test_emergency_stop_disarms_until_errors_are_cleared():
    bench = armed().tell(2)
    assert bench.heartbeat()[:3] == (ESTOP, IDLE, DISARMED)
    assert struct.unpack("<II", bench.ask(3)) == (0, ESTOP)
    bench.tell(7, u32(CLOSED_LOOP))
    assert bench.heartbeat()[:3] == (ESTOP, IDLE, INVALID)
    bench.tell(0x18, b"\0").tell(7, u32(CLOSED_LOOP))
    assert bench.heartbeat()[:3] == (0, CLOSED_LOOP, BUSY)


def test_error_with_present_cause_is_not_cleared():
    bench = armed()
    bench.drive.stimulate("encoder", 0, bench.now)
    bench.tell(0x18, b"\0")
    assert struct.unpack("<II", bench.ask(3)) == (MISSING, 0)
    bench.drive.stimulate("encoder", 1, bench.now)
    assert bench.heartbeat()[0] == 0


def test_watchdog_expires_only_without_messages():
    bench = armed(watchdog_s=0.2)
    for _ in range(5):
        bench.run(199).tell(1, flags=0x4000_0000)
    assert bench.heartbeat()[:2] == (0, CLOSED_LOOP)
    bench.run(199)
    assert bench.truth("axis_error") == 0
    bench.run(2)
    assert bench.truth("axis_error") == WATCHDOG
    assert bench.truth("axis_state") == IDLE


def test_homing_without_end_stop_fails():
    bench = Bench().run(600).tell(7, u32(HOMING))
    assert bench.heartbeat()[1:3] == (IDLE, WITHOUT_ENDSTOP)


def test_homing_ends_at_edge_of_end_stop():
    bench = armed(min_endstop_rad=-0.05, homing_speed_rev_s=2.0, velocity_ramp_rev_s2=50.0)
    bench.tell(7, u32(HOMING)).run(100)
    assert bench.heartbeat()[1:3] == (HOMING, BUSY)
    bench.run(3000)
    assert bench.heartbeat()[1:3] == (CLOSED_LOOP, SUCCESS)
    at_edge_rad = bench.truth("position_rad") - bench.truth("position_inc") / REV * 2 * 3.14159 / 66
    assert at_edge_rad == pytest.approx(-0.05, abs=0.001)


def test_calibration_ends_in_idle():
    bench = Bench().run(600).tell(7, u32(3))
    assert bench.heartbeat()[1:3] == (3, BUSY)
    bench.run(2001)
    assert bench.heartbeat()[1:3] == (IDLE, SUCCESS)
    bench.tell(7, u32(5))
    assert bench.heartbeat()[1:3] == (IDLE, INVALID)


def test_idle_switches_current_off():
    bench = armed().tell(7, u32(IDLE))
    assert bench.heartbeat()[1:3] == (IDLE, CANCELLED)
    bench.drive.stimulate("load_torque_n_m", 5.0, bench.now)
    assert bench.run(200).truth("velocity_rad_s") < -0.1


def test_only_saved_parameters_survive_reboot():
    bench = armed().tell(0x16, b"\x01").run(600)
    bench.tell(0x11, f32(1.0)).tell(0x16, b"\0").run(600)
    bench.tell(7, u32(CLOSED_LOOP)).tell(0x0C, f32(5.0) + bytes(4)).run(1100)
    assert abs(bench.truth("position_inc") - 5 * REV) <= 3
    bench.tell(0x16, b"\x03").run(5000)
    assert bench.truth("axis_state") == 0


def test_absolute_position_changes_without_motion():
    bench = armed()
    before = bench.truth("position_rad")
    bench.tell(0x19, f32(7.5)).run(100)
    assert struct.unpack("<ff", bench.ask(9))[0] == pytest.approx(7.5, abs=0.002)
    assert bench.truth("position_rad") == pytest.approx(before, abs=1e-4)


def test_zero_gains_move_nothing():
    bench = armed()
    bench.tell(0x1A, f32(0.0)).tell(0x1B, f32(0.0, 0.0)).tell(0x13, f32(0.0))
    bench.tell(0x0C, f32(1.0) + bytes(4)).run(500)
    assert abs(bench.truth("position_inc")) < 10  # no control moves it


def test_velocity_loop_without_integrator_lags():
    bench = armed(2, 1)
    bench.tell(0x1B, f32(0.004, 0.0)).tell(0x0D, f32(5.0, 0.0)).run(1500)
    # 4 mN m of friction, and 1e-6 N m s of it at 25 rad/s, need 1.006 rev/s
    assert struct.unpack("<ff", bench.ask(9))[1] == pytest.approx(5.0 - 1.006, abs=0.13)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 3e38])
@pytest.mark.parametrize("command", [0x0C, 0x0D, 0x0F, 0x11, 0x12, 0x13, 0x19, 0x1A, 0x1B])
def test_impossible_values_change_nothing(command, value):
    bench = armed(2 if command == 0x0D else 3, 1 if command == 0x0D else 5)
    before = bench.drive.control.parameters
    bench.drive.take_events()
    bench.tell(command, f32(value, value)).run(100)
    assert abs(bench.truth("position_inc")) <= 1
    assert bench.drive.control.parameters == before
    assert [level for level, _ in bench.drive.take_events()] == ["warning"]


def test_addressing_by_serial_number_changes_node_id():
    bench = Bench(serial_number=0x123456).run(510)
    serial = (0x123456).to_bytes(6, "little")
    assert bench.ask(6)[:7] == bytes((5,)) + serial
    assert 6 << 5 | 7 not in bench.drive.identifiers()
    bench.tell(6, bytes((6,)) + serial + b"\0", node=0x3F)
    assert bench.drive.identifiers_revision() == 1
    assert 6 << 5 | 7 in bench.drive.identifiers()
    bench.tell(7, u32(CLOSED_LOOP), node=5)
    assert bench.truth("axis_state") == IDLE
    bench.tell(7, u32(CLOSED_LOOP), node=6)
    assert bench.truth("axis_state") == CLOSED_LOOP


def test_node_id_of_another_serial_number_is_given_up():
    bench = Bench(serial_number=7).run(510).tell(6, b"\x05" + b"\x01" * 6 + b"\0")
    assert bench.drive.identifiers()[0] == 0x3F << 5


@pytest.mark.parametrize(
    ("table", "told"),
    [
        ({"node_id": 63}, "node_id: 63 is out of range; allowed: 0 to 62"),
        ({"nod_id": 1}, "nod_id: unknown key .*; did you mean node_id?"),
        ({"watchdog_s": -1}, "watchdog_s: -1 s is out of range; allowed: 0 to 3600 s"),
        ({"timing": {"heartbeat": 1}}, "timing.heartbeat: unknown key .*; did you mean heartbeat"),
    ],
)
def test_wrong_setting_is_reported_with_its_keys(table, told):
    with pytest.raises(SettingError, match=told.replace("?", r"\?")):
        Bench(**table)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([*range(32), 7, 12, 11, 13, 14]),
            st.one_of(
                st.binary(max_size=8),
                st.sampled_from([u32(8), u32(3, 5), u32(2, 1), u32(1, 1), u32(11), f32(3e38)]),
            ),
            st.sampled_from([0, 0, 0, 0x4000_0000]),
            st.integers(0, 300),
        ),
        max_size=25,
    )
)
def test_random_frames_raise_no_error(frames):
    bench = Bench(min_endstop_rad=-0.1, watchdog_s=0.25).run(510)
    bench.tell(7, u32(CLOSED_LOOP))
    for command, data, flags, ms in frames:
        bench.tell(command, data, flags=flags).run(ms)
    assert bench.truth("position_rad") == bench.truth("position_rad")
