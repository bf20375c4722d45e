"""Command line of `motorhil replay`, `run` and `demo --against`."""

import json
import shutil
from pathlib import Path

import pytest

from motorhil.harness.cli.main import main
from tests.support.golden import FOLDER
from tests.support.kit_benches import RIGS
from tests.support.recordings.altered import copied

CAN_SCRIPT = """\
import can
with can.Bus() as bus:
    ask = bytes.fromhex("4000100000000000")
    bus.send(can.Message(arbitration_id=0x601, data=ask, is_extended_id=False))
    while (heard := bus.recv(1.0)) is not None:
        if heard.arbitration_id == 0x581:
            print(heard.data.hex())
            break
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(FOLDER / "cia402.mcap", tmp_path / "bench.mcap")
    return tmp_path


CONNECT = """\
from pathlib import Path
import can
from motorhil.motorapi import ControlMode, MotorModel
from motorhil.motorapi.adaptations.cia402.motor import Cia402HwMotor, Cia402Motor
model = MotorModel.from_table({table}, path="model", line_of=lambda key: None, default_name="left")
with can.Bus() as bus:
    left = Cia402Motor(Cia402HwMotor(bus, node_id=1), model=model)
    left.set_control_mode(ControlMode.SETPOINT)
    left.set_setpoint({target})
    left.start()
    left.wait_until_done(timeout_s=5)
    print(f"{{left.position():.3f}} rad")
"""
MODEL = {
    "velocity_max_rad_s": 2.0,
    "acceleration_max_rad_s2": 4.0,
    "torque_max_n_m": 5.0,
    "current_max_a": 4.0,
    "gear_ratio": 66.0,
    "encoder_increments_rev": 2000,
    "velocity_unit_rad_s": 4.7599888690754445e-05,
    "acceleration_unit_rad_s2": 4.7599888690754445e-05,
}


def program(folder, target):
    path = folder / "move.py"
    path.write_text(CONNECT.format(table=MODEL, target=target))
    return str(path)


@pytest.mark.parametrize(
    "words", [("replay", "bench.mcap", "--as", "device", "--partial"), ("run", "bench.mcap")]
)
def test_program_matching_the_recording_passes(folder, say, words):
    status, out, err = say(*words, program(folder, 1.0))
    assert (status, out) == (0, "1.000 rad\n"), err
    assert "2 recorded controllers: " in err
    assert "commands, all answered as recorded" in err


def test_program_that_leaves_commands_out_fails_with_their_names(folder, say):
    status, out, err = say("replay", "bench.mcap", "--as", "device", program(folder, 1.0))
    assert (status, out) == (1, "1.000 rad\n")
    assert "commands of the recording never came; first:" in err
    assert "  right, at " in err


def test_deviating_program_fails_with_reason(folder, say):
    status, out, err = say("replay", "bench.mcap", "--as", "device", program(folder, 1.5))
    assert (status, out) == (1, "")
    assert "not in the recording; first:" in err
    assert "the recording cannot answer: SDO to left (1): write 607Ah target position" in err
    assert "expected, as at" in err
    assert "again: motorhil replay bench.mcap --as device" in err


def test_as_host_lists_every_object(folder, say):
    status, out, err = say("replay", "bench.mcap", "--as", "host")
    assert status == 0, err
    assert "left" in out
    assert "6064h position actual value" in out
    assert out.rstrip().endswith("0 differences, 0 times waited in vain")
    assert "100.00 % of what they tell agrees" in out


def test_as_host_with_nothing_to_compare_is_not_passed(folder, say):
    """A candump log does not tell which frames the host sent."""
    assert say("convert", str(FOLDER / "rmd.mcap"), "-o", "rmd.log")[0] == 0
    rig = str(RIGS / "rmd.toml")
    status, out, err = say("replay", "rmd.log", "--as", "host", "--rig", rig)
    assert status == 3
    assert "0 objects" in out
    assert "rmd.log: nothing was compared: no value of these devices can be compared" in err


def test_as_host_compares_positions_and_states_of_an_rmd(folder, say):
    status, out, err = say("replay", str(FOLDER / "rmd.mcap"), "--as", "host")
    assert (status, err) == (0, "")
    assert "can0, node 1 (left), absolute position answered angle [deg]" in out
    assert "16 objects and 18 not compared, 100.00 % of what they tell agrees" in out


def test_as_host_json_has_all_facts(folder, say):
    status, out, _ = say("replay", "bench.mcap", "--as", "host", "--json")
    told = json.loads(out)
    assert (status, told["differences"], told["missed"]) == (0, [], [])
    assert all(one["share"] == 1.0 for one in told["objects"])


def other_rig(folder, change):
    """Write the recording's own rig with one change."""
    from motorhil.traces.mcap.reader import read_trace

    with read_trace(folder / "bench.mcap") as trace:
        text = trace.attachments[0].data.decode()
    assert change[0] in text
    path = folder / "other.toml"
    path.write_text(text.replace(*change))
    return str(path)


