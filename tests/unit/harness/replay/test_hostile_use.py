"""Careless use of recordings: no data loss, and one-line errors."""

import os
import shutil
import stat

import pytest

from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, MODBUS_ADU, Direction, Schema
from tests.support.golden import FOLDER
from tests.support.recordings.handmade import Recorded

TABLES = {"/can": CAN_FRAME, "/mod": MODBUS_ADU}

ASK = """\
import can
with can.Bus() as bus:
    while bus.recv(1.0) is not None:  # both have booted
        pass
    ask = bytes.fromhex("4000100000000000")
    bus.send(can.Message(arbitration_id=0x601, data=ask, is_extended_id=False))
    while (heard := bus.recv(1.0)) is not None and heard.arbitration_id != 0x581:
        pass
"""

EARLY = """\
import can
with can.Bus() as bus:
    ask = bytes.fromhex("4000100000000000")
    bus.send(can.Message(arbitration_id=0x601, data=ask, is_extended_id=False))
    while bus.recv(1.0) is not None:
        pass
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(FOLDER / "cia402.mcap", tmp_path / "bench.mcap")
    (tmp_path / "ask.py").write_text(ASK)
    (tmp_path / "nothing.py").write_text("")
    return tmp_path


@pytest.mark.parametrize(
    "words",
    [
        ("run", "bench.mcap", "ask.py"),
        ("serve", "bench.mcap", "--", "true"),
        ("replay", "bench.mcap", "--as", "device", "ask.py"),
        ("replay", "bench.mcap", "--as", "host"),
        ("replay", "bench.mcap", "--as", "traffic", "--rig", "bench.mcap"),
        ("demo", "--against", "bench.mcap"),
    ],
)
@pytest.mark.parametrize("name", ["bench.mcap", "./bench.mcap", "link.mcap", "hard.mcap"])
def test_recording_is_not_overwritten_by_its_replay(folder, say, words, name):
    (folder / "link.mcap").symlink_to("bench.mcap")
    os.link("bench.mcap", "hard.mcap")
    before = (folder / "bench.mcap").read_bytes()
    cut = words.index("--") if "--" in words else len(words)
    status, out, err = say(*words[:cut], "-o", name, *words[cut:])
    assert (status, out) == (2, ""), err
    assert err.endswith(": is the recording itself; record elsewhere with -o\n")
    assert err.count("\n") == 1
    assert (folder / "bench.mcap").read_bytes() == before


@pytest.mark.parametrize(
    "words",
    [
        ("convert", "bench.mcap", "--to", "candump", "--force"),
        ("recover", "bench.mcap", "--force"),
        ("report", "bench.mcap"),
        ("report", "bench.mcap", "--foxglove-layout"),
    ],
)
def test_output_to_a_pipe_is_refused(folder, say, words):
    """As root, `-o /dev/null` would otherwise replace the device."""
    os.mkfifo("null")
    where = ("null",) if words[-1].startswith("--fox") else ("-o", "null")
    status, _, err = say(*words, *where)
    assert status == 2
    assert err == "null: is a pipe, and would be replaced by a file; name a file\n"
    assert stat.S_ISFIFO(os.stat("null").st_mode)
    assert not list(folder.glob("*.part"))


def test_output_to_a_link_keeps_the_link(folder, say):
    (folder / "there.log").write_text("")
    (folder / "here.log").symlink_to("there.log")
    assert say("convert", "bench.mcap", "-o", "here.log", "--force")[0] == 0
    assert (folder / "here.log").is_symlink()
    assert "can0" in (folder / "there.log").read_text()


@pytest.mark.parametrize(
    "words",
    [
        ("show", "pipe"),
        ("report", "pipe"),
        ("diff", "bench.mcap", "pipe"),
        ("diff", "--exact", "bench.mcap", "pipe"),
        ("convert", "pipe", "-o", "x.log"),
        ("recover", "pipe", "-o", "x.mcap"),
        ("replay", "pipe", "--as", "host"),
        ("replay", "pipe", "--as", "traffic", "--rig", "bench.mcap"),
    ],
)
def test_input_from_a_pipe_is_refused_at_once(folder, say, words):
    os.mkfifo("pipe")  # without a writer, a reader would block forever
    status, out, err = say(*words)
    assert (status, out) == (2, "")
    assert err == (
        "pipe: is a pipe, which can only be read from beginning to end; write it to a file first\n"
    )


def test_layout_does_not_overwrite_the_page(folder, say):
    status, out, err = say("report", "bench.mcap", "-o", "x", "--foxglove-layout", "./x")
    assert (status, out, err) == (2, "", "x: is the page already; name another file\n")


def test_recording_of_a_replay_keeps_attachments(folder, say):
    before = "bench.mcap"
    for name in ("second.mcap", "third.mcap"):
        assert say("run", before, "ask.py", "-o", name)[0] == 0
        before = name
    assert say("replay", "third.mcap", "--as", "host")[0] == 0
    assert attached("third.mcap") == attached("bench.mcap")


def attached(path):
    with read_trace(path) as trace:
        return {one.name: one.data for one in trace.attachments}


@pytest.fixture
def with_eds(folder, say):
    """Record a rig that names an EDS file and a model, then delete both files."""
    assert say("new", "wheels")[0] == 0
    rig = folder / "wheels" / "rig.toml"
    text = rig.read_text().replace('kind = "cia402"', 'kind = "cia402"\neds = "../drive.eds"')
    rig.write_text(text)
    eds = next((FOLDER.parents[1] / "emulators").rglob("*cia402.eds"))
    shutil.copy(eds, folder / "drive.eds")
    assert say("run", str(rig), "ask.py", "-o", "eds.mcap")[0] == 0
    (folder / "drive.eds").unlink()
    shutil.rmtree(folder / "wheels")
    return folder


def test_as_host_uses_recorded_eds_files(with_eds, say):
    assert {"drive.eds", "wheel_model.toml", "rig.toml"} <= set(attached("eds.mcap"))
    status, out, err = say("replay", "eds.mcap", "--as", "host", "-o", "again.mcap")
    assert status == 0, err
    assert "100.00 % of what they tell agrees" in out
    assert attached("again.mcap") == attached("eds.mcap")


def test_missing_attached_file_is_reported(folder):
    from motorhil.harness.replay.rig import own_rig
    from motorhil.harness.rig.config.toml import RigError
    from motorhil.harness.rig.reading import installed_plugins

    with read_trace("bench.mcap") as trace:
        rig = next(one for one in trace.attachments if one.name.endswith(".toml"))
    text = rig.data.decode() + '\n[motor.other]\nadaptation = "ideal"\nmodel = "gone.toml"\n'
    writer = TraceWriter("lacks.mcap", {"run": {}})
    writer.attach("rig.toml", text.encode(), "application/toml")
    writer.close()
    with pytest.raises(RigError) as told:
        own_rig(folder / "lacks.mcap", installed_plugins())
    assert "lacks.mcap/rig.toml:" in str(told.value)
    assert "no such file: gone.toml" in str(told.value)


NUMBERS = [
    ("show", "a", "--from"),
    ("show", "a", "--last"),
    ("show", "a", "--id"),
    ("show", "a", "--node"),
    ("diff", "a", "a", "--tolerance"),
    ("diff", "a", "a", "--tolerance-s"),
    ("diff", "a", "a", "--context"),
    ("record", "--on", "x", "-o", "a", "--duration"),
    ("record", "--on", "x", "-o", "a", "--rotate-mib"),
    ("record", "--on", "x", "-o", "a", "--bitrate"),
    ("replay", "a", "--as", "host", "--patience"),
    ("replay", "a", "--as", "host", "--tolerance"),
    ("replay", "a", "--as", "host", "--speed"),
    ("replay", "a", "--as", "traffic", "--from"),
    ("replay", "a", "--as", "traffic", "--to"),
    ("replay", "a", "--as", "traffic", "--id"),
    ("replay", "a", "--as", "traffic", "--node"),
    ("replay", "a", "--as", "traffic", "--bitrate"),
]


@pytest.mark.parametrize("words", NUMBERS)
@pytest.mark.parametrize("value", ["nan", "inf", "-1", "-1e9", "1e30", "9" * 30, "x", "", "²"])
def test_invalid_number_option_error_names_limits(folder, say, words, value):
    if words[-1] == "--id" and value == "1e30":
        value = "g"  # hexadecimal otherwise
    status, out, err = say(*words[:-1], f"{words[-1]}={value}")
    assert (status, out) == (2, "")
    last = err.splitlines()[-1]
    assert f"argument {words[-1]}: {value!r} is " in last
    assert " to " in last, "the limits are named"


def test_read_trace_refuses_a_pipe(folder):
    os.mkfifo("pipe")
    with pytest.raises(TraceError, match="is a pipe"):
        read_trace("pipe")


def test_devices_are_heard_after_the_hosts_last_frame(folder, say):
    """They boot while the host, which asked too early, waits for an answer."""
    (folder / "early.py").write_text(EARLY)
    assert say("run", "bench.mcap", "early.py", "-o", "early.mcap")[0] == 0
    status, out, _ = say("replay", "early.mcap", "--as", "host")
    assert "but nothing" not in out
    assert status == 0


def test_lines_named_by_addresses_can_be_replayed(folder, say):
    """Imported Modbus/TCP lines are named by addresses; a rig's buses are named by words."""
    for number in (1, 2):
        place = f"/modbus/10.0.0.{number}"
        made = Recorded(f"{number}.mcap")
        for time_ns, data, asked in (
            (10, "000100000006010600000007", True),
            (20, "000100000006010600000007", False),
        ):
            direction = Direction.TRANSMITTED if asked else Direction.RECEIVED
            values = {"direction": direction, "data": bytes.fromhex(data), "tcp": True}
            made.message(time_ns, place, MODBUS_ADU, values)
        made.writer.close()
        bare(f"{number}.mcap")
    status, out, err = say("check", "2.mcap")
    assert (status, err) == (0, "")
    assert out == "2.mcap: generated: 1 bus, 1 controller\n"
    for words in (
        ("run", "2.mcap", "nothing.py"),
        ("replay", "2.mcap", "--as=device", "--partial", "nothing.py"),
    ):
        status, _, err = say(*words)
        assert (status, "1 command of the recording never came" in err) == (0, True), err


