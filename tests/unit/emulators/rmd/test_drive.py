"""An emulated RMD by hand: the maker's own frames, behaviour, faults, interruption.

Source: MyActuator, Servo Motor Control Protocol V4.2 (2024-05), with sections in brackets.
"""

from math import tau

import pytest

from motorhil.emulators.controller import SettingError
from motorhil.emulators.rmd.drive import build
from tests.support.can.bench import CanBench

NONE, CURRENT, SPEED, POSITION = range(4)
TURN = 2000 * 66  # increments of the plant preset's encoder, per turn of the output


class Rmd(CanBench):
    """A drive that has started."""

    def __init__(self, **table):
        super().__init__(build, **{"node_id": 1, "answer_s": 0.0, "restart_s": 0.001, **table})
        self.run(1)

    def ask(self, data, can_id=0x141):
        """Return the answer to a request, or None."""
        before = len(self.heard)
        self.tell(can_id, data).run(0)
        assert len(self.heard) - before <= 1
        return None if len(self.heard) == before else self.heard[-1][1:]

    def told(self, data):
        """Return the data of an answer."""
        can_id, answer = self.ask(data)
        assert can_id == 0x241
        return answer.upper()

    def degrees(self):
        return self.true("position_rad") / tau * 360.0


@pytest.fixture
def rmd():
    return Rmd()


def at(degrees, **table):
    """Return a drive whose output is at this angle."""
    return Rmd(initial_position_rad=(degrees / 360 * TURN + 0.5) / TURN * tau, **table)


ECHOED = [
    "310100000000C03F",  # write current KP 1.5 (2.2)
    "4303000010270000",  # write acceleration 10000, index 3 (2.5)
    "2002000001000000",  # filter on (2.34)
    "8000000000000000",  # shutdown (2.17)
    "8100000000000000",
    "7700000000000000",
    "7800000000000000",
    "B3000000E8030000",  # interruption 1000 ms (2.30)
]


@pytest.mark.parametrize("request_data", ECHOED)
def test_setting_is_echoed(rmd, request_data):
    assert rmd.told(request_data) == request_data


@pytest.mark.parametrize(
    ("table", "request_data", "answer"),
    [
        ({}, "3001000000000000", "300100000000803F"),  # current KP 1.0 (2.1)
        ({}, "4200000000000000", "4200000010270000"),  # position acceleration 10000 (2.4)
        ({}, "B200000000000000", "B20000002E893401"),  # date 20220206 (2.29)
        ({"model": "X8S2V10"}, "B500000000000000", "B558385332563130"),  # (2.32)
        ({}, "7000000000000000", "7000000000000000"),
        ({}, "B600000000000000", None),
        ({}, "7600000000000000", None),
        ({}, "EE00000000000000", None),
    ],
)
def test_read_has_the_answer_of_the_manual(table, request_data, answer):
    told = Rmd(**table).ask(request_data)
    assert told == (None if answer is None else (0x241, answer.lower()))


def test_multi_turn_angle_is_360_degrees():
    assert at(360).told("9200000000000000") == "92000000A08C0000"  # (2.11)
    assert at(-720).told("9200000000000000") == "92000000C0E6FEFF"


def test_single_turn_angle_is_100_degrees():
    assert at(820).told("9400000000000000") == "9400000000001027"  # (2.12)


def test_encoder_has_16384_pulses_a_turn_of_the_motor():
    assert at(360 / 66).told("6000000000000000") == "6000000000400000"
    assert at(-720 / 66).told("6000000000000000") == "600000000080FFFF"


def test_run_time_has_the_answer_of_the_manual():
    rmd = Rmd()  # it has run for 1 ms
    rmd.run(0x1000_0000 - 1)
    assert rmd.told("B100000000000000") == "B100000000000010"  # (2.28)


def test_single_turn_encoder_has_position_raw_and_offset():
    # (2.10) 9000000000000000 has the answer 90003308BE2C8B24: 2099 = 11454 - 9355
    plant = {"preset": "wheel_60w", "encoder_increments_rev": 16384}
    rmd = Rmd(plant=plant, initial_position_rad=11454.5 / 16384 / 66 * tau)
    rmd.told("63000000" + (9355).to_bytes(4, "little").hex())
    rmd.ask("7600000000000000")
    assert rmd.run(2).told("9000000000000000") == "90003308BE2C8B24"