def test_as_host_with_other_drive_lists_its_objects(folder, say):
    weak = 'preset = "wheel_60w", current_max_a = 0.2'
    rig = other_rig(folder, ('preset = "wheel_60w"', weak))
    status, out, _ = say("replay", "bench.mcap", "--as", "host", "--rig", rig)
    assert status == 1
    worse = [line for line in out.splitlines() if "%" in line and "100.0 %" not in line]
    assert worse
    assert any("(left)" in line for line in worse)


def test_as_host_with_missing_drive_reports_it(folder, say):
    rig = other_rig(folder, ("node_id = 2", "node_id = 3"))
    status, out, _ = say("replay", "bench.mcap", "--as", "host", "--rig", rig, "--patience", "0.2")
    assert status == 1
    assert "waited in vain: right (2) has booted" in out


@pytest.mark.parametrize("mode", [("host",), ("traffic", "--on", "can0")])
@pytest.mark.parametrize(("stamp_s", "pause"), [("4000000000.0", "4e+09"), ("52776.9", "52776.8")])
def test_replay_refuses_a_long_pause(folder, say, mode, stamp_s, pause):
    """Replay would wait for its end, with all heartbeats of the devices meanwhile."""
    (folder / "gap.log").write_text(
        f"(0.1) can0 601#4000100000000000\n({stamp_s}) can0 601#4018100100000000\n"
    )
    rig = other_rig(folder, ("wheel_60w", "wheel_60w"))
    status, _, err = say("replay", "gap.log", "--as", *mode, "--rig", rig)
    assert status == 2
    assert err.splitlines()[-1] == (
        f"gap.log: the stamp {float(stamp_s):.6f} s on can0 is {pause} s after all before it; "
        "expected at most 3600 s; correct it, or allow this pause by --max-pause"
    )


def test_max_pause_allows_longer_and_refuses_shorter(folder, say):
    rows = "(0.1) can0 123#00\n(200000.1) can0 123#01\n"
    (folder / "weekend.log").write_text(rows)
    node = '[controller.io]\nkind = "cia401"\nbus = "can0"\nnode_id = 1\n'
    (folder / "io.toml").write_text(f"[bus.can0]\nbitrate_bit_s = 1_000_000\n{node}")
    words = ("replay", "weekend.log", "--as", "traffic", "--rig", "io.toml", "--max-pause")
    status, _, err = say(*words, "199999")
    assert (status, "expected at most 199999 s" in err) == (2, True)
    status, out, err = say(*words, "200000", "--json")
    told = json.loads(out)
    assert (status, told["sent"], told["took_ns"] >= 200_000 * 10**9) == (0, {"can0": 2}, True)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("none.mcap", "--as", "device"), "none.mcap"),
        (("text.mcap", "--as", "host"), "formats are mcap, "),
        (("bench.mcap", "--as", "host", "--rig", "missing.toml"), "missing.toml"),
        (("bench.mcap", "--as", "device", "missing.py"), "missing.py"),
        (("bench.mcap", "--as", "host", "-o", "nowhere/x.mcap"), "nowhere"),
        (("silent.mcap", "--as", "host"), "holds no frame of a host"),
    ],
)
def test_unusable_input_is_reported_in_one_line(folder, say, words, told):
    (folder / "text.mcap").write_text("no recording")
    copied(
        folder / "bench.mcap",
        folder / "silent.mcap",
        lambda n, topic, t, payload: payload if topic.startswith("/motor") else None,
    )
    status, out, err = say("replay", *words)
    assert (status, out) == (2, "")
    assert told in err
    assert "Traceback" not in err
    assert len(err.splitlines()) == 1


