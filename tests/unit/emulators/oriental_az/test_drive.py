"""An AZ drive, tested through its registers.

Source: drives.md 7.1 B (an open-source client, and the description of the maker's emulator).
"""

from math import pi

import pytest

from motorhil.emulators.controller import SettingError
from motorhil.emulators.oriental_az.drive import build
from tests.support.modbus.bench import ModbusBench, Refused

BLOCK, TRIGGER, INPUTS, PULSES, OUTPUTS, ALARM = 0x0058, 0x0066, 0x007C, 0x0078, 0x007E, 0x0080
COMMAND, FEEDBACK = 0x00C6, 0x00CC
START, ZHOME, STOP, FREE, RESET = 0x08, 0x10, 0x20, 0x40, 0x80
READY, ALARM_A, MOVE, IN_POS = 0x0020, 0x0080, 0x2000, 0x4000
ABSOLUTE, TO_COMMAND, TO_FEEDBACK, CONTINUOUS, AT_ONCE = 1, 2, 3, 16, 32
GEAR = 66.0  # of the plant preset


@pytest.fixture
def bench():
    return ModbusBench(build)


def words(*values):
    return [half for value in values for half in (value >> 16 & 0xFFFF, value & 0xFFFF)]


def direct(bench, kind, position=0, hz=5000, rate=100_000, current=1000, trigger=1):
    """Return the request of direct data operation: sixteen registers, the trigger last."""
    bench.write(BLOCK, *words(0, kind, position, hz, rate, rate, current, trigger))


def outputs(bench):
    return bench.read(OUTPUTS, 2)


def test_drive_is_ready_from_power_on(bench):
    assert outputs(bench) == READY | IN_POS


@pytest.mark.parametrize("target", [3000, -7000])
def test_one_request_sets_and_starts_motion(bench, target):
    direct(bench, ABSOLUTE, target)
    assert outputs(bench) & (READY | MOVE) == MOVE
    bench.run_ms(2000)
    assert outputs(bench) == READY | IN_POS
    assert bench.read(COMMAND, 2) == target
    assert bench.read(FEEDBACK, 2) == pytest.approx(target, abs=3)
    expected_rad = target / 1000 * 2 * pi / GEAR
    assert bench.truth()["position_rad"] == pytest.approx(expected_rad, abs=0.001)


def test_motion_takes_time_of_its_trapezoid(bench):
    # 5 kHz with 100 kHz/s: a ramp of 50 ms; 2000 steps in total: 0.45 s
    direct(bench, ABSOLUTE, 2000)  # effective 7 to 9 ms after sending, of the 20 ms of the request
    bench.run_ms(450 - 20 + 5)
    assert bench.truth()["demand_inc"] < 4000
    bench.run_ms(5)
    assert bench.truth()["demand_inc"] == 4000
    assert outputs(bench) & MOVE == 0


def test_relative_to_command_adds_up_with_same_trigger(bench):
    for count in (1, 2, 3):
        direct(bench, TO_COMMAND, 500)
        bench.run_ms(600)
        assert bench.read(COMMAND, 2) == 500 * count
        assert bench.read(TRIGGER, 2) == 0  # the drive clears the trigger


def test_same_trigger_without_auto_clear_is_ignored():
    bench = ModbusBench(build, {"trigger_auto_clear": False})
    direct(bench, TO_COMMAND, 500)
    bench.run_ms(600)
    assert bench.read(TRIGGER, 2) == 1
    direct(bench, TO_COMMAND, 500)
    bench.run_ms(600)
    assert bench.read(COMMAND, 2) == 500
    bench.write(TRIGGER, *words(0))
    direct(bench, TO_COMMAND, 500)
    bench.run_ms(600)
    assert bench.read(COMMAND, 2) == 1000


def test_operation_uses_data_at_trigger(bench):
    direct(bench, ABSOLUTE, 4000)
    bench.write(0x005C, *words(9000))
    bench.run_ms(1500)
    assert bench.read(COMMAND, 2) == 4000


def test_trigger_in_motion_is_effective_at_once(bench):
    direct(bench, ABSOLUTE, 20_000)
    bench.run_ms(300)
    direct(bench, ABSOLUTE, 0)
    bench.run_ms(1500)
    assert bench.read(COMMAND, 2) == 0
    assert outputs(bench) == READY | IN_POS


