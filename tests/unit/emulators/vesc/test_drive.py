"""An emulated VESC by hand: golden frames of the firmware's layouts, modes, faults, timeout.

Source: vedderb/bldc b9d287b3 (firmware 7.01); frames marked "pybldc" are those of pybldc 1.1.0.
"""

from binascii import crc_hqx
from math import tau

import pytest

from motorhil.emulators.controller import SettingError
from motorhil.emulators.vesc.drive import build
from motorhil.emulators.vesc.packets import frames_of
from tests.support.can.bench import EXTENDED, CanBench

NODE = 23
OFF, CURRENT, BRAKE, HANDBRAKE, DUTY, SPEED, POSITION = range(7)
GEAR, SUPPLY_V, KT, R = 66.0, 24.0, 0.0259, 0.611  # of the plant preset


class Vesc(CanBench):
    def __init__(self, **table):
        super().__init__(build, node_id=NODE, **table)

    def tell(self, can_id, data="", flags=EXTENDED):
        return super().tell(can_id, data, flags)

    def ask(self, can_id, data="", flags=EXTENDED):
        return super().ask(can_id, data, flags)

    def command(self, number, value):
        return self.tell(number << 8 | NODE, (value & 0xFFFFFFFF).to_bytes(4, "big").hex())

    def erpm(self):
        return self.true("velocity_rad_s") * GEAR / tau * 60.0 * 7


@pytest.fixture
def vesc():
    return Vesc(timeout_s=0.0)


# --- golden frames


@pytest.mark.parametrize(
    ("can_id", "data", "mode"),
    [
        (0x117, "0000C738", CURRENT),  # 51 A
        (0x017, "00004E20", DUTY),  # 0.2
        (0x217, "00001388", BRAKE),  # 5 A
        (0x317, "00000BB8", SPEED),  # 3000 erpm
        (0x417, "055D4A80", POSITION),  # 90 degrees
        (0xA17, "FFFF3CB0", CURRENT),  # relative -0.5
        (0xB17, "00004E20", BRAKE),
        (0xC17, "00001388", HANDBRAKE),
        (0xD17, "00004E20", HANDBRAKE),
        (0x1FF, "0000C738", CURRENT),  # to all controllers
    ],
)
def test_command_frame_switches_mode_at_once(vesc, can_id, data, mode):
    assert vesc.ask(can_id, data) == []  # no command is acknowledged
    assert vesc.true("mode") == mode
    assert vesc.events == []


@pytest.mark.parametrize(
    ("number", "value", "what", "expected"),
    [
        (1, 1000, "current_a", 1.0),
        (1, -1000, "current_a", -1.0),
        (10, 25_000, "current_a", 2.0),  # of the plant's 8 A
        (1, 0x7FFFFFFF, "current_a", 8.0),
        (3, 21_000, "velocity_rad_s", 3000 / 60 * tau / GEAR),
        (3, -21_000, "velocity_rad_s", -3000 / 60 * tau / GEAR),
    ],
)
def test_command_reaches_value_in_its_scale(vesc, number, value, what, expected):
    vesc.command(number, value).run(3 if number != 3 else 1500)
    assert vesc.true(what) == pytest.approx(expected, rel=0.02)


def test_ping_is_answered_to_the_sender(vesc):
    assert vesc.ask(0x1117, "FD") == [(0x12FD, "1700")]  # pybldc


def test_position_is_answered_under_own_id():
    vesc = Vesc(initial_position_rad=tau / GEAR / 3.999)
    assert vesc.ask(0x3817) == [(0x3817, "00895440")]  # 90 degrees * 1e5


def test_boot_is_notified_once_after_half_a_second():
    vesc = Vesc(hardware="75_300_R2_X").run(3000)
    assert vesc.heard == [(500.0, 0x3917, b"75_300_R".hex())]


def test_status_frames_are_off_by_default(vesc):
    vesc.run(2000)
    assert [can_id for _, can_id, _ in vesc.heard] == [0x3917]