def test_status_1_has_temperature_and_supply(rmd):
    assert rmd.told("9A00000000000000") == "9A190000F0000000"  # 25 degC, 24.0 V
    rmd.told("7700000000000000")
    assert rmd.told("9A00000000000000")[6:8] == "01"


FORWARD = {"celsius": 50, "amps": 1.0, "dps": 500, "degrees": 45}
BACKWARD = {"celsius": 50, "amps": -1.0, "dps": -500, "degrees": -45}


@pytest.mark.parametrize(
    ("state", "request_data", "answer"),
    [
        (FORWARD, "9C00000000000000", "9C326400F4012D00"),  # (2.15)
        (FORWARD, "A100000064000000", "A1326400F4012D00"),  # (2.20)
        (BACKWARD, "A10000009CFF0000", "A1329CFF0CFED3FF"),
        (FORWARD, "A200000010270000", "A2326400F4012D00"),  # (2.21)
        (BACKWARD, "A2000000F0D8FFFF", "A2329CFF0CFED3FF"),
        (FORWARD, "A400F401A08C0000", "A4326400F4012D00"),  # (2.22)
        (BACKWARD, "A400F4016073FFFF", "A4329CFF0CFED3FF"),
        (FORWARD, "A800F401A08C0000", "A8326400F4012D00"),  # (2.24)
        ({**FORWARD, "degrees": 1000.5 / 16384 / 66 * 360}, "A601F401A08C0000", "A6326400F401E803"),
        ({"degrees": 10000.5 / 16384 / 66 * 360}, "6000000000000000", "6000000010270000"),  # (2.6)
        ({"degrees": 10000.5 / 16384 / 66 * 360}, "6400000000000000", "6400000010270000"),  # (2.9)
        ({"celsius": 50, "volts": 48.5}, "9A00000000000000", "9A320001E5010400"),  # (2.14)
    ],
)
@pytest.mark.pure("the state of compiled cores cannot be replaced")
def test_drive_in_the_state_of_the_manual_has_its_answer(
    rmd, monkeypatch, state, request_data, answer
):
    """The manual states what its example drive does: 50 degC, 1 A, 500 dps, 45 degrees."""
    if "volts" in state:
        rmd.told("7700000000000000")  # the brake is open
        rmd.stimulate("fault", 0x0004)
    told = {
        "winding_temperature_c": state.get("celsius", 25),
        "dc_link_v": state.get("volts", 24.0),
        "current_a": state.get("amps", 0.0),
        "velocity_inc_s": state.get("dps", 0.0) * TURN / 360,
        "count": state.get("degrees", 0) * TURN / 360,
    }
    for name, value in told.items():
        monkeypatch.setattr(rmd.drive.axis, name, lambda value=value: value)
    assert rmd.told(request_data) == answer


GOLDEN_MOTION = "E66682E052333B55"  # 9.99 rad, 1.021 rad/s, 10.012, 1, 10.004 N m (5)


@pytest.mark.pure("the state of compiled cores cannot be replaced")
def test_motion_mode_in_the_state_of_the_manual_has_its_answer(rmd, monkeypatch):
    """The answer's codes: p E665h, v 82Eh, t B55h; the drive is in the middle of each."""
    inc_rad = TURN / tau
    told = {
        "count": ((0xE665 + 0.5) * 25 / 65535 - 12.5) * inc_rad,
        "velocity_inc_s": ((0x82E + 0.5) * 90 / 4095 - 45) * inc_rad,
        "torque_n_m": (0xB55 + 0.5) * 48 / 4095 - 24,
    }
    for name, value in told.items():
        monkeypatch.setattr(rmd.drive.axis, name, lambda value=value: value)
    assert rmd.ask(GOLDEN_MOTION, 0x401) == (0x501, "01e66582eb550000")


def motion(p=0x8000, v=0x800, kp=0, kd=0, t=0x800):
    """Return a request of motion mode, by its codes."""
    return f"{p:04X}{v:03X}{kp:03X}{kd:03X}{t:03X}"


def test_motion_mode_pulls_to_its_position_with_its_stiffness(rmd):
    one_rad = round((1.0 + 12.5) * 65535 / 25)
    rmd.ask(motion(p=one_rad, kp=0x333, kd=0x600), 0x401)  # 100 N m/rad
    rmd.run(1500)
    assert rmd.true("position_rad") == pytest.approx(1.0, abs=0.02)  # friction holds it off
    rmd.stimulate("load_torque_n_m", 5.0)
    rmd.run(1500)
    assert rmd.true("position_rad") == pytest.approx(1.0 - 5.0 / 100.0, abs=0.02)
    assert rmd.told("7000000000000000")[-2:] == "01"