def test_rig_may_have_one_recorded_controller(folder, say):
    rig = other_rig(
        folder,
        (
            'kind = "cia402"\nbus = "can0"\nnode_id = 1\nplant = { preset = "wheel_60w" }',
            'kind = "recorded"\nbus = "can0"\nnode_id = 1\nrecording = "bench.mcap"',
        ),
    )
    status, out, err = say("run", rig, program(folder, 1.0))
    assert (status, out) == (0, "1.000 rad\n"), err
    assert "1 recorded controller: " in err


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ('recording = "none.mcap"', "no such file"),
        ('recording = "other.toml"', "is not an MCAP file"),
        ("", "recording: is missing; write recording = "),
        ('recording = "bench.mcap"\nrecorded_bus = "can7"', "no data of node 1 on can7"),
        ('recording = "bench.mcap"\nplant = {}', "plant: unknown key"),
    ],
)
def test_wrong_recorded_table_is_reported_with_line(folder, say, line, told):
    rig = other_rig(
        folder,
        (
            'kind = "cia402"\nbus = "can0"\nnode_id = 1\nplant = { preset = "wheel_60w" }',
            f'kind = "recorded"\nbus = "can0"\nnode_id = 1\n{line}',
        ),
    )
    status, _, err = say("run", rig, program(folder, 1.0))
    assert status == 2
    assert told in err
    assert "other.toml:" in err


def test_demo_against_altered_recording_fails(tmp_path, say, monkeypatch, demo):
    monkeypatch.chdir(tmp_path)
    status, _, err = say("demo", "--against", str(demo))
    assert status == 0
    assert "14 recorded controllers: 892 commands, all answered as recorded" in err

    done = []

    def change(number, topic, time_ns, payload):
        # Alter the position of tilt (node 12) in the answer about its demand.
        is_asked = payload[1:5] == b"\x8c\x05\0\0" and payload[-8:-4] == b"\x43\x62\x60\0"
        if topic == "/can/can0" and is_asked:
            done.append(number)
            if len(done) == 6:
                return payload[:-3] + bytes([payload[-3] ^ 0x40]) + payload[-2:]
        return payload

    copied(demo, Path("altered.mcap"), change)
    status, _, err = say("demo", "--against", "altered.mcap")
    assert len(done) > 3
    assert status == 1
    assert "motorhil demo: tilt: start refused, the trajectory begins at" in err
    assert "tilt answered last: SDO tilt (12): 6062h position demand value = -20" in err
    assert "again: motorhil demo" in err


def test_imported_recording_answers_as_device(tmp_path, say, monkeypatch, shared):
    """A foreign log with two drives is imported, then queried."""
    monkeypatch.chdir(tmp_path)
    source = shared / "data" / "traffic" / "canopenlens_sample_amr_2wheel.log"
    assert say("convert", str(source), "-o", "amr.mcap")[0] == 0
    Path("ask.py").write_text(CAN_SCRIPT)
    status, out, err = say("replay", "amr.mcap", "--as", "device", "--partial", "ask.py")
    assert (status, out) == (0, "4300100000000000\n"), err  # line 5 of the log


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--as", "device", "--on", "vcan0"), "--on: not for --as device"),
        (("--as", "device", "--speed", "2", "--json"), "--speed, --json: not for --as device"),
        (("--as", "host", "move.py"), "SCRIPT: not for --as host"),
        (("--as", "traffic", "--reset"), "--reset: not for --as traffic"),
        (("--as", "host", "--node", "3"), "--node: not for --as host"),
    ],
)
def test_option_without_effect_is_refused(folder, say, words, told):
    status, out, err = say("replay", "bench.mcap", *words)
    assert (status, out) == (2, "")
    assert told in err