def test_status_frames_come_in_order_at_their_rates():
    vesc = Vesc(status_1=0b011001, status_2=0b100110).run(190)
    ids = [(ms, can_id) for ms, can_id, _ in vesc.heard]
    first = [(ms, can_id) for ms in range(0, 181, 20) for can_id in (0x917, 0x1017, 0x1B17)]
    second = [(0, can_id) for can_id in (0xE17, 0xF17, 0x3A17)]
    assert sorted(ids) == sorted(first + second)
    assert all(len(data) == 16 for *_, data in vesc.heard)


def test_status_has_erpm_current_and_duty():
    vesc = Vesc(status_1=1, status_rate_1_hz=10, timeout_s=0.0)
    vesc.command(3, -21_000).run(1999)
    *_, (_, _, data) = [one for one in vesc.heard if one[1] == 0x917]
    raw = bytes.fromhex(data)
    erpm, amps, duty = (
        int.from_bytes(raw[i:j], "big", signed=True) for i, j in ((0, 4), (4, 6), (6, 8))
    )
    assert erpm == pytest.approx(-21_000, abs=300)
    assert amps == pytest.approx(-0.154 * 10, abs=2)  # friction / torque constant
    assert duty == pytest.approx(-(3000 / 60 * tau * KT + 0.154 * R) / SUPPLY_V * 1000, abs=8)


@pytest.mark.parametrize(
    ("status", "state", "can_id", "data"),
    [
        # -3000 ERPM, -12.5 A, duty -0.321: the supply for that duty
        (
            1,
            {
                "velocity_inc_s": -3000.01 / 7 / 60 * 2000,
                "current_a": -12.5,
                "dc_link_v": (3000 / 7 / 60 * tau * KT + 12.5 * R) / 0.3214,
            },
            *(0x917, "FFFFF448FF83FEBF"),
        ),
        # 25.3 and -100.5 degC, 1.2 A of the supply, 359.9 degrees
        (
            8,
            {
                "winding_temperature_c": -100.5,
                "current_a": (1.201 * SUPPLY_V / R) ** 0.5,
                "velocity_inc_s": 0.0,
                "count": 2000 * 359.9001 / 360,
            },
            *(0x1017, "00FDFC13000C464B"),
        ),
        # tachometer -42, 48.1 V
        (16, {"count": -2000, "dc_link_v": 48.1}, *(0x1B17, "FFFFFFD601E10000")),
    ],
)
@pytest.mark.pure("the state of compiled cores cannot be replaced")
def test_status_in_the_state_of_the_golden_frame_is_that_frame(
    monkeypatch, status, state, can_id, data
):
    plant = {
        "preset": "wheel_60w",
        "ambient_c": 25.3,
        "thermal_resistance_winding_housing_k_w": 1.7,
        "thermal_resistance_housing_ambient_k_w": 3.2,
        "thermal_time_constant_winding_s": 16.2,
        "thermal_time_constant_motor_s": 714.0,
    }
    vesc = Vesc(status_1=status, plant=plant, timeout_s=0.0)
    vesc.command(1, 500)  # a mode, in which there is a duty
    for name, value in state.items():
        monkeypatch.setattr(vesc.drive.axis, name, lambda value=value: value)
    vesc.heard.clear()
    vesc.run(25)
    assert (can_id, data) in [(one, told.upper()) for _, one, told in vesc.heard]


def test_status_4_has_temperatures_and_angle():
    vesc = Vesc(status_1=8, initial_position_rad=-0.1 / 360 * tau / GEAR)
    (_, can_id, data) = vesc.heard[0] if vesc.heard else vesc.run(0).heard[0]
    assert can_id == 0x1017
    assert data[:12] == "00fa00fa0000"  # 25.0 and 25.0 degC, 0 A
    assert int(data[12:], 16) == pytest.approx(359.9 * 50, abs=9)