def test_motion_mode_without_gains_is_a_torque(rmd):
    rmd.ask(motion(t=round((3.0 + 24) * 4095 / 48)), 0x401)
    rmd.run(20)
    torque = int(rmd.ask(motion(t=round((3.0 + 24) * 4095 / 48)), 0x401)[1][9:12], 16)
    # The motor gathers speed, and its current lags a little.
    assert torque * 48 / 4095 - 24 == pytest.approx(3.0, abs=0.1)
    assert rmd.true("velocity_rad_s") > 0.0


def test_angle_of_motion_mode_turns_over_at_its_ends():
    """13 rad is -12 rad there, for the answer as for the demand (field reports of jumps)."""
    rmd = at(13.0 / tau * 360)
    here = round((13.0 - 25.0 + 12.5) * 65535 / 25)
    _, answer = rmd.ask(motion(p=here, kp=0x333, kd=0x600), 0x401)
    assert int(answer[2:6], 16) == pytest.approx(here, abs=1)
    rmd.run(500)
    assert rmd.true("position_rad") == pytest.approx(13.0, abs=0.01)


def test_motion_mode_is_obeyed_without_a_fault_only(rmd):
    rmd.stimulate("fault", 0x0002)
    can_id, _ = rmd.ask(motion(kp=0x333), 0x401)
    assert can_id == 0x501
    assert rmd.true("mode") == NONE


def test_motion_mode_of_another_drive_is_not_heard(rmd):
    assert rmd.ask(motion(kp=0x333), 0x402) is None
    assert rmd.true("mode") == NONE


def test_first_frame_of_motion_mode_after_an_interruption_comes_back():
    rmd = Rmd(interruption_ms=20)
    rmd.ask(motion(kp=0x333), 0x401)
    rmd.run(50)
    assert rmd.true("mode") == NONE
    assert rmd.ask(motion(kp=0x333), 0x401) == (0x501, motion(kp=0x333).lower())
    assert rmd.true("mode") == NONE
    assert rmd.ask(motion(kp=0x333), 0x401)[1][:2] == "01"
    assert rmd.true("mode") == CURRENT


@pytest.mark.parametrize(
    ("request_data", "mode"),
    [
        ("A100000064000000", CURRENT),  # 1 A (2.20)
        ("A10000009CFF0000", CURRENT),
        ("A200000010270000", SPEED),  # 100 dps (2.20)
        ("A2000000F0D8FFFF", SPEED),
        ("A400F401A08C0000", POSITION),  # 360 degrees at 500 dps (2.22)
        ("A400F4016073FFFF", POSITION),
        ("A800F401A08C0000", POSITION),  # (2.24)
    ],
)
def test_motion_request_of_the_manual_is_answered_and_obeyed(rmd, request_data, mode):
    answer = rmd.told(request_data)
    assert answer[:4] == request_data[:2] + "19"
    assert rmd.true("mode") == mode
    assert rmd.told("7000000000000000")[-2:] == f"0{mode}"


def fields(answer):
    raw = bytes.fromhex(answer)
    return [int.from_bytes(raw[i : i + 2], "little", signed=True) for i in (2, 4, 6)]


def test_motion_answer_has_current_speed_and_angle(rmd):
    rmd.told("A2000000F0D8FFFF")  # -100 dps
    amps, dps, degrees = fields(rmd.run(3600).told("9C00000000000000"))
    assert dps == pytest.approx(-100, abs=1)
    assert degrees == pytest.approx(-359.5, abs=1.5)
    assert amps == pytest.approx(-16, abs=8)  # about friction / torque constant
    phases = fields(rmd.told("9D00000000000000"))
    assert phases == [amps, *(pytest.approx(-amps / 2, abs=1),) * 2]


def test_position_follows_a_trapezoid_to_its_end(rmd):
    rmd.told("A4003200A08C0000")  # 360 degrees at 50 dps
    rmd.run(3600)
    assert rmd.degrees() == pytest.approx(180, abs=3)
    assert rmd.true("velocity_rad_s") == pytest.approx(50 / 360 * tau, rel=0.02)
    rmd.run(4000)
    assert rmd.told("9200000000000000") == pytest.approx("92000000A08C0000")


