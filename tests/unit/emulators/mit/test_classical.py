"""Drives with MIT frames: golden frames, states, and the differences between firmwares.

Expected bytes come from mini-cheetah-motor-driver-socketcan 0.4.3 and TMotorCANControl 1.2.6, run
once; behaviour from bgkatz/motorcontrol, the manual of CubeMars and DM_Control_Python.
"""

import struct

import pytest

from motorhil.emulators.controller import SettingError
from motorhil.emulators.mit.settings import MODELS
from tests.unit.emulators.mit.bench import CLEAR, ENTER, LEAVE, ZERO, Bench

REST = bytes.fromhex("7FFF7FF0000007FF")
GOLDEN = [
    ("7FFF7FF0000007FF", (0.0, 0.0, 0.0, 0.0, 0.0)),
    ("8A3C7FF0513337FF", (1.0, 0.0, 10.0, 1.0, 0.0)),
    ("7FFF7E40003337FF", (0.0, -1.0, 0.0, 1.0, 0.0)),
    ("7FFF7FF000000954", (0.0, 0.0, 0.0, 0.0, 2.0)),
    ("FFFFFFFFFFFFFFFF", (12.5, 76.0, 500.0, 5.0, 12.0)),
    ("0000000000000000", (-12.5, -76.0, 0.0, 0.0, -12.0)),
    # as TMotorCANControl encodes 0 and 1 rad, with 2 to the power of n
    ("8000800000000800", (0.0, 0.0, 0.0, 0.0, 0.0)),
    ("8A3D800000000800", (1.0, 0.0, 0.0, 0.0, 0.0)),
]
COMMAND = ("position_rad", "velocity_rad_s", "kp_n_m_rad", "kd_n_m_s_rad", "torque_n_m")


def command(bench: Bench) -> tuple[float, ...]:
    truth = bench.truth()
    return tuple(truth[f"command_{name}"] for name in COMMAND)


@pytest.mark.parametrize(("data", "expected"), GOLDEN)
def test_golden_request_is_understood(data, expected):
    bench = Bench(model="ak80_6_v2")
    bench.ask(data)
    steps = (25 / 65535, 152 / 4095, 500 / 4095, 5 / 4095, 24 / 4095)  # one code
    for value, wanted, step in zip(command(bench), expected, steps, strict=True):
        assert value == pytest.approx(wanted, abs=1.01 * step)


def test_rmd_golden_request_is_understood():
    # The maker's example of RMD's motion mode, with its printed values: the same packing.
    bench = Bench(model="ak80_6_v2", v_max_rad_s=45.0, t_max_n_m=24.0)
    bench.ask("E66682E052333B55")
    # The manual divides the code of the position by 2 to the power of 16.
    assert command(bench) == pytest.approx((9.99, 1.021, 10.012, 1.0, 10.004), abs=0.011)


def test_zero_has_no_code():
    bench = Bench(model="ak80_6_v2")
    bench.ask(REST)
    p, _, _, _, t = command(bench)
    assert p == pytest.approx(-0.00019, abs=1e-5)
    assert t == pytest.approx(-0.0029, abs=1e-4)


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        ("ak80_6_v2", "01 7FFF 7FF7FF 19 00"),  # 25 C, no fault
        ("mini_cheetah", "01 7FFF 7FF7FF 4C"),  # 24 V of 80 V
        ("dm4310", "01 7FFF 7FF7FF 19 19"),
    ],
)
def test_answer_at_rest_has_the_codes_of_zero(model, expected):
    assert Bench(model=model).ask(REST) == [(0, bytes.fromhex(expected))]


def test_answer_length_is_a_setting():
    assert Bench(answer_bytes=6).ask(REST) == [(0, bytes.fromhex("01 7FFF 7FF7FF"))]
    assert Bench(master_id=0x11).ask(REST)[0][0] == 0x11


def test_answer_holds_the_state_before_the_command():
    bench = Bench(model="dm4310")
    assert bench.ask(ENTER)[0][1][0] == 0x01  # disabled
    assert bench.ask(REST)[0][1][0] == 0x11  # enabled
    assert bench.ask(LEAVE)[0][1][0] == 0x11
    assert bench.ask(REST)[0][1][0] == 0x01


def test_motor_follows_the_law_only_while_enabled():
    bench = Bench(model="ak80_6_v2")
    bench.ask("8A3C7FF0513337FF")  # 1 rad, kp 10, kd 1
    bench.run(500)
    assert bench.truth()["position_rad"] == 0.0
    bench.ask(ENTER)
    bench.run(1500)
    # friction: 4 mN m at the motor, gear 66, kp 10
    assert bench.truth()["position_rad"] == pytest.approx(1.0, abs=0.0264 + 1e-3)


