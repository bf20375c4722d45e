"""Verbs read recordings of any format directly, and say what they read as which."""

import os

import pytest

from motorhil.harness.rig.config.scaffold import EXAMPLES

RIG = str(EXAMPLES / "two_wheels.toml")
ASK = """
import can
with can.Bus() as bus:
    asked = bytes.fromhex('4000100000000000')
    bus.send(can.Message(arbitration_id=0x601, data=asked, is_extended_id=False))
    for _ in range(5):
        bus.recv(0.2)
"""


@pytest.fixture(params=["log", "asc", "trc", "blf", "csv", "pcapng"])
def other(bench, say, request):
    """Return the name of a recording that is not MCAP; a.mcap has the same frames."""
    (bench / "ask.py").write_text(ASK)
    assert say("run", RIG, "ask.py", "-o", "a.mcap")[0] == 0
    name = f"a.{request.param}"
    assert say("convert", "a.mcap", "-o", name)[0] == 0
    return name


def test_show_prints_the_same_frames(other, say):
    status, out, err = say("show", other)
    assert status == 0
    assert err.startswith(f"motorhil show: {other}: ")
    assert ", read as " in err
    assert "node 1 has booted" in out
    assert "SDO to node 1: read 1000h device type" in out


def test_report_is_drawn_beside_the_file(other, say, bench):
    status, out, _ = say("report", other)
    assert (status, out.split(":")[0]) == (0, "a.html")
    assert (bench / "a.html").exists()


def test_diff_compares_with_the_original(other, say):
    status, out, _ = say("diff", "a.mcap", other, "--tolerance-s", "0.001")
    assert (status, out.split(":")[0]) == (0, "the same")


def test_replay_drives_a_rig(other, say):
    status, _, err = say("replay", other, "--as", "traffic", "--rig", RIG, "--speed", "max")
    assert status == 0, err
    assert f"motorhil replay: {other}: " in err


def test_unknown_format_names_the_known_ones(bench, say):
    (bench / "a.txt").write_text("dear diary")
    for words in (("show", "a.txt"), ("report", "a.txt"), ("replay", "a.txt", "--as", "host")):
        status, out, err = say(*words)
        assert (status, out) == (2, "")
        assert "a.txt: holds no CAN traffic in a format known here; formats are mcap" in err


@pytest.mark.parametrize(("verb", "status"), [("show", 0), ("report", 0), ("judge", 3)])
def test_file_whose_name_is_not_utf_8_is_read(bench, say, verb, status):
    name = os.fsdecode(b"n\xff.log")
    with open(name, "w") as file:
        file.write("(1.0) can0 181#0102\n")
    found, out, err = say(verb, name)
    assert found == status
    assert "n\\udcff." in out + err
