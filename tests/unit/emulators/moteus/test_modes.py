"""Modes, faults, watchdog and trajectories of the emulated moteus, driven by mjbots' own library.

Times and codes: mjbots/moteus fw/bldc_servo_control.h, fw/bldc_servo_position.h, fw/error.h.
"""

from math import inf, nan, pi, sqrt

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.moteus.control import Trajectory
from motorhil.settings import SettingError
from tests.unit.emulators.moteus.bench import Bench

STOPPED, FAULT, ENABLING, CALIBRATING, CALIBRATED = range(5)
CURRENT, POSITION, TIMEOUT, ZERO_VELOCITY, WITHIN, _, BRAKE = range(9, 16)
MODE, WHERE, SPEED, DONE, CODE, CONTROL, CONTROL_SPEED = 0, 1, 2, 0xB, 0xF, 0x38, 0x39


# --- modes


def test_first_command_enables_and_calibrates():
    bench = Bench().position(position=nan, watchdog_timeout=nan)
    seen = []
    for _ in range(140):
        seen.append(bench.mode())
        bench.run(0.1)
    times = {mode: seen.count(mode) * 0.1 for mode in dict.fromkeys(seen)}
    assert list(times) == [ENABLING, CALIBRATING, POSITION]
    assert 4.0 <= times[ENABLING] <= 5.1
    assert times[CALIBRATING] == pytest.approx(8.53, abs=0.15)  # 256 cycles at 30 kHz


def test_newest_command_counts_when_ready():
    bench = Bench().position(position=nan).run(3)
    bench.library(bench.client.make_brake())
    assert bench.mode() == ENABLING
    assert bench.run(12).mode() == BRAKE


@pytest.mark.parametrize("mode", range(1, 5))
def test_transient_modes_cannot_be_commanded(mode):
    bench = Bench()
    assert bench.tell(f"0100{mode:02x}") == ""
    assert bench.run(15).mode() == STOPPED


@pytest.mark.parametrize("mode", [5, 6, 7, 8, 14])
def test_voltage_mode_is_entered_and_drives_nothing(mode):
    bench = Bench().powered()
    bench.tell(f"0100{mode:02x}")
    assert bench.mode() == mode
    assert any("not emulated" in text for _, text in bench.drive.take_events())
    bench.run(20)
    assert bench.read(0x004)[0] == pytest.approx(0.0, abs=1e-3)


def test_current_mode_drives_the_q_current():
    bench = Bench()
    bench.library(bench.client.make_current(q_A=0.5, d_A=2.0))
    bench.run(60)
    assert bench.mode() == CURRENT
    assert bench.read(0x004)[0] == pytest.approx(0.5, abs=0.01)
    assert bench.read(SPEED)[0] > 1.0


def test_stop_ends_every_mode():
    for command in ("01000f", "01000c", "010009", "01000d"):
        bench = Bench().powered()
        bench.tell(command)
        assert bench.mode() > CALIBRATED
        bench.library(bench.client.make_stop())
        assert bench.mode() == STOPPED


def test_command_without_mode_commands_nothing():
    bench = Bench().powered()
    bench.tell("0d20" + "00000040")  # position 2
    bench.run(500)
    assert bench.read(WHERE)[0] == pytest.approx(0.0, abs=1e-3)


def test_mode_resets_the_other_fields():
    bench = Bench().powered(maximum_torque=1.0, kp_scale=0.5)
    assert bench.read(0x025, 0x023) == [1.0, 0.5]
    bench.powered()
    assert bench.read(0x025, 0x023) == [100.0, 1.0]  # not NaN, as the documents have it


# --- faults


@pytest.mark.parametrize(
    ("table", "command", "code"),
    [
        ({"poles": 0}, {}, 36),
        ({"position_min_rev": -0.5, "position_max_rev": -0.1}, {}, 39),
        ({"position_min_rev": -40000.0}, {}, 48),
        ({}, {"stop_position": 1.0}, 45),
        ({"default_accel_limit_rev_s2": "none"}, {"stop_position": 1.0, "velocity_limit": 1.0}, 45),
    ],
)
def test_command_that_cannot_be_obeyed_is_a_fault(table, command, code):
    bench = Bench(**table).powered(**command)
    assert bench.read(MODE, CODE) == [FAULT, code]