def test_status_5_has_tachometer_and_volts():
    vesc = Vesc(status_1=16, initial_position_rad=1.0)
    assert vesc.run(0).heard == [(0.0, 0x1B17, "0000000000f00000")]  # counts from power-on, 24 V
    vesc.command(1, -500).run(500)
    turns = (vesc.true("position_rad") - 1.0) * GEAR / tau
    *_, (_, _, data) = vesc.run(20).tell(0x117, "00000000").heard
    assert int.from_bytes(bytes.fromhex(data[:8]), "big", signed=True) <= turns * 42 < 0


# --- packets


def packet(payload, sender=0xFD, mode=0):
    """Return the frames of a long packet, as the firmware's documentation has them."""
    frames, at = [], 0
    while at < len(payload):
        if at < 256:
            frames.append((0x517, f"{at:02X}" + payload[at : at + 7].hex().upper()))
            at += 7
        else:
            frames.append((0x617, f"{at:04X}" + payload[at : at + 6].hex().upper()))
            at += 6
    end = f"{sender:02X}{mode:02X}{len(payload):04X}{crc_hqx(payload, 0):04X}"
    return [*frames, (0x717, end)]


def test_packet_of_19_bytes_is_that_of_pybldc(vesc):
    frames = [
        (0x517, "0001020304050607"),
        (0x517, "0708090A0B0C0D0E"),
        (0x517, "0E0F10111213"),
        (0x717, "FD000013ACCC"),
    ]
    assert packet(bytes(range(1, 20))) == frames
    for can_id, data in frames:
        vesc.tell(can_id, data)
    assert vesc.events == [("warning", "packet 1 is not emulated")]  # reassembled, CRC and all


def test_packet_of_301_bytes_uses_long_fragments(vesc):
    frames = packet(b"\x14" + b"\x41" * 300)
    assert (0x517, "FC41414141414141") in frames
    assert (0x617, "0103414141414141") in frames
    assert frames[-1] == (0x717, "FD00012D6151")
    for can_id, data in frames:
        vesc.tell(can_id, data)
    assert vesc.events == [("warning", "packet 20 is not emulated")]


@pytest.mark.parametrize("length", [7, 19, 252, 253, 259, 260, 301, 512])
def test_answer_of_any_length_is_cut_like_a_request(length):
    payload = bytes(i * 7 & 0xFF for i in range(length))
    told = [(one << 8 | 0x17, data.hex().upper()) for one, data in frames_of(payload, 0xFD, 0)]
    assert told == packet(payload)


def reassembled(frames, sender=0xFD):
    """Return the packet in the frames of an answer to `sender`."""
    payload = b""
    for can_id, data in frames:
        assert can_id & 0xFF == sender
        raw = bytes.fromhex(data)
        if can_id >> 8 == 5:
            assert raw[0] == len(payload)
            payload += raw[1:]
        elif can_id >> 8 == 7:
            assert raw[:2] == bytes((NODE, 1))
            assert int.from_bytes(raw[2:4], "big") == len(payload)
            assert int.from_bytes(raw[4:], "big") == crc_hqx(payload, 0)
    return payload


def test_get_values_has_74_bytes_in_fragments(vesc):
    answer = reassembled(vesc.ask(0x817, "FD0004"))
    assert len(answer) == 74
    assert answer[0] == 4
    assert answer[27:29].hex() == "00f0"  # 24.0 V, bit 8
    assert answer[58] == NODE  # bit 17


def test_firmware_version_has_name_and_version():
    answer = reassembled(Vesc(hardware="60").ask(0x817, "FD0000"))
    assert answer[:6] == b"\x00\x07\x0160\x00"
    assert len(answer) == 6 + 12 + 8 + 1 + 4


