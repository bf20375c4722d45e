"""The verb `convert`: reports of unreadable and lost records, and of errors."""

import json

import pytest

from motorhil.traces.can_frame import classic
from motorhil.traces.formats.frames import Frame
from motorhil.traces.formats.registry import record_frames
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.protobuf import encode
from motorhil.traces.schema import CAN_FRAME, MODBUS_ADU, Direction, Schema
from tests.support.recordings.captures import pcap

TEXT = """\
candump can0
  can0  701   [1]  7F   # alive
  can0  181   [8]  01 02 03 04
  can0  081   [2]  01 52
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in.txt").write_text(TEXT)
    return tmp_path


def test_unreadable_records_are_reported_with_line(folder, say):
    status, out, err = say("convert", "in.txt", "-o", "out.mcap")
    assert status == 0
    assert out == "out.mcap: 2 frames of can0, from candump to mcap, 2 not readable\n"
    assert err.splitlines() == [
        "in.txt:1: not a frame: 'candump can0'",
        "in.txt:3: 4 of 8 bytes: 'can0  181   [8]  01 02 03 04'",
        "in.txt: 2 frames have no time stamp: their time is 0",
    ]


def test_strict_fails_if_anything_is_unreadable_or_lost(folder, say):
    assert say("convert", "in.txt", "-o", "out.mcap", "--strict")[0] == 1
    assert say("convert", "out.mcap", "-o", "out.log", "--strict")[0] == 0
    record_frames("sent.mcap", [Frame(0, "can0", classic(1, b""), Direction.RECEIVED, "left")], {})
    status, _, err = say("convert", "sent.mcap", "-o", "sent.log", "--strict")
    assert status == 1
    assert "lost, candump cannot hold it: sender of 1 frames" in err


def test_json_has_all_problems(folder, say):
    (folder / "in.txt").write_text(TEXT + "nonsense\n" * 30)
    facts = json.loads(say("convert", "in.txt", "-o", "x", "--to", "candump", "--json")[1])
    assert (facts["frames"], facts["buses"], facts["unstamped"]) == (2, ["can0"], 2)
    assert [problem["line"] for problem in facts["problems"]] == [1, 3, *range(5, 35)]


def test_text_has_twenty_problems_and_count_of_others(folder, say):
    (folder / "in.txt").write_text(TEXT + "nonsense\n" * 30)
    err = say("convert", "in.txt", "-o", "x", "--to", "mcap")[2]
    assert "in.txt: 12 more problems: --all" in err
    err = say("convert", "in.txt", "-o", "x", "--to", "mcap", "--force", "--all")[2]
    assert "in.txt:34: not a frame: 'nonsense'" in err


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("no-such.txt", "-o", "x.mcap"), "cannot be read: no such file"),
        (("in.txt", "-o", "x.doc"), "use --to FORMAT"),
        (("in.txt", "-o", "in.txt", "--to", "candump"), "is the source itself"),
        (("in.txt", "-o", "there.log"), "exists; name another file, or say --force"),
        (("in.txt", "-o", "no/such/x.log"), "cannot be written: no such file"),
        (("in.txt", "-o", "there.log", "--to", "mcap", "--force"), "is not a recording"),
        (("in.txt", "-o", "folder.log", "--force"), "cannot be written: is a directory"),
        (("cut.txt", "-o", "x.mcap"), "no frame can be read as candump"),
        ((".", "-o", "x.mcap"), "is a directory"),
    ],
)
def test_wrong_usage_is_reported(folder, say, words, why):
    (folder / "there.log").write_text("mine\n")
    (folder / "folder.log").mkdir()
    (folder / "cut.txt").write_text("  can0  181   [8]  01 02 03")
    status, out, err = say("convert", *words)
    assert (status, out) == (2, "")
    assert why in err
    assert (folder / "there.log").read_text() == "mine\n"
    assert not list(folder.glob("**/*.part"))


def test_name_too_long_for_the_target_is_told_with_the_file_named_by_the_user(folder, say):
    with TraceWriter("long.mcap") as writer:
        can = writer.channel("/can/" + "c" * 70_000, Schema.of(CAN_FRAME))
        writer.can_frame(writer.source(can, "left"), 0, classic(1, b""))
    status, out, err = say("convert", "long.mcap", "-o", "out.pcapng")
    assert (status, out) == (2, "")
    assert err.startswith("out.pcapng: pcapng cannot hold the name 'cccccccccccccccccccc...' of")
    assert [path.name for path in folder.glob("out*")] == []


def test_modbus_adus_are_extracted_from_mixed_recording(folder, say):
    request = bytes.fromhex("01 03 0010 0002 C5CE")
    with TraceWriter("mixed.mcap") as writer:
        can = writer.channel("/can/can0", Schema.of(CAN_FRAME))
        line = writer.channel("/modbus/rs485", Schema.of(MODBUS_ADU))
        writer.can_frame(writer.source(can, "left"), 0, classic(1, b""))
        values = {"direction": 2, "sender": "host", "start_ns": 1, "end_ns": 2, "data": request}
        writer.write(line, 3, encode(MODBUS_ADU, values))
        writer.write(line, 4, encode(MODBUS_ADU, values | {"direction": 0}))
    assert say("convert", "mixed.mcap", "-o", "can.pcapng")[1:] == (
        "can.pcapng: 1 frames of can0, from mcap to pcapng\n",
        "mixed.mcap: /modbus/rs485: 2 messages are not CAN frames, and are omitted\n",
    )
    status, out, err = say(
        "convert", "mixed.mcap", "-o", "line.pcapng", "--to", "modbus-pcapng", "--strict"
    )
    assert status == 1
    assert out == ("line.pcapng: 2 ADUs of rs485, from mcap to modbus-pcapng, 1 not readable\n")
    assert err.splitlines() == [
        "mixed.mcap:2: rs485: an ADU without a direction",
        "mixed.mcap: lost, modbus-pcapng cannot hold it: bit times of 1 ADUs",
    ]
    assert say("convert", "line.pcapng", "-o", "again.mcap")[1:] == (
        "again.mcap: 1 ADUs of rs485, from pcap to mcap\n",
        "",
    )
    _, out, err = say("show", "line.pcapng")
    assert "Modbus to unit 1: read 2 registers" in out
    assert err == "motorhil show: line.pcapng: 1 ADUs, read as pcap\n"
    assert say("convert", "again.mcap", "-o", "x.log")[2] == (
        "again.mcap: holds Modbus, which candump cannot; convert it to mcap or pcapng\n"
    )


@pytest.mark.parametrize("words", [("show",), ("convert", "-o", "x.mcap")])
def test_capture_of_another_network_names_its_kind(folder, say, words):
    (folder / "other.pcap").write_bytes(pcap([(0, 0, bytes(40))] * 3, link_type=105))
    assert say(words[0], "other.pcap", *words[1:])[2] == (
        "other.pcap: holds neither CAN frames nor Modbus; 3 packets are not CAN frames"
        " (IEEE 802.11), and are omitted\n"
    )


def test_source_that_changes_between_two_readings_is_refused(folder, say, monkeypatch):
    from motorhil.harness.recording import conversion

    (folder / "short.log").write_text("(0.000001) can0 123#00\n" * 3)
    survey = conversion.Survey

    def surveyed():
        (folder / "short.log").write_text("")
        return survey()

    monkeypatch.setattr(conversion, "Survey", surveyed)
    assert say("convert", "short.log", "-o", "x.csv") == (
        *(2, ""),
        "short.log: changed while it was read: 3 frames, then 0; convert it again, or a copy of "
        "it\n",
    )
    assert not (folder / "x.csv").exists()


@pytest.mark.parametrize("target", ["x.csv", "x.mcap"])
def test_part_of_somebody_else_is_kept(folder, say, target):
    (folder / f"{target}.part").write_text("mine")
    assert say("convert", "in.txt", "-o", target)[0] == 0
    assert (folder / f"{target}.part").read_text() == "mine"
    assert not (folder / f"{target}.2.part").exists()


def test_interrupted_conversion_leaves_no_recording(folder, say, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("motorhil.traces.mcap.writer.TraceWriter.extend", interrupted)
    assert say("convert", "in.txt", "-o", "x.mcap")[0] == 130
    assert not list(folder.glob("x.mcap*"))