@pytest.mark.parametrize(
    ("table", "command"),
    [
        ({"position_min_rev": -0.5, "position_max_rev": 0.0}, {}),
        (
            {"position_min_rev": -0.5, "position_max_rev": -0.1},
            {"ignore_position_bounds": 1.0},
        ),
        ({"position_min_rev": -32768.0}, {}),
        ({}, {"stop_position": 1.0, "accel_limit": -1.0}),
    ],
)
def test_command_at_the_limit_is_obeyed(table, command):
    assert Bench(**table).powered(**command).mode() == POSITION


def test_fault_is_left_by_stop_only():
    bench = Bench().powered()
    bench.drive.stimulate("fault", 35, bench.now)
    assert bench.read(MODE, CODE) == [FAULT, 35]
    bench.powered()
    assert bench.read(MODE, CODE) == [FAULT, 35]
    bench.library(bench.client.make_stop())
    assert bench.read(MODE, CODE) == [STOPPED, 0]
    assert bench.powered().mode() == POSITION


@pytest.mark.parametrize(("family", "limit"), [(0, 75.0), (3, 105.0)])
def test_board_temperature_beyond_the_limit_is_fault_38(family, limit):
    bench = Bench(family=family)
    bench.drive.stimulate("board_temperature_c", 200.0, 0)
    assert bench.read(MODE, 0xE) == [STOPPED, 200.0]  # a stopped drive has no such fault
    bench.drive.stimulate("board_temperature_c", limit, 0)
    bench.position(position=nan, watchdog_timeout=nan).run(25)
    assert bench.mode() == POSITION
    bench.drive.stimulate("board_temperature_c", limit + 0.1, bench.now)
    assert bench.read(MODE, CODE) == [FAULT, 38]


LINK = {"preset": "wheel_60w", "source_resistance_ohm": 0.5, "dc_link_capacitance_f": 5e-4}


def test_enabling_takes_its_time_though_the_dc_link_rests():
    bench = Bench(plant=LINK).position(position=nan).run(10)
    assert bench.drive.snapshot(bench.now)["mode"] == CALIBRATING
    assert bench.run(15).drive.snapshot(bench.now)["mode"] == POSITION


@pytest.mark.parametrize(("supply_v", "code"), [(3.9, 40), (60.0, 34)])
def test_supply_beyond_the_limits_is_a_fault(supply_v, code):
    bench = Bench(plant={**LINK, "dc_link_bleed_ohm": 20.0}).powered()
    assert bench.mode() == POSITION
    bench.drive.stimulate("supply_v", supply_v, bench.now)
    bench.run(100)
    assert bench.read(MODE, CODE) == [FAULT, code]


@pytest.mark.parametrize(
    ("key", "code"), [("fault_position_error_rev", 49), ("fault_velocity_error_rev_s", 50)]
)
def test_control_error_is_a_fault_if_configured(key, code):
    fast = {"position": 20.0, "velocity_limit": 300.0, "accel_limit": 20000.0}
    for table, wanted in (({key: 0.5}, code), ({}, 0)):
        bench = Bench(**table).powered()
        bench.position(**fast, watchdog_timeout=nan).run(300)
        assert bench.drive.fault == wanted


# --- watchdog


def test_watchdog_is_0_1_s_by_default():
    bench = Bench().position(position=nan)
    assert bench.run(99.9).mode() == POSITION
    assert bench.run(0.2).mode() == TIMEOUT


def test_reads_do_not_feed_the_watchdog_and_commands_do():
    bench = Bench()
    for _ in range(5):
        bench.position(position=nan).run(90)
        assert bench.mode() == POSITION
    for _ in range(4):
        bench.mode()
        bench.run(5)
    assert bench.mode() == TIMEOUT


@pytest.mark.parametrize(("given", "ms"), [(0.03, 30), (0.5, 500), (0.0, 100)])
def test_watchdog_of_a_command_is_its_own(given, ms):
    bench = Bench().position(position=nan, watchdog_timeout=given)
    assert bench.run(ms - 0.1).mode() == POSITION
    assert bench.run(0.2).mode() == TIMEOUT


def test_watchdog_acts_in_position_and_within_only():
    bench = Bench()
    bench.library(bench.client.make_brake())
    assert bench.run(500).mode() == BRAKE
    bench.library(bench.client.make_stay_within(lower_bound=-1.0, upper_bound=1.0))
    assert bench.run(99).mode() == WITHIN
    assert bench.run(2).mode() == TIMEOUT


def test_timeout_is_left_by_stop_only():
    bench = Bench().position(position=nan).run(101)
    assert bench.position(position=nan).run(15).mode() == TIMEOUT
    bench.library(bench.client.make_stop())
    assert bench.position(position=nan).run(15).mode() == POSITION