def test_special_codes_win_over_equal_commands():
    bench = Bench(model="ak80_6_v2")
    bench.ask(ENTER)
    assert command(bench) == (0.0, 0.0, 0.0, 0.0, 0.0)
    bench.ask("FFFFFFFFFFFFFFFA")  # no special code
    assert command(bench)[0] == 12.5


def test_mini_cheetah_watchdog_limps_after_25_ms():
    bench = Bench(model="mini_cheetah")
    bench.ask(ENTER)
    bench.ask("FFFF7FF0513337FF")
    bench.run(24.9)
    assert command(bench)[0] == 12.5
    bench.ask(ENTER)  # does not count as a command
    bench.run(0.2)
    assert command(bench) == (0.0, 0.0, 0.0, 0.0, 0.0)
    assert bench.truth()["is_on"] == 1.0
    assert "no command for 0.025 s" in bench.events()
    bench.ask("FFFF7FF0513337FF")
    assert command(bench)[0] == 12.5


def test_cubemars_keeps_its_last_command():
    bench = Bench(model="ak80_6_v2")
    bench.ask(ENTER)
    bench.ask("8A3C7FF0513337FF")
    bench.run(5000)
    bench.ask(LEAVE)
    assert command(bench)[0] == pytest.approx(1.0, abs=1e-3)  # the kick at the next enable


def test_mini_cheetah_forgets_its_command_when_it_leaves():
    bench = Bench(model="mini_cheetah")
    bench.ask(ENTER)
    bench.ask("8A3C7FF0513337FF")
    bench.ask(LEAVE)
    assert command(bench) == (0.0, 0.0, 0.0, 0.0, 0.0)


def test_clear_is_a_request_of_damiao_only():
    bench = Bench(model="ak80_6_v2")
    bench.drive.stimulate("fault", 2, bench.now_ns)
    bench.ask(CLEAR)
    assert bench.ask(REST)[0][1][7] == 2


def test_zero_in_motor_mode_moves_the_target():
    bench = Bench(model="dm4310", initial_position_rad=1.0)
    bench.ask(ENTER)
    bench.ask("8A3C7FF0513337FF")  # 1 rad, kp 10: it is there
    bench.ask(ZERO)
    bench.run(2000)
    assert bench.truth()["position_rad"] == pytest.approx(2.0, abs=0.03)


@pytest.mark.parametrize(("model", "kept"), [("ak80_6_v2", False), ("dm4310", True)])
def test_zero_without_power_is_kept_by_some(model, kept):
    bench = Bench(model=model, initial_position_rad=0.03)
    bench.ask(ZERO)
    bench.drive.stimulate("power", 0, bench.now_ns)
    bench.run(2000)
    bench.drive.stimulate("power", 1, bench.now_ns)
    bench.run(200)
    turn_inc, inc_rad = 2000, 2000 * 66 / 6.283185307
    lost = round(0.03 * inc_rad) % turn_inc
    assert bench.truth()["position_inc"] == pytest.approx(0 if kept else lost, abs=1)


def test_damiao_without_commands_has_a_fault():
    bench = Bench(model="dm4310", watchdog_s=0.05)
    bench.ask(ENTER)
    bench.run(60)
    assert bench.ask(REST)[0][1][0] == 0xD1
    bench.ask(ENTER)
    assert bench.ask(REST)[0][1][0] == 0xD1  # FC alone does not help
    bench.ask(CLEAR)
    bench.ask(ENTER)
    assert bench.ask(REST)[0][1][0] == 0x11


def test_fault_ends_with_leave_and_enter():
    bench = Bench(model="ak80_6_v2")
    bench.ask(ENTER)
    bench.drive.stimulate("fault", 2, bench.now_ns)
    assert bench.ask(REST)[0][1][7] == 2
    assert bench.truth()["is_on"] == 0.0
    bench.ask(ENTER)
    assert bench.ask(REST)[0][1][7] == 2
    bench.ask(LEAVE)
    bench.ask(ENTER)
    assert bench.ask(REST)[0][1][7] == 0
    assert bench.truth()["is_on"] == 1.0


def test_cubemars_is_silent_while_it_sets_zero():
    bench = Bench(model="ak80_6_v2", initial_position_rad=1.0)
    assert len(bench.ask(ZERO)) == 1
    bench.run(1199)
    assert bench.ask(REST) == []
    bench.run(1)
    assert bench.ask(REST)[0][1][1:3] == b"\x7f\xff"