def test_single_item_may_be_triggered(bench):
    direct(bench, CONTINUOUS, hz=2000)
    bench.run_ms(200)
    bench.write(0x005E, *words(4000))
    bench.run_ms(200)
    assert bench.read(0x00CA, 2) == 2000
    bench.write(TRIGGER, *words(-4))
    bench.run_ms(200)
    assert bench.read(0x00CA, 2) == 4000


def test_single_item_before_first_trigger_is_ignored(bench):
    bench.write(TRIGGER, *words(-4))
    assert "trigger -4 ignored: nothing was triggered before" in bench.told()


@pytest.mark.parametrize(("kind", "ramp_ms"), [(0, 50), (AT_ONCE, 1)])
def test_stop_follows_operation_type(bench, kind, ramp_ms):
    direct(bench, CONTINUOUS, hz=-5000)
    bench.run_ms(300)
    assert outputs(bench) & MOVE
    before = bench.read(COMMAND, 2)
    direct(bench, kind)
    bench.run_ms(200)
    assert outputs(bench) & (MOVE | READY) == READY
    # 5 steps per ms for about 21 ms between the reading and the stop, then the ramp
    assert before - bench.read(COMMAND, 2) == pytest.approx(5 * 22 + 5 * ramp_ms / 2, abs=25)


def test_stored_operation_data_are_started_by_input(bench):
    bench.write(0x1880, *words(ABSOLUTE, 1500, 5000, 100_000, 100_000, 1000))  # number 2
    bench.write(INPUTS, *words(2))
    bench.write(INPUTS, *words(2 | START))
    bench.run_ms(800)
    assert bench.read(COMMAND, 2) == 1500
    bench.write(0x1882, *words(0))
    bench.run_ms(500)
    assert bench.read(COMMAND, 2) == 1500  # START is an edge
    bench.write(INPUTS, *words(2))
    bench.write(INPUTS, *words(2 | START))
    bench.run_ms(800)
    assert bench.read(COMMAND, 2) == 0


def test_pulsed_input_goes_off_by_itself(bench):
    bench.write(0x1800, *words(TO_COMMAND, 300, 5000, 100_000, 100_000, 1000))
    for count in (1, 2):
        bench.write(PULSES, *words(START))
        bench.run_ms(500)
        assert bench.read(PULSES, 2) == 0
        assert bench.read(COMMAND, 2) == 300 * count


def test_stop_input_holds_motor(bench):
    direct(bench, ABSOLUTE, 20_000)
    bench.run_ms(200)
    bench.write(INPUTS, *words(STOP))
    bench.run_ms(300)
    stopped = bench.read(COMMAND, 2)
    assert 0 < stopped < 20_000
    assert outputs(bench) & (MOVE | READY) == 0
    direct(bench, ABSOLUTE, 20_000)
    bench.run_ms(300)
    assert bench.read(COMMAND, 2) == stopped
    bench.write(INPUTS, *words(0))
    direct(bench, ABSOLUTE, 0)
    bench.run_ms(1500)
    assert bench.read(COMMAND, 2) == 0


def test_free_input_removes_current(bench):
    bench.write(INPUTS, *words(FREE))
    assert outputs(bench) == 0
    bench.run_ms(50)
    assert bench.truth()["current_a"] == 0.0
    direct(bench, ABSOLUTE, 1000)
    bench.run_ms(300)
    assert bench.read(COMMAND, 2) == 0
    bench.write(INPUTS, *words(0))
    assert outputs(bench) & READY


def test_home_input_moves_to_encoder_zero(bench):
    direct(bench, ABSOLUTE, 3000)
    bench.run_ms(1500)
    bench.write(PULSES, *words(ZHOME))
    bench.run_ms(1500)
    assert bench.read(COMMAND, 2) == 0
    assert outputs(bench) & 0x0010


def test_present_position_may_be_set_to_zero(bench):
    direct(bench, ABSOLUTE, 3000)
    bench.run_ms(1500)
    bench.write(0x018A, *words(1))
    assert abs(bench.read(FEEDBACK, 2)) <= 1


def test_power_cycle_keeps_position_and_drops_operations(bench):
    direct(bench, ABSOLUTE, 3000)
    bench.run_ms(1500)
    bench.stimulate("power", 0)
    bench.run_ms(100)
    bench.stimulate("power", 1)
    bench.run_ms(700)
    assert bench.read(FEEDBACK, 2) == pytest.approx(3000, abs=3)
    assert bench.read(0x005C, 2) == 0