def test_position_without_acceleration_is_tracked_directly(rmd):
    rmd.told("4300000000000000")
    rmd.told("A4000000E8030000")  # 10 degrees, not limited
    rmd.run(300)
    assert rmd.degrees() == pytest.approx(10, abs=0.1)


def test_increment_counts_from_the_present_position():
    rmd = at(90)
    rmd.told("A800F401A08C0000")
    rmd.run(3000)
    assert rmd.degrees() == pytest.approx(450, abs=0.1)


def test_speed_ramps_by_its_own_accelerations(rmd):
    rmd.told("43020000F4010000")  # 500 dps/s
    rmd.told("A200000050C30000")  # 500 dps is too fast for the plant; it ramps
    rmd.run(200)
    assert rmd.true("velocity_rad_s") / tau * 360 == pytest.approx(100, abs=5)


def test_stop_holds_and_shutdown_releases(rmd):
    rmd.told("A200000010270000")
    rmd.run(500).told("8100000000000000")
    rmd.run(500)
    assert (rmd.true("velocity_rad_s"), rmd.true("mode")) == (0.0, SPEED)
    rmd.told("8000000000000000")
    assert rmd.true("mode") == NONE


def test_position_limits_cut_targets(rmd):
    rmd.told("20060000E8030000")  # +10 degrees
    rmd.told("A400F401A08C0000")
    assert rmd.run(1500).degrees() == pytest.approx(10, abs=0.1)


def test_single_turn_position_needs_single_turn_mode(rmd):
    rmd.told("A601F401A08C0000")
    assert rmd.true("mode") == NONE
    rmd.told("2004000000000000")
    rmd.told("A601F40128230000")  # 90 degrees, counter-clockwise
    assert rmd.run(2000).degrees() == pytest.approx(-270, abs=0.2)


# --- requests to all


def test_all_drives_hear_280h_and_answer_with_their_own_identifier():
    for node_id in (1, 2, 32):
        rmd = Rmd(node_id=node_id)
        assert rmd.ask("8000000000000000", 0x280) == (0x240 + node_id, "80" + 14 * "0")


def test_filter_switches_280h_and_300h_off(rmd):
    rmd.told("2002000001000000")
    assert rmd.ask("8000000000000000", 0x280) is None
    assert rmd.ask("7900010000000000", 0x300) is None
    assert rmd.told("7000000000000000")


def test_id_is_read_and_written_on_300h():
    rmd = Rmd(node_id=2)
    assert rmd.ask("7900010000000000", 0x300) == (0x300, "7900010000004202")  # (4.4)
    rmd = Rmd()
    assert rmd.ask("7900000000000002", 0x300) == (0x300, "7900000000000002")
    rmd.ask("7600000000000000")
    rmd.run(2)
    assert rmd.ask("8000000000000000", 0x142) == (0x242, "8000000000000000")
    assert rmd.drive.identifiers()[0] == 0x142


# --- ROM


def test_rom_keeps_what_was_written():
    rmd = Rmd()
    rmd.told("43010000E8030000")
    rmd.told("310400000000C03F")  # RAM
    rmd.told("320500000000C03F")  # ROM
    assert rmd.true("rom_writes") == 2
    rmd.stimulate("power", 0).run(10).stimulate("power", 1).run(2)
    assert rmd.told("4201000000000000") == "42010000E8030000"
    assert rmd.told("3004000000000000") == "300400000000803F"
    assert rmd.told("3005000000000000") == "300500000000C03F"


def test_zero_acts_after_the_restart():
    rmd = at(90)
    pulses = rmd.told("6100000000000000")[8:]
    assert rmd.told("6400000000000000") == "64000000" + pulses
    assert rmd.told("9200000000000000") == "9200000028230000"  # still 90 degrees
    rmd.ask("7600000000000000")
    rmd.run(2)
    assert rmd.told("9200000000000000") in ("9200000000000000", "92000000FFFFFFFF")
    assert rmd.told("6200000000000000") == "62000000" + pulses


@pytest.mark.parametrize(("keeps", "degrees"), [(1, 400), (0, 40)])
def test_turns_are_kept_or_lost_with_the_power(keeps, degrees):
    rmd = at(400)
    rmd.told(f"200400000{keeps}000000")
    rmd.stimulate("power", 0).run(10).stimulate("power", 1).run(2)
    raw = bytes.fromhex(rmd.told("9200000000000000"))
    assert int.from_bytes(raw[4:], "little", signed=True) == pytest.approx(degrees * 100, abs=1)