def test_fault_is_read_in_one_frame(vesc):
    vesc.stimulate("fault", 5)
    frames = packet(bytes((50, 0, 0, 0x80, 0)))
    assert len(frames) == 2
    assert vesc.ask(0x817, "FD003200008000") == [(0x8FD, "17013200008000" + "05")]
    assert vesc.ask(0x817, "FD033200008000") == [(0x8FD, "17003200008000" + "05")]  # mode 3
    assert vesc.ask(0x817, "FD023200008000") == []
    assert vesc.ask(0x817, "FD013200008000") == []  # an answer, not a request


def test_packet_with_wrong_crc_is_dropped(vesc):
    *fill, (end, data) = packet(bytes(range(1, 20)))
    for can_id, part in fill:
        vesc.tell(can_id, part)
    vesc.tell(end, data[:-1] + "D")
    assert [level for level, _ in vesc.events] == ["warning"]
    for can_id, part in packet(bytes((5,)) + (20_000).to_bytes(4, "big") + bytes(9)):
        vesc.tell(can_id, part)
    assert vesc.true("mode") == DUTY


def test_two_senders_fill_packets_at_the_same_time(vesc):
    first = packet(bytes((6,)) + (2000).to_bytes(4, "big") + bytes(12), sender=0xFD)
    second = packet(bytes((5,)) + (20_000).to_bytes(4, "big") + bytes(4), sender=0xFE)
    vesc.tell(*first[0]).tell(*second[0]).tell(*first[1])
    vesc.tell(*second[1])  # 2 bytes at offset 7: the first buffer ends at 14
    vesc.tell(*second[2])
    assert vesc.true("mode") == DUTY


def test_lost_fragment_empties_the_buffers(vesc):
    frames = packet(bytes(range(1, 20)))
    vesc.tell(*frames[0]).tell(*frames[2]).tell(*frames[3])
    assert len(vesc.events) == 2  # the fragment, then the whole packet


def test_packet_of_more_than_512_bytes_is_dropped(vesc):
    for can_id, data in packet(b"\x04" + bytes(520)):
        vesc.tell(can_id, data)
    assert "a packet of 521 bytes is dropped" in vesc.events[-1][1]


# --- traps


def test_current_of_6_bytes_is_misread(vesc):
    vesc.tell(0x117, "0000C73801F4")  # 51 A, 0.5 s: as the firmware's own sender orders them
    assert vesc.true("mode") == CURRENT
    assert vesc.run(5).true("current_a") == pytest.approx(-8.0, rel=0.03)  # cut to the limit
    assert "6 bytes" in vesc.events[0][1]


def test_short_frame_is_filled_with_zeros(vesc):
    vesc.tell(0x317, "0001")
    assert vesc.true("mode") == SPEED
    assert "2 of 4 bytes" in vesc.events[0][1]


@pytest.mark.parametrize("can_id", [0x10117, 0x118, 0x1000_0117])
def test_frame_with_other_identifier_is_ignored(vesc, can_id):
    assert vesc.tell(can_id, "0000C738").true("mode") == OFF


def test_frame_of_11_bits_is_ignored(vesc):
    assert vesc.tell(0x117, "0000C738", flags=0).true("mode") == OFF


def test_small_current_releases_the_motor(vesc):
    vesc.command(1, 49)
    assert vesc.true("mode") == OFF
    vesc.command(1, 1000).command(1, 0)
    assert vesc.true("mode") == OFF


def test_relative_current_against_the_motion_is_of_the_brake_limit(vesc):
    vesc.tell(0x1517, "FFFFF060000007D0")  # -4 A, 2 A
    vesc.command(3, 21_000).run(1500).command(10, -50_000).run(5)
    assert vesc.true("current_a") == pytest.approx(-2.0, rel=0.05)


def test_speed_ramps_from_the_speed_of_a_turning_motor(vesc):
    vesc.command(0, 1360).run(500)
    assert vesc.erpm() == pytest.approx(600, abs=150)
    vesc.command(3, 3000).run(40)
    assert vesc.erpm() == pytest.approx(1600, abs=250)  # not 1000, as from rest