def test_truncated_recording_is_reported_at_power_on(folder, say):
    whole = (folder / "bench.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(whole[: len(whole) // 3])
    _, _, err = say("run", "cut.mcap", program(folder, 1.0))
    (line,) = [line for line in err.splitlines() if "cut at byte" in line]
    assert "commands behind that are not in it" in line


def test_invalid_mcap_file_is_not_read_as_a_rig(folder, say):
    (folder / "empty.mcap").write_bytes(b"")
    status, out, err = say("check", "empty.mcap")
    assert (status, out) == (2, "")
    assert "empty.mcap: is not a recording (MCAP); give a recording, or a rig file" in err


def test_demo_recording_with_eds_keeps_its_rig(tmp_path, say, monkeypatch, shared):
    """The recorded host drives drives with the same EDS file to the same result."""
    monkeypatch.chdir(tmp_path)
    eds = shared / "data" / "eds" / "technosoft_ipos.eds"
    assert say("demo", "--eds", str(eds), "-o", "e.mcap")[0] == 0
    status, out, _ = say("replay", "e.mcap", "--as", "host")
    assert status == 0
    assert "0 differences, 0 times waited in vain" in out


def test_as_traffic_reports_truncated_recording(folder, say):
    whole = (folder / "bench.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(whole[: len(whole) // 3])
    rig = other_rig(folder, ("node_id = 2", "node_id = 2"))
    status, _, err = say("replay", "cut.mcap", "--as", "traffic", "--rig", rig)
    assert status == 0
    assert "cut at byte" in err


def test_as_host_counts_unsendable_frames(folder, say):
    """One of its SDO requests is a CAN FD frame."""
    done = []

    def change(number, topic, time_ns, payload):
        if topic == "/can/can0" and payload[1:5] == b"\x01\x06\0\0" and not done:
            done.append(number)
            return payload[:5] + b"\x28\x01" + payload[5:]  # field 5, fd = true
        return payload

    copied(folder / "bench.mcap", folder / "fd.mcap", change)
    _, _, err = say("replay", "fd.mcap", "--as", "host")
    assert "fd.mcap: 1 frames of the host cannot be sent on a classical bus" in err


def test_missing_acknowledgement_is_told_at_once(tmp_path, capsys):
    """A bus without another node: the note comes before the end of the attempt."""
    (tmp_path / "alone.toml").write_text(
        '[rig]\nname = "alone"\n[bus.can0]\nbitrate_bit_s = 500_000\n'
    )
    rows = [f"({at_s:.6f}) can0 123#0102\n" for at_s in (0.0, 0.1, 5.0)]
    (tmp_path / "a.log").write_text("".join(rows))
    told = str(tmp_path / "a.mcap")
    assert main(["convert", str(tmp_path / "a.log"), "-o", told]) == 0
    capsys.readouterr()
    words = ["replay", told, "--as", "traffic", "--rig", str(tmp_path / "alone.toml")]
    assert main(words) == 1
    first, last = capsys.readouterr().err.splitlines()
    assert first.startswith("motorhil replay: can0: error passive by sending; frames need another")
    assert "can0: has taken no frame for 2 s" in last


def test_notes_name_the_file_of_the_user(folder, say):
    Path("e.log").write_text("(1.0) can0 20000080#0000000000000000\n(1.1) can0 123#01\n")
    words = ("replay", "e.log", "--as", "traffic", "--on", "virtual:named", "--speed", "max")
    status, _, err = say(*words)
    assert status == 0
    assert err.splitlines()[-1] == "e.log: 1 error frames of can0 cannot be sent"
