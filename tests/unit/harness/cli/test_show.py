import argparse
import json

import pytest

from motorhil.harness.cli import show
from motorhil.harness.cli.main import main
from motorhil.harness.cli.options import time_ns
from motorhil.traces.mcap.reader import Trace
from motorhil.traces.schema import GROUP_SYNC, MOTOR_LOCK
from tests.support.recordings.handmade import MS, Recorded, S


@pytest.fixture
def recording(tmp_path):
    one = Recorded(tmp_path / "one.mcap")
    one.frame(1 * MS, 0x701, "00").frame(2 * MS, 0x702, "00")
    lock = {"action": 1, "owner": "start() of left_wheel"}
    one.message(3 * MS, "/motor/left_wheel/lock", MOTOR_LOCK, lock)
    for at, data in enumerate(("2F001A0000", "23001A0110004160", "2F001A0001")):  # TPDO 1: 6041h
        one.frame((4 + at) * MS, 0x601, data.ljust(16, "0"))
        one.frame((4 + at) * MS + 1, 0x581, "60" + data[2:8] + "00000000")
    one.frame(7 * MS, 0x000, "0100")
    one.frame(8 * MS, 0x701, "05").frame(9 * MS, 0x181, "3702").frame(10 * MS, 0x701, "05")
    one.frame(11 * MS, 0x182, "1802").event(12 * MS, "it is hot", "right_wheel")
    one.frame(13 * MS, 0x601, "4020200000000000").frame(14 * MS, 0x581, "4320200019000000")
    sync = {"phase": 1, "motor": ["left_wheel", "right_wheel"], "skew_s": 0.0001, "method": "SYNC"}
    one.message(15 * MS, "/group/drive/sync", GROUP_SYNC, sync)
    one.modbus(16 * MS, "0001000000060303006B0001", True)
    one.modbus(18 * MS, "00010000000503030200FF", False)
    one.frame(19 * MS, 0x601, "4008100000000000")
    one.frame(20 * S, 0x181, "1802").frame(20 * S + 1, 0x581, "0D61000000000000")
    return one.close()


def shown(capsys, *words):
    parser = argparse.ArgumentParser()
    show.add_arguments(parser)
    assert show.run(parser.parse_args(words)) == 0
    return capsys.readouterr()


def told(capsys, *words):
    """Return the lines without their times."""
    return [line[17:] for line in shown(capsys, *words).out.splitlines()]


def test_lines_are_in_order_with_names_from_rig_and_eds(capsys, recording):
    lines = shown(capsys, recording).out.splitlines()
    assert lines[0] == "    0.001000000  can0      left (1) has booted"
    for text in (
        "left_wheel  start() of left_wheel takes left_wheel",
        "can0      NMT to all nodes: start",
        "can0      left (1) TPDO 1: 6041h statusword = 0237h operation enabled",
        "events    warning, right_wheel: it is hot",
        "can0      SDO left (1): 2020h Winding temperature = 25",
        "drive     group drive begins together, 0.100 ms apart (SYNC): left_wheel, right_wheel",
        "rs485     Modbus to lift (unit 3): read register 006Bh",
        "rs485     Modbus lift (unit 3): register 006Bh = 00FFh (after 2.000 ms)",
    ):
        assert any(line[17:] == text for line in lines), text
    assert [line[:15] for line in lines] == sorted(line[:15] for line in lines)


def test_motor_filter_keeps_locks_groups_and_broadcasts(capsys, recording):
    lines = told(capsys, recording, "--motor", "right_wheel", "--to", "1")
    assert lines == [
        "can0      right (2) has booted",
        "can0      NMT to all nodes: start",
        "can0      right (2) TPDO 1: 18 02 (its mapping is not in the recording)",
        "events    warning, right_wheel: it is hot",
        "drive     group drive begins together, 0.100 ms apart (SYNC): left_wheel, right_wheel",
    ]