def test_brake_never_drives(vesc):
    vesc.command(2, 5000).run(500)
    assert vesc.true("velocity_rad_s") == 0.0
    vesc.command(3, 21_000).run(1500).command(2, -5000).run(300)
    assert vesc.true("velocity_rad_s") == 0.0


def test_speed_below_900_erpm_does_not_start(vesc):
    vesc.command(3, 899).run(500)
    assert vesc.true("velocity_rad_s") == 0.0
    vesc.command(3, 900).run(500)
    assert vesc.erpm() == pytest.approx(900, abs=30)


def test_speed_ramps_with_25000_erpm_a_second(vesc):
    vesc.command(3, 20_000).run(30)
    assert vesc.true("velocity_rad_s") == 0.0  # the set-point is below 900
    vesc.run(370)
    assert vesc.erpm() == pytest.approx(10_000, rel=0.05)
    vesc.command(3, 20_000).run(600)  # repeated: the ramp goes on
    assert vesc.erpm() == pytest.approx(20_000, rel=0.03)


def test_speed_reverses_through_the_shorted_range(vesc):
    vesc.command(3, 5000).run(1000).command(3, -5000).run(1000)
    assert vesc.erpm() == pytest.approx(-5000, rel=0.05)


def test_speed_command_takes_a_coasting_motor_over(vesc):
    vesc.command(3, 20_000).run(1500).command(1, 0)
    speed = vesc.erpm()
    vesc.command(3, 20_000).run(5)
    assert vesc.erpm() == pytest.approx(speed, rel=0.05)


def test_duty_is_a_share_of_the_supply(vesc):
    vesc.command(0, 20_000).run(1500)
    friction_v = 4.0e-3 / KT * R
    assert vesc.erpm() * tau / 60 / 7 * KT == pytest.approx(0.2 * SUPPLY_V - friction_v, rel=0.03)
    vesc.command(0, 400)
    assert vesc.true("mode") == OFF


def angle(vesc):
    return vesc.true("position_rad") * GEAR / tau * 360.0


@pytest.mark.parametrize(("degrees", "at"), [(90, 90), (179, 179), (181, -179), (270, -90)])
def test_position_turns_the_shorter_way(vesc, degrees, at):
    vesc.command(4, degrees * 1_000_000).run(1000)
    assert angle(vesc) == pytest.approx(at, abs=1.0)  # no integrator: friction stays


def test_position_goes_on_over_turns_in_small_steps(vesc):
    for degrees in range(0, 1081, 60):
        vesc.command(4, degrees % 360 * 1_000_000).run(100)
    vesc.run(500)
    assert angle(vesc) == pytest.approx(1080, abs=1.0)


def test_position_divider_spans_turns_of_the_motor():
    vesc = Vesc(position_divider=8, position_kp=0.2, position_kd=0.0028, timeout_s=0.0)
    vesc.command(4, 90_000_000).run(1500)
    assert angle(vesc) == pytest.approx(720, abs=1.0)


def test_position_offset_renames_the_present_angle(vesc):
    vesc.tell(0x3717, (45 * 10_000).to_bytes(4, "big").hex() + "00")
    assert vesc.ask(0x3817) == [(0x3817, (45 * 100_000).to_bytes(4, "big").hex())]


def test_current_limits_are_configured(vesc):
    vesc.tell(0x1517, "FFFFFC18000007D0")  # -1 A, 2 A
    assert vesc.command(1, 9000).run(5).true("current_a") == pytest.approx(2.0, rel=0.03)
    assert vesc.command(1, -9000).run(5).true("current_a") == pytest.approx(-1.0, rel=0.03)


# --- faults


def test_fault_clears_itself_after_half_a_second(vesc):
    vesc.command(3, 21_000).run(500).stimulate("fault", 3)
    assert vesc.true("mode") == OFF
    vesc.run(499).command(1, 1000)
    assert (vesc.true("mode"), vesc.true("fault")) == (OFF, 3)  # the command is lost
    vesc.run(1)
    assert (vesc.true("mode"), vesc.true("fault")) == (OFF, 0)
    assert vesc.command(1, 1000).true("mode") == CURRENT