def running(**table):
    bench = Bench(**table).powered()
    bench.position(position=nan, velocity=10.0, watchdog_timeout=0.5).run(499)
    assert bench.read(SPEED)[0] == pytest.approx(10.0, abs=0.6)
    return bench


@pytest.mark.parametrize("mode", [10, 12, 15])
def test_timeout_mode_brings_the_motor_to_rest(mode):
    bench = running(timeout_mode=mode).run(500)
    assert bench.mode() == TIMEOUT
    assert bench.read(SPEED)[0] == pytest.approx(0.0, abs=0.5)


@pytest.mark.parametrize("mode", [0, 3])
def test_timeout_mode_off_lets_the_motor_coast(mode):
    bench = running(timeout_mode=mode).run(5)
    assert bench.read(MODE, 0x004)[:2] == [TIMEOUT, pytest.approx(0.0, abs=1e-3)]
    assert bench.read(SPEED)[0] > 5.0


def test_timeout_mode_10_slows_down_by_the_default_limit():
    bench = running(timeout_mode=10, default_accel_limit_rev_s2=20.0)
    before = bench.read(CONTROL)[0]
    bench.run(1000)
    way = bench.read(CONTROL)[0] - before
    assert way == pytest.approx(10.0**2 / (2 * 20.0) + 0.01, abs=0.005)
    assert bench.read(WHERE)[0] == pytest.approx(bench.read(CONTROL)[0], abs=0.002)


# --- trajectories


@pytest.mark.parametrize(
    ("way", "speed", "acceleration"),
    [(2.0, 3.0, 10.0), (-2.0, 3.0, 10.0), (0.5, 10.0, 8.0), (1.0, nan, 50.0)],
)
def test_trajectory_takes_the_time_of_its_trapezoid(way, speed, acceleration):
    bench = Bench().powered()
    bench.position(
        position=way, velocity_limit=speed, accel_limit=acceleration, watchdog_timeout=nan
    )
    peak = sqrt(abs(way) * acceleration)
    wanted_s = 2 * peak / acceleration
    if peak > speed:
        wanted_s = abs(way) / speed + speed / acceleration
    assert bench.read(DONE) == [0]
    bench.run(wanted_s * 1e3 - 1)
    assert bench.read(DONE) == [0]
    bench.run(2)
    assert bench.read(DONE, CONTROL, CONTROL_SPEED) == [1, pytest.approx(way), 0.0]
    bench.run(200)
    assert bench.read(WHERE)[0] == pytest.approx(way, abs=0.001)


def test_velocity_limit_alone_jumps_to_it():
    bench = Bench(default_accel_limit_rev_s2="none").powered()
    bench.position(position=1.0, velocity_limit=2.0, watchdog_timeout=nan)
    assert bench.read(CONTROL_SPEED, DONE) == [2.0, 0]
    bench.run(250)
    assert bench.read(CONTROL)[0] == pytest.approx(0.5)
    assert bench.run(251).read(CONTROL, CONTROL_SPEED, DONE) == [1.0, 0.0, 1]


def test_command_without_limits_is_the_set_point_at_once():
    bench = Bench().powered()
    bench.position(position=0.25, velocity=0.5, velocity_limit=-1.0, accel_limit=-1.0)
    assert bench.read(CONTROL, CONTROL_SPEED, DONE) == [0.25, 0.5, 1]
    assert bench.run(50).read(CONTROL)[0] == pytest.approx(0.275)


def test_velocity_command_ramps_from_where_it_is():
    bench = Bench().powered()
    bench.position(position=nan, velocity=4.0, accel_limit=8.0, watchdog_timeout=nan)
    assert bench.run(250).read(CONTROL_SPEED, DONE) == [pytest.approx(2.0), 0]
    assert bench.run(251).read(CONTROL_SPEED, DONE) == [4.0, 1]
    assert bench.read(CONTROL)[0] == pytest.approx(1.004)


def test_target_moves_on_with_its_velocity():
    bench = Bench().powered()
    bench.position(
        position=0.5, velocity=1.0, velocity_limit=4.0, accel_limit=10.0, watchdog_timeout=nan
    )
    bench.run(2000)
    assert bench.read(CONTROL, CONTROL_SPEED, DONE) == [pytest.approx(2.5), 1.0, 1]