def test_alarm_removes_current_until_reset(bench):
    bench.stimulate("alarm", 0x22)
    assert outputs(bench) & (ALARM_A | READY) == ALARM_A
    assert bench.read(ALARM, 2) == 0x22
    direct(bench, ABSOLUTE, 1000)
    bench.run_ms(300)
    assert bench.read(COMMAND, 2) == bench.read(FEEDBACK, 2)
    bench.write(PULSES, *words(RESET))
    assert outputs(bench) & (ALARM_A | READY) == READY
    assert "alarm 22h (overvoltage)" in bench.told()


def test_excessive_load_causes_excessive_deviation(bench):
    bench.stimulate("load_torque_n_m", 40.0)
    direct(bench, ABSOLUTE, 20_000)
    bench.run_ms(2000)
    assert bench.read(ALARM, 2) == 0x10


def test_operating_current_limits_torque(bench):
    direct(bench, ABSOLUTE, 20_000, current=100, rate=10_000_000)
    bench.run_ms(30)
    assert bench.truth()["current_a"] <= 0.81
    assert bench.read(COMMAND, 2) > 0


def test_electronic_gear_sets_steps_per_turn(bench):
    bench.write(0x0382, *words(10))
    direct(bench, ABSOLUTE, 10_000, hz=50_000, rate=1_000_000)
    bench.run_ms(1500)
    assert bench.truth()["demand_inc"] == 2000


@pytest.mark.parametrize(
    ("pdu", "code"),
    [
        ("06 007F 0001", "02h"),  # read-only
        ("10 0066 0002 04 0000 0002", "03h"),  # unknown trigger
        ("10 0064 0002 04 0000 03E9", "03h"),  # 100.1 %
        ("03 0057 0002", "02h"),
        ("11", "01h"),
    ],
)
def test_unsupported_request_is_refused(bench, pdu, code):
    with pytest.raises(Refused, match=code):
        bench.ask(pdu)


def test_unknown_operation_type_is_ignored_and_reported(bench):
    direct(bench, 7)
    assert "operation type 7 ignored: it has no such" in bench.told()


def test_register_map_has_addresses_of_block():
    at = {row.name: row.address for row in build.registers()}
    assert [at[name] for name in ("operation_type", "speed", "trigger", "outputs", "alarm")] == [
        *(0x5A, 0x5E, 0x66, 0x7E, 0x80)
    ]
    assert at["data7_current"] == 0x1800 + 7 * 0x40 + 10


def test_wrong_setting_is_refused_with_its_keys():
    with pytest.raises(SettingError) as caught:
        ModbusBench(build, {"trigger_auto_clear": 1})
    assert caught.value.path == ("trigger_auto_clear",)


def held(bench):
    """Return a bench with a load that a tenth of the current holds but cannot lift as commanded."""
    bench.stimulate("load_torque_n_m", 1.5)
    direct(bench, ABSOLUTE, 100, current=100)
    bench.run_ms(300)
    assert bench.read(COMMAND, 2) == 100
    assert bench.truth()["current_a"] == pytest.approx(0.8, abs=0.01)
    assert bench.read(FEEDBACK, 2) < 50


@pytest.mark.parametrize(("kind", "ends_at_command"), [(TO_COMMAND, True), (TO_FEEDBACK, False)])
def test_relative_motion_starts_from_command_or_feedback(bench, kind, ends_at_command):
    held(bench)
    direct(bench, kind, 0)
    bench.run_ms(300)
    assert (bench.read(COMMAND, 2) == 100) is ends_at_command


def test_constant_inputs_have_no_new_effect(bench):
    bench.write(0x1800, *words(TO_COMMAND, 300, 5000, 100_000, 100_000, 1000))
    for _ in range(2):
        bench.write(INPUTS, *words(START))
        bench.run_ms(500)
    assert bench.read(COMMAND, 2) == 300


def test_power_cycle_drops_earlier_trigger(bench):
    direct(bench, ABSOLUTE, 500)
    bench.stimulate("power", 0)
    bench.stimulate("power", 1)
    bench.run_ms(600)
    bench.write(TRIGGER, *words(-5))
    assert "trigger -5 ignored: nothing was triggered before" in bench.told()


def test_drive_is_silent_before_boot_and_without_power():
    bench = ModbusBench(build, boot=False)
    with pytest.raises(ValueError, match="not enough values"):
        outputs(bench)
    bench.run_ms(600)
    bench.stimulate("load_torque_n_m", 2.0)
    bench.run_ms(100)
    assert bench.truth()["current_a"] > 0.5
    bench.stimulate("power", 0)
    bench.run_ms(20)
    assert bench.truth()["current_a"] == 0.0