@pytest.mark.parametrize("value", ["00000000", "64000000", "60EA0000"])
def test_acceleration_at_its_limits_is_taken(rmd, value):
    assert rmd.told("43000000" + value)
    assert rmd.told("4200000000000000") == "42000000" + value


@pytest.mark.parametrize("value", ["63000000", "61EA0000"])
def test_acceleration_out_of_range_is_ignored(rmd, value):
    assert rmd.ask("43000000" + value) is None
    assert rmd.true("rom_writes") == 0


# --- faults


def test_fault_of_level_1_lasts_until_the_restart(rmd):
    rmd.told("A200000010270000")
    rmd.run(100).stimulate("fault", 0x0010).run(10_000)
    assert rmd.told("9A00000000000000")[-4:] == "1000"
    assert rmd.told("A200000010270000")  # answered, not obeyed
    assert rmd.true("mode") == NONE
    rmd.ask("7600000000000000")
    assert rmd.run(0.5).ask("9A00000000000000") is None
    assert rmd.run(1).told("9A00000000000000")[-4:] == "0000"


def test_fault_of_level_2_clears_itself(rmd):
    rmd.stimulate("fault", 0x1000).run(50)
    assert rmd.told("9A00000000000000")[-4:] == "0010"
    assert rmd.run(60).told("9A00000000000000")[-4:] == "0000"


def test_stalled_motor_is_a_fault(rmd):
    rmd.stimulate("load_torque_n_m", 100.0)
    rmd.told("A4003200A08C0000")
    assert rmd.run(3000).told("9A00000000000000")[-4:] == "0200"


def test_errors_are_reported_by_themselves_if_wanted(rmd):
    rmd.told("2003000001000000")
    rmd.heard.clear()
    rmd.stimulate("fault", 0x0010).run(350)
    assert [data[:2] for *_, data in rmd.heard] == ["9a"] * 3


# --- communication interruption


def test_interruption_switches_off_and_tells_every_second():
    rmd = Rmd(interruption_ms=100)
    rmd.told("A200000010270000")
    rmd.heard.clear()
    rmd.run(1150)
    assert rmd.true("mode") == NONE
    assert [(ms, data[:2]) for ms, _, data in rmd.heard] == [(101.0, "f1"), (1101.0, "f1")]


def test_first_request_after_an_interruption_is_swallowed():
    rmd = Rmd(interruption_ms=100).run(200)
    assert rmd.told("A200000010270000") == "A200000010270000"
    assert rmd.true("mode") == NONE
    assert rmd.run(50).told("A200000010270000")[:4] == "A219"
    assert rmd.true("mode") == SPEED


def test_request_in_time_prevents_the_interruption():
    rmd = Rmd(interruption_ms=100)
    rmd.told("A200000010270000")
    for _ in range(20):
        rmd.run(99).told("9200000000000000")
    assert rmd.true("mode") == SPEED


def test_without_interruption_time_the_last_command_runs_on(rmd):
    rmd.told("A200000010270000")
    assert rmd.run(60_000).true("mode") == SPEED


# --- active replies, wrong frames


def test_active_reply_replaces_the_answer(rmd):
    assert rmd.ask("B660010100000000") is None  # 60h, on, 10 ms
    assert rmd.ask("6000000000000000") is None
    rmd.heard.clear()
    assert [data[:2] for *_, data in rmd.run(50).heard] == ["60"] * 5
    rmd.ask("B660000000000000")
    assert rmd.told("6000000000000000")


@pytest.mark.parametrize(
    ("can_id", "data"), [(0x142, "9C00000000000000"), (0x141, "9C"), (0x141, "")]
)
def test_other_frame_is_not_answered(rmd, can_id, data):
    assert rmd.ask(data, can_id) is None


def test_answer_comes_after_its_delay():
    rmd = Rmd(answer_s=0.0005)
    rmd.tell(0x141, "7000000000000000").run(0.4)
    assert rmd.heard == []
    assert rmd.run(0.2).heard == [(1.5, 0x241, "7000000000000000")]


@pytest.mark.parametrize(("name", "value"), [("fault", 0), ("load_torque_n_m", 1e10), ("x", 1)])
def test_wrong_stimulus_is_refused(rmd, name, value):
    with pytest.raises(ValueError, match=name):
        rmd.stimulate(name, value)


@pytest.mark.parametrize("table", [{"node_id": 33}, {"node_id": 0}, {"stall": 1}])
def test_wrong_setting_is_refused(table):
    with pytest.raises(SettingError):
        Rmd(**table)
