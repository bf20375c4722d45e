"""Decoders of plug-ins for `show`: by the rig in the recording, or by `--decoder`."""

import json
import sys

import pytest

from motorhil.traces.can_frame import classic
from motorhil.traces.formats.frames import Frame
from motorhil.traces.formats.registry import record_frames
from motorhil.traces.mcap.records import Attachment

PLUGIN = """\
from motorhil.traces.can_frame import fields
from motorhil.traces.decoding.narrative import BusMessage
from motorhil.traces.layout import Signal


def build(node_id):
    def decode(frame):
        told = fields(frame)
        if told.can_id != 0x300 + node_id:
            return None
        return BusMessage("Speed", (Signal("speed", told.data[0] / 4, "rev/s"),))

    return decode


def worn(node_id):
    def decode(frame):
        return BusMessage("Ratio", (Signal("ratio", 1 / fields(frame).data[0], ""),))

    return decode


def silent(node_id):
    raise OSError("no licence")


def odd(node_id):
    return lambda frame: BusMessage("Odd", (Signal("speed", object(), "rev/s"),))


def wrong(node_id):
    return lambda frame: "Speed"
"""
POINTS = """\
[motorhil.decoders]
echo = bench_decoder:build
worn = bench_decoder:worn
silent = bench_decoder:silent
odd = bench_decoder:odd
wrong = bench_decoder:wrong
lost = no_such_decoder:build
"""
RIG = """\
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.left]
kind = "{kind}"
bus = "can0"
node_id = 1
[motor.front]
adaptation = "bare"
controller = "left"
"""
FRAMES = (("can0", 0x301, 8), ("can0", 0x302, 8), ("can1", 0x301, 8), ("can0", 0x301, 0))


@pytest.fixture
def record(bench, monkeypatch):
    """Return a function that records FRAMES with a rig of this kind of controller."""
    points = bench.parent / "site" / "bench-1.0.dist-info" / "entry_points.txt"
    points.write_text(points.read_text() + POINTS)
    (bench / "bench_decoder.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(bench)
    monkeypatch.delitem(sys.modules, "bench_decoder", raising=False)

    def write(kind=None, rig=RIG):
        frames = [
            Frame(n, bus, classic(can_id, bytes([value])))
            for n, (bus, can_id, value) in enumerate(FRAMES)
        ]
        rigs = [] if kind is None else [rig.format(kind=kind).encode()]
        told = [Attachment("rig.toml", "application/toml", 0, one) for one in rigs]
        record_frames("a.mcap", frames, {}, told)
        return "a.mcap"

    return write


def texts(out):
    return [line.split(maxsplit=2)[2] for line in out.splitlines()]


def test_kind_in_the_rig_finds_its_decoder(record, say):
    record()
    plain = texts(say("show", "a.mcap")[1])
    status, out, err = say("show", record("echo"))
    assert (status, err) == (0, "")
    said = texts(out)
    assert [said[0], said[3]] == ["Speed: speed = 2 rev/s", "Speed: speed = 0 rev/s"]
    assert said[2] == plain[2]  # another bus
    assert "Speed" not in said[1]  # another node


def test_kind_of_a_plugin_with_a_protocol_of_its_own_is_not_replayed(record, say, bench):
    (bench / "app.py").write_text("raise AssertionError('it ran')\n")
    path = record("echo", RIG.partition("[motor.")[0])
    for words in (("replay", path, "--as", "device", "app.py"), ("run", path, "app.py")):
        status, _, err = say(*words)
        assert status == 2
        assert 'no recording stands in for "echo"' in err
        assert "--as host" in err


def test_described_frames_belong_to_node_and_motor(record, say):
    path = record("echo")
    for words in (("--node", "1", "--bus", "can0"), ("--motor", "front")):
        out = say("show", path, *words, "--json")[1]
        lines = [json.loads(line) for line in out.splitlines()]
        assert [line["id"] for line in lines] == [0x301, 0x301]
        assert all((line["node"], line["names"]) == (1, ["front", "left"]) for line in lines)
    assert lines[0]["message"]["signals"] == {"speed": {"value": 2.0, "unit": "rev/s"}}


@pytest.mark.parametrize(
    ("kind", "problem"),
    [
        ("worn", "ZeroDivisionError: division by zero"),
        ("silent", "OSError: no licence"),
        ("odd", "TypeError: its signal 'speed' is object, not a number or text"),
        ("wrong", "TypeError: it returns str, not BusMessage or None"),
        ("lost", "ModuleNotFoundError: No module named 'no_such_decoder'"),
    ],
)
def test_failing_decoder_is_one_line_and_frames_stay(record, say, kind, problem):
    plain = texts(say("show", record("other"))[1])
    status, out, err = say("show", record(kind))
    assert status == 0
    assert err == (
        f'motorhil show: decoder "{kind}" of node 1 on can0: {problem}; '
        "such frames stay as they are\n"
    )
    assert texts(out)[3] == plain[3]
    assert len(texts(out)) == len(FRAMES)


def test_recording_cannot_name_code_to_load(record, say):
    path = record("bench_decoder:build")
    status, out, err = say("show", path)
    assert (status, err) == (0, "")
    assert "Speed" not in out
    assert "bench_decoder" not in sys.modules


def test_rig_with_odd_values_is_shown(record, say):
    for kind, node in (('["echo"]', "1"), ('"echo"', '"x"'), ('"echo"', "1.5"), ("{}", "1")):
        rig = RIG.replace('"{kind}"', kind.replace("{}", "{{}}")).replace("= 1\n", f"= {node}\n")
        status, out, err = say("show", record("", rig))
        assert (status, err, len(out.splitlines())) == (0, "", len(FRAMES))


@pytest.mark.parametrize("name", ["echo", "bench_decoder:build"])
def test_option_decoder_names_node_and_plugin(record, say, name):
    out = say("show", record(), "--decoder", f"can1:1={name}")[1]
    assert [text.startswith("Speed") for text in texts(out)] == [False, False, True, False]
    out = say("show", "a.mcap", "--decoder", f"1={name}", "--decoder", f"can0:2={name}")[1]
    assert texts(out)[:3] == ["Speed: speed = 2 rev/s"] * 3


def test_option_decoder_precedes_the_rig(record, say):
    out = say("show", record("wrong"), "--decoder", "can0:1=echo")[1]
    assert texts(out)[0] == "Speed: speed = 2 rev/s"


def test_unknown_decoder_is_one_line_with_the_known(record, say):
    status, out, err = say("show", record(), "--decoder", "1=ecko")
    assert (status, out) == (2, "")
    known = "dynamixel, echo, lost, mit, moteus, odd, rmd, robstride, silent, vesc, worn, wrong"
    assert err == (
        f"--decoder ecko: no installed package has a decoder of this name (known: {known}); "
        "install the package, or name package.module:function\n"
    )


@pytest.mark.parametrize("text", ["1", "x=echo", "256=echo", "can0:=echo", "1="])
def test_malformed_option_decoder_is_refused(record, say, text):
    status, out, err = say("show", record(), "--decoder", text)
    assert (status, out) == (2, "")
    assert "is not [BUS:]NODE=NAME with a node-ID of 0 to 255" in err


def test_brief_leaves_out_repeated_messages(record, say):
    path = record()
    frames = [Frame(n, "can0", classic(0x301, bytes([v]))) for n, v in enumerate((8, 8, 12))]
    record_frames(path, frames, {})
    out = say("show", path, "--brief", "--decoder", "1=echo")[1]
    assert texts(out) == ["Speed: speed = 2 rev/s", "Speed: speed = 3 rev/s"]