def test_filters_by_identifier_node_bus_and_time(capsys, recording):
    hot = "events    warning, right_wheel: it is hot"
    assert told(capsys, recording, "--id", "702h", "--id", "182") == [
        "can0      right (2) has booted",
        "can0      right (2) TPDO 1: 18 02 (its mapping is not in the recording)",
        hot,
    ]
    assert len(told(capsys, recording, "--bus", "rs485", "--from", "0.0125")) == 2
    assert told(capsys, recording, "--node", "2", "--from", "0.007", "--to", "0.013") == [
        "can0      NMT to all nodes: start",
        "can0      right (2) TPDO 1: 18 02 (its mapping is not in the recording)",
        hot,
    ]
    assert told(capsys, recording, "--from", "0.012", "--to", "0.012000001") == [hot]
    assert told(capsys, recording, "--from", "0.012000001", "--to", "0.013") == []


def test_brief_omits_repetitions(capsys, recording):
    lines = told(capsys, recording, "--brief", "--node", "1", "--to", "0.012")
    assert sum("is operational" in line for line in lines) == 1
    assert sum("statusword = 0237h" in line for line in lines) == 1


def test_last_second_uses_mappings_but_no_old_transfer(capsys, recording):
    assert told(capsys, recording, "--last", "1") == [
        "can0      left (1) TPDO 1: 6041h statusword = 0218h fault",
        "can0      SDO left (1): uploads a segment of an object "
        "(the beginning was not recorded): 61",
    ]


def test_last_second_is_found_without_reading_the_rest(capsys, tmp_path, monkeypatch):
    long = Recorded(tmp_path / "long.mcap")
    for second in range(60):
        long.frame(second * S, 0x701, "05")
    path = long.close()
    read = []
    content = Trace._content
    monkeypatch.setattr(
        Trace, "_content", lambda self, chunk: read.append(chunk.first_ns) or content(self, chunk)
    )
    assert len(told(capsys, path, "--last", "1.5")) == 2
    assert len(read) <= 9  # the beginning, with the mappings, and the end
    assert not [time for time in read if 6 * S < time < 57 * S]


def test_json_has_one_object_per_line(capsys, recording):
    lines = [json.loads(line) for line in shown(capsys, recording, "--json").out.splitlines()]
    boot = lines[0]
    assert (boot["time_ns"], boot["id"], boot["kind"], boot["node"]) == (MS, 0x701, "boot-up", 1)
    (hot,) = [line for line in lines if line["topic"] == "/events"]
    assert hot["values"]["message"] == "it is hot"
    read = [line for line in lines if line.get("index") == 0x2020 and line["facts"]]
    assert read[0]["facts"][0]["value"] == 25


def test_unknown_motor_and_cut_file_are_reported(capsys, recording, tmp_path):
    cut = tmp_path / "cut.mcap"
    with open(recording, "rb") as file:
        cut.write_bytes(file.read()[:-400])
    told_of = shown(capsys, str(cut), "--motor", "nobody").err
    assert "no events of motor nobody" in told_of
    assert "cut at byte" in told_of
    assert shown(capsys, recording).err == ""


@pytest.mark.parametrize("text", ["x", "1.x", "-1", "", ".", "1.0000000001"])
def test_times_must_be_seconds(text, capsys, recording):
    assert time_ns("1.000000001") == S + 1
    with pytest.raises(SystemExit):
        shown(capsys, recording, f"--from={text}")
    assert f"{text!r} is not a time; say 0 to 18446744074 s" in capsys.readouterr().err


def test_command_line_has_verb_show(capsys, recording, tmp_path):
    assert main(["show", recording, "--id", "701"]) == 0
    assert "left (1) has booted" in capsys.readouterr().out
    assert main(["diff", recording, recording]) == 0
    (tmp_path / "none.mcap").write_bytes(b"candump?")
    assert main(["show", str(tmp_path / "none.mcap")]) == 2
    assert "holds no CAN traffic in a format known here" in capsys.readouterr().err


def test_empty_result_is_reported_with_reason(capsys, recording, tmp_path):
    assert main(["show", str(recording), "--motor", "nobody", "--id", "7FF", "--bus", "can9"]) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert "lines matches the options" in err