def test_fault_lasts_while_its_cause_lasts():
    link = {"source_resistance_ohm": 0.1, "dc_link_capacitance_f": 0.001, "dc_link_bleed_ohm": 50}
    vesc = Vesc(plant={"preset": "wheel_60w", **link}, timeout_s=0.0)
    vesc.stimulate("supply_v", 7.0).run(1000)
    assert vesc.true("fault") == 2
    vesc.stimulate("supply_v", 24.0).run(450)
    assert vesc.true("fault") == 2
    vesc.run(200)
    assert vesc.true("fault") == 0


def test_commands_in_a_fault_feed_the_timeout():
    vesc = Vesc().run(990).stimulate("fault", 3).command(1, 1000).run(500)
    assert vesc.true("timeout") == 0


def test_estop_drops_commands_without_a_fault(vesc):
    vesc.command(1, 1000).tell(0x817, "FD009F0064")  # 100 ms
    assert vesc.command(1, 1000).run(99).true("mode") == OFF
    assert vesc.run(1).command(1, 1000).true("mode") == CURRENT
    assert vesc.true("fault") == 0


# --- timeout


def test_uncommanded_drive_is_in_timeout_after_a_second():
    vesc = Vesc().run(1009)
    assert vesc.true("timeout") == 0
    assert vesc.run(1).true("timeout") == 1  # the check each 10 ms sees more than 1000 ms


def test_timeout_releases_and_next_command_ends_it():
    vesc = Vesc().command(1, 1000).run(1010)
    assert (vesc.true("mode"), vesc.true("timeout")) == (OFF, 1)
    assert vesc.command(1, 1000).true("mode") == CURRENT
    assert vesc.true("timeout") == 0


def test_timeout_brakes_with_configured_current():
    vesc = Vesc(timeout_brake_a=4.0).command(3, 21_000).run(900).command(3, 21_000).run(1400)
    assert vesc.true("mode") == BRAKE
    assert vesc.true("velocity_rad_s") == 0.0


def test_alive_feeds_the_timeout():
    vesc = Vesc().command(1, 1000)
    for _ in range(30):
        vesc.run(100).tell(0x817, "FD021E")
    assert vesc.true("mode") == CURRENT


@pytest.mark.parametrize("packet_data", ["FD0004", "FD0000"])
def test_reading_does_not_feed_the_timeout(packet_data):
    vesc = Vesc().command(1, 1000)
    for _ in range(12):
        vesc.run(100).tell(0x817, packet_data)
    assert vesc.true("timeout") == 1


def test_reboot_begins_anew():
    vesc = Vesc().command(1, 1000).run(100).tell(0x817, "FD001D")
    assert vesc.true("mode") == OFF
    vesc.run(500)
    assert vesc.heard == [(600.0, 0x3917, b"60".hex())]


def test_drive_without_power_is_silent(vesc):
    vesc.command(1, 1000).stimulate("power", 0).run(2000)
    assert vesc.ask(0x1117, "FD") == []
    assert vesc.true("mode") == OFF
    assert vesc.stimulate("power", 1).ask(0x1117, "FD") == [(0x12FD, "1700")]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("fault", 34, r"fault = 34: out of range; expected 1 to 33"),
        ("load_torque_n_m", 1e10, "out of range"),
        ("switch", 1, "no stimulus 'switch'; known: load_torque_n_m"),
    ],
)
def test_wrong_stimulus_is_refused(vesc, name, value, message):
    with pytest.raises(ValueError, match=message):
        vesc.stimulate(name, value)


@pytest.mark.parametrize("table", [{"node_id": 255}, {"status_1": 64}, {"pole_pair": 7}])
def test_wrong_setting_is_refused(table):
    with pytest.raises(SettingError):
        CanBench(build, **{"node_id": 1, **table})
