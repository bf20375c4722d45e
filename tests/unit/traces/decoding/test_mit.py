"""MIT frames and RobStride's frames in words.

The frames are the golden ones of the clients mini-cheetah-motor-driver-socketcan and robstride.
"""

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.rig.rig import Rig
from motorhil.traces.can_frame import EFF, RTR, classic
from motorhil.traces.decoding.mit import build, build_robstride
from motorhil.traces.formats.frames import Frame
from motorhil.traces.formats.registry import record_frames

AK = {"model": "ak80_6_v2", "node_id": 1}
DM = {"model": "dm4310", "node_id": 1, "master_id": 0x11}


def told(decode, can_id, data):
    message = decode(classic(can_id, bytes.fromhex(data)))
    return None if message is None else str(message)


@pytest.mark.parametrize(
    ("data", "text"),
    [
        ("FFFFFFFFFFFFFFFC", "Enter"),
        ("FFFFFFFFFFFFFFFD", "Leave"),
        ("FFFFFFFFFFFFFFFE", "Set_Zero"),
        (
            "8A3C7FF0513337FF",
            "Command: p = 0.9997 rad, v = -0.01856 rad/s, kp = 9.89 N m/rad,"
            " kd = 1 N m s/rad, t = -0.00293 N m",
        ),
        (
            "FFFFFFFFFFFFFFFF",
            "Command: p = 12.5 rad, v = 76 rad/s, kp = 500 N m/rad, kd = 5 N m s/rad, t = 12 N m",
        ),
        ("7FFF7FF0000007", "Command: not decodable: 7 bytes; 8 are needed"),
    ],
)
def test_request_is_told_in_units(data, text):
    assert told(build(1, AK), 1, data) == text


def test_answer_is_told_by_its_number():
    decode = build(1, AK)
    text = "State: p = 12.5 rad, v = -76 rad/s, t = 12 N m"
    assert told(decode, 0, "01FFFF000FFF") == text
    assert told(decode, 0, "01FFFF000FFF1902") == f"{text}, temperature = 25 deg C, fault = 2"
    assert told(decode, 0, "02FFFF000FFF") is None
    assert told(decode, 0, "") is None
    assert told(decode, 0, "0100") == "State: not decodable: 2 bytes; 6 to 8 are needed"
    assert told(decode, 0 | RTR, "") is None


def test_golden_answer_of_rmd_in_motion_mode_is_told():
    # The maker's example: 9.99 rad as sent, 1.021 rad/s, 10.004 N m; the same packing.
    ranges = {"v_max_rad_s": 45.0, "t_max_n_m": 24.0, "master_id": 0x501}
    text = "State: p = 10 rad, v = 1.022 rad/s, t = 10 N m, temperature = 0 deg C, fault = 0"
    assert told(build(1, AK | ranges), 0x501, "01E66582EB550000") == text


def test_damiao_state_and_parameters_are_told():
    decode = build(1, DM)
    said = told(decode, 0x11, "D1FFFF000FFF1920")
    assert "t = 10 N m, state = communication lost, temperature = 25 deg C, rotor = 32" in said
    assert told(decode, 0x7FF, "0100331500000000") == "Parameter 21: read"
    assert told(decode, 0x7FF, "0200331500000000") is None


def test_values_without_a_rig_are_parts_of_the_range():
    assert told(build(1), 0, "01FFFF000FFF") == (
        "State: p = 1 of range, v = -1 of range, t = 1 of range"
    )


@pytest.mark.parametrize(
    ("can_id", "data", "text"),
    [
        (0x0300AA01, "0000000000000000", "Enable"),
        (0x1100AA01, "1970000000000000", "Read 7019h: value = 00 00 00 00"),
        (0x1200AA01, "0570000002000000", "Write 7005h: value = 02 00 00 00"),
        (
            0x028001AA,
            "7FFF7FFF7FFF00FA",
            "Feedback: p = -0.0001918 rad, v = -0.0006714 rad/s, t = -0.0002594 N m,"
            " winding = 25 deg C, mode = 2, faults = 0",
        ),
        (
            0x01FFFF01,
            "FFFFFFFFFFFFFFFF",
            "Motion: p = 12.57 rad, v = 44 rad/s, kp = 500 N m/rad, kd = 5 N m s/rad, t = 17 N m",
        ),
        (0x0300AA02, "0000000000000000", None),
        (0x0300AA01, "00", "Enable: not decodable: 1 bytes; 8 are needed"),
    ],
)
def test_robstride_frame_is_told(can_id, data, text):
    decode = build_robstride(1, {"model": "rs01", "node_id": 1})
    assert told(decode, can_id | EFF, data) == text


RIG = """
[rig]
name = "a motor with MIT frames"
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.joint]
kind = "mit"
bus = "can0"
node_id = 1
model = "ak80_6_v1"
"""


def test_show_uses_the_ranges_of_the_recorded_rig(tmp_path, capsys):
    (tmp_path / "rig.toml").write_text(RIG)
    record = str(tmp_path / "a.mcap")
    import can

    with Rig.open(tmp_path / "rig.toml", record=record) as rig:
        rig.runtime.run_for(0.2)
        with can.Bus(interface="emulated", channel="can0") as bus:
            bus.send(can.Message(arbitration_id=1, data=b"\xff" * 8, is_extended_id=False))
            rig.runtime.run_for(0.1)
    assert main(["show", record, "--bus", "can0"]) == 0
    said = capsys.readouterr().out
    assert "Command: p = 95.5 rad, v = 45 rad/s" in said
    assert "State: p = " in said


def test_show_decodes_a_log_by_option(tmp_path, capsys):
    record = str(tmp_path / "b.mcap")
    record_frames(record, [Frame(0, "can0", classic(1, b"\xff" * 7 + b"\xfc"))], {})
    assert main(["show", record, "--decoder", "can0:1=mit"]) == 0
    assert "Enter" in capsys.readouterr().out