def test_mini_cheetah_sets_zero_at_rest_only():
    bench = Bench(model="mini_cheetah", initial_position_rad=1.0)
    bench.ask(ENTER)
    bench.ask(ZERO)
    assert "motor mode" in bench.events()
    assert bench.ask(REST)[0][1][1:3] == b"\x8a\x3c"
    bench.ask(LEAVE)
    bench.ask(ZERO)
    assert bench.ask(REST)[0][1][1:3] == b"\x7f\xff"


@pytest.mark.parametrize(("model", "code"), [("mini_cheetah", "3333"), ("ak80_6_v2", "FFFF")])
def test_position_beyond_the_range_wraps_or_saturates(model, code):
    bench = Bench(model=model, initial_position_rad=17.5)
    # (17.5 + 12.5) / 25 * 65535 = 78641.99.. = 13331h
    found = bench.ask(REST)[0][1][1:3].hex().upper()
    assert found == ("3331" if model == "mini_cheetah" else code)


def test_power_cycle_loses_the_turns_of_the_motor():
    # 360 degrees / 9: an AK10-9 is off by multiples of 40 degrees after a restart
    plant = {"preset": "wheel_60w", "gear_ratio": 9.0}
    bench = Bench(model="ak10_9", initial_position_rad=1.0, plant=plant)
    bench.drive.stimulate("power", 0, bench.now_ns)
    assert bench.ask(REST) == []
    bench.drive.stimulate("power", 1, bench.now_ns)
    assert bench.ask(REST) == []
    bench.run(100)
    p = int.from_bytes(bench.ask(REST)[0][1][1:3], "big") * 25 / 65535 - 12.5
    turns = (1.0 - p) / 0.6981317  # 40 degrees
    assert turns == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("data", ["", "00", "FFFFFFFFFFFFFC", "7FFF7FF0000007"])
def test_request_of_wrong_length_is_ignored_and_noted(data):
    bench = Bench()
    assert bench.ask(data) == []
    assert f"request of {len(data) // 2} bytes" in bench.events()


def test_damiao_tells_its_ranges():
    bench = Bench(model="dm4340")
    for number, value in ((21, 12.5), (22, 8.0), (23, 28.0)):
        data = bytes((1, 0, 0x33, number, 0, 0, 0, 0))
        ((can_id, told),) = bench.ask(data, 0x7FF)
        assert (can_id, told) == (0, bytes((1, 0, 0x33, number)) + struct.pack("<f", value))


def test_damiao_parameter_written_is_in_effect():
    bench = Bench(model="dm4310")
    bench.ask(bytes((1, 0, 0x55, 21)) + struct.pack("<f", 25.0), 0x7FF)
    bench.ask(REST[:0] + bytes.fromhex("FFFF7FF0000007FF"))
    assert command(bench)[0] == 25.0
    assert bench.ask(bytes((1, 0, 0x55, 10, 2, 0, 0, 0)), 0x7FF)[0][1][4] == 1  # refused
    assert "refused" in bench.events()
    assert bench.ask(bytes((2, 0, 0x33, 21, 0, 0, 0, 0)), 0x7FF) == []  # another drive's
    bench.ask(bytes((1, 0, 0x55, 7, 0x12, 0, 0, 0)), 0x7FF)
    assert bench.ask(REST)[0][0] == 0x12


def test_over_temperature_of_the_plant_is_a_fault():
    heat = {
        "thermal_resistance_winding_housing_k_w": 1.0,
        "thermal_resistance_housing_ambient_k_w": 20.0,
        "thermal_time_constant_winding_s": 0.5,
        "thermal_time_constant_motor_s": 100.0,
    }
    plant = {"preset": "wheel_60w", "stop_high_rad": 0.1, **heat, "current_max_a": 25.0}
    bench = Bench(model="ak80_64", plant=plant)
    bench.ask(ENTER)
    bench.ask("FFFF7FFFFF333FFF")  # against the stop
    while bench.truth()["is_on"] and bench.now_ns < 20_000_000_000:
        bench.run(10)
    told = bench.ask(REST)[0][1]
    assert told[7] == 1
    assert bench.truth()["is_on"] == 0.0
    bench.ask(LEAVE)
    bench.ask(ENTER)
    assert bench.ask(REST)[0][1][7] == 1  # it is still too hot
    assert bench.truth()["is_on"] == 0.0


def test_model_unknown_is_refused():
    with pytest.raises(SettingError, match="ak80_6_v2"):
        Bench(model="ak80_6")


def test_every_model_answers():
    for model in MODELS:
        assert len(Bench(model=model).ask(ENTER)) == 1