def test_target_as_fast_as_the_limit_is_never_reached():
    bench = Bench().powered()
    bench.position(
        position=0.5, velocity=2.0, velocity_limit=2.0, accel_limit=10.0, watchdog_timeout=nan
    )
    assert bench.run(3000).read(CONTROL_SPEED, DONE) == [2.0, 0]


def test_velocity_command_is_clamped_to_its_limit():
    bench = Bench().powered()
    bench.position(position=nan, velocity=9.0, velocity_limit=3.0, watchdog_timeout=nan)
    assert bench.run(500).read(CONTROL_SPEED)[0] == 3.0


def test_new_command_starts_from_the_control_state():
    bench = Bench().powered()
    first = {"velocity_limit": 4.0, "accel_limit": 10.0, "watchdog_timeout": nan}
    bench.position(position=5.0, **first).run(300)
    before = bench.read(CONTROL, CONTROL_SPEED)
    bench.position(position=-1.0, **first)
    assert bench.read(CONTROL, CONTROL_SPEED) == before
    assert before[1] == pytest.approx(3.0)
    slow = {**first, "velocity_limit": 1.0}
    bench.position(position=5.0, **slow)  # over the limit: it slows down to it
    assert bench.run(100).read(CONTROL_SPEED)[0] == pytest.approx(2.0)
    assert bench.run(150).read(CONTROL_SPEED)[0] == pytest.approx(1.0)


@pytest.mark.parametrize("target", [nan, 1.0])
@pytest.mark.parametrize("limit", [{"velocity_limit": 0.0}, {"accel_limit": 0.0}])
def test_limit_of_zero_keeps_the_motor_at_rest(limit, target):
    bench = Bench().powered()
    bench.position(position=target, velocity=1.0, watchdog_timeout=nan, **limit)
    assert bench.run(500).read(CONTROL)[0] == pytest.approx(0.0, abs=1e-6)


def test_repeated_command_changes_nothing():
    one, other = Bench().powered(), Bench().powered()
    command = {"position": 2.0, "velocity_limit": 3.0, "accel_limit": 10.0}
    one.position(**command, watchdog_timeout=nan)
    for _ in range(60):
        other.position(**command).run(20)
    one.run(1200)
    assert other.read(DONE, CONTROL) == one.read(DONE, CONTROL)
    assert other.read(WHERE)[0] == pytest.approx(one.read(WHERE)[0], abs=0.001)


def test_bound_holds_the_control_position():
    bench = Bench(position_min_rev=-0.01, position_max_rev=0.01).powered()
    bench.position(position=1.0, watchdog_timeout=nan).run(500)
    assert bench.read(CONTROL, CONTROL_SPEED, DONE, CODE) == [pytest.approx(0.01), 0.0, 0, 103]


def test_stop_position_holds_the_control_position():
    free = {"velocity_limit": -1.0, "accel_limit": -1.0, "watchdog_timeout": nan}
    bench = Bench().powered()
    bench.position(position=nan, velocity=1.0, stop_position=0.25, **free).run(1000)
    assert bench.read(CONTROL, CONTROL_SPEED) == [0.25, 0.0]


# --- torque


def test_feed_forward_torque_without_gains_is_torque_control():
    bench = Bench().powered()
    torque = 0.012  # above the friction
    bench.position(
        position=nan, kp_scale=0.0, kd_scale=0.0, feedforward_torque=torque, watchdog_timeout=nan
    )
    bench.run(50)
    assert bench.read(3)[0] == pytest.approx(torque, rel=0.02)
    assert bench.read(SPEED)[0] > 1.0


def test_maximum_torque_limits_and_is_told():
    bench = Bench().powered()
    bench.position(
        position=5.0, maximum_torque=0.01, velocity_limit=50.0, accel_limit=5000.0,
        watchdog_timeout=nan,
    )  # fmt: skip
    bench.run(20)
    assert bench.read(3)[0] == pytest.approx(0.01, rel=0.05)
    assert bench.read(MODE, CODE) == [POSITION, 102]


def test_gains_of_the_drive_let_the_load_move_it():
    """A torque of 0.02 N·m at the motor, at 4 N·m/rev, is 5 mrev, less the friction's share."""
    bench = Bench(kp_n_m_rev=4.0, kd_n_m_s_rev=0.05).powered()
    bench.drive.stimulate("load_torque_n_m", 0.02 * 66, bench.now)
    bench.run(500)
    assert -0.0050 <= bench.read(WHERE)[0] <= -0.0039
    scaled = Bench(kp_n_m_rev=4.0, kd_n_m_s_rev=0.05).powered(kp_scale=0.5)
    scaled.drive.stimulate("load_torque_n_m", 0.02 * 66, scaled.now)
    scaled.run(500)
    assert -0.0100 <= scaled.read(WHERE)[0] <= -0.0078