def test_recording_without_devices_is_refused(folder, say):
    Recorded("free.mcap").frame(1, 0x7FF, "00").close()
    bare("free.mcap")
    for words in (("check", "free.mcap"), ("run", "free.mcap", "ask.py")):
        status, out, err = say(*words)
        assert (status, out) == (2, "")
        assert err == (
            "free.mcap: holds no CANopen or Modbus message of a device; "
            "give a recording with devices in it\n"
        )


def bare(path):
    """Remove the attachments of a recording, as if it was imported."""
    content = path.replace(".mcap", ".bare")
    with read_trace(path) as trace:
        writer = TraceWriter(content, {})
        for channel, time_ns, payload in trace.messages():
            writer.write(
                writer.channel(channel.topic, Schema.of(TABLES[channel.topic[:4]])),
                time_ns,
                payload,
            )
        writer.close()
    os.replace(content, path)


def test_diff_of_empty_recordings_warns(folder, say):
    for name in ("a.mcap", "b.mcap"):
        TraceWriter(name, {}).close()
    status, _, err = say("diff", "a.mcap", "b.mcap")
    assert status == 0
    assert [line.split(": ")[1:3] for line in err.splitlines()] == [
        [name, "no event of known meaning; use --exact to compare bytes"]
        for name in ("a.mcap", "b.mcap")
    ]