def test_stay_within_pushes_back_at_its_bounds_only():
    bench = Bench()
    within = bench.client.make_stay_within(lower_bound=-0.5, upper_bound=0.5, watchdog_timeout=nan)
    bench.library(within)
    bench.run(15)
    bench.drive.stimulate("load_torque_n_m", 1.0, bench.now)
    bench.run(1000)
    assert bench.mode() == WITHIN
    assert bench.read(WHERE)[0] == pytest.approx(-0.5, abs=0.05)


# --- the rest


def test_power_cycle_forgets_turns_and_settings():
    bench = Bench(initial_position_rad=1.0)  # 10.5 turns of the motor
    where = bench.read(WHERE)[0]
    assert -0.5 <= where <= 0.5
    bench.powered(maximum_torque=1.0)
    bench.drive.stimulate("power", 0, bench.now)
    assert bench.tell("1100") is None
    bench.drive.stimulate("power", 1, bench.now)
    assert bench.read(MODE, 0x00C, 0x025) == [STOPPED, 1, 100.0]


def test_millisecond_counter_wraps_by_its_type():
    bench = Bench().run(70_000)
    assert bench.tell("1170") == "217070"
    assert bench.tell("1570") == "25707011"
    assert bench.read(0x070) == [70_000.0]


def test_encoder_of_the_output_keeps_turns():
    bench = Bench(initial_position_rad=1.0, output_encoder=True)
    assert bench.read(WHERE, 0x00C) == [pytest.approx(66 / (2 * pi), abs=1e-3), 2]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"node_id": 127}, "node_id"),
        ({"rotor_to_output_ratio": 0.0}, "rotor_to_output_ratio"),
        ({"position_min_rev": "never"}, "position_min_rev"),
        ({"id": 3}, "id"),
    ],
)
def test_wrong_setting_is_named(table, message):
    with pytest.raises(SettingError, match=message):
        Bench(**table)


@pytest.mark.parametrize(
    ("name", "value"), [("fault", 96), ("fault", 1.5), ("power", 2), ("magnet", 1)]
)
def test_wrong_stimulus_is_refused(name, value):
    with pytest.raises(ValueError, match=name):
        Bench().drive.stimulate(name, value, 0)


def test_timeout_limits_the_torque_of_zero_velocity():
    bench = running(timeout_max_torque_n_m=0.005).run(10)
    assert bench.mode() == TIMEOUT
    assert abs(bench.read(3)[0]) == pytest.approx(0.005, rel=0.05)


def test_start_of_a_turning_motor_keeps_its_velocity():
    bench = running()
    bench.library(bench.client.make_stop())
    bench.position(position=nan, accel_limit=20.0, watchdog_timeout=nan).run(14)
    assert bench.mode() == POSITION
    assert bench.read(CONTROL_SPEED)[0] > 3.0


LIMITS = st.floats(0.5, 20.0)


@given(
    start=st.floats(-5, 5),
    velocity=st.floats(-20, 20),
    target=st.none() | st.floats(-5, 5),
    final=st.floats(-1, 1),
    speed=LIMITS | st.just(inf),
    acceleration=LIMITS | st.just(inf),
)
def test_trajectory_is_continuous_and_ends_at_its_target(
    start, velocity, target, final, speed, acceleration
):
    final = max(-speed, min(speed, final))
    path = Trajectory(start, velocity, target, final, speed, acceleration)
    steps = 300
    end_s = path.duration_s if path.duration_s < inf else 1.0
    before = path.at(0.0)
    for step in range(1, steps + 1):
        time_s = end_s * step / steps
        now = path.at(time_s)
        fastest = max(abs(velocity), speed if speed < inf else abs(now[1]) + 30.0)
        assert abs(now[1]) <= fastest * (1 + 1e-9)
        assert abs(now[0] - before[0]) <= fastest * end_s / steps * (1 + 1e-6) + 1e-6
        if acceleration < inf:
            rise = acceleration * end_s / steps
            assert abs(now[1] - before[1]) <= rise * (1 + 1e-6) + 1e-6
        before = now
    if path.duration_s < inf:
        later = path.at(path.duration_s + 1.0)
        assert later[1] == final
        if target is not None:
            assert later[0] == pytest.approx(target + final * (path.duration_s + 1.0))
