"""Option `--dbc` of `show`: messages and signals beside the frames."""

import json
import sys
from pathlib import Path

import pytest

from motorhil.traces import can_frame
from motorhil.traces.can_frame import classic, remote
from motorhil.traces.formats.frames import Frame
from motorhil.traces.formats.registry import record_frames

DBC = """VERSION ""
NS_ :
BS_:
BU_: Drive
BO_ 291 Status: 8 Drive
 SG_ Temperature : 0|8@1- (0.5,10) [0|0] "degC" Host
 SG_ Speed : 8|16@1- (0.25,0) [0|0] "rad/s" Host
 SG_ State : 24|8@1+ (1,0) [0|3] "" Host
BO_ 2566844160 Wide: 2 Drive
 SG_ Big : 7|16@0+ (1,0) [0|0] "V" Host
BO_ 512 Chosen: 3 Drive
 SG_ Which M : 0|8@1+ (1,0) [0|1] "" Host
 SG_ First m0 : 8|16@1+ (1,0) [0|0] "A" Host
 SG_ Second m1 : 8|8@1+ (2,0) [0|0] "N" Host
VAL_ 291 State 0 "Off" 2 "Moving" ;
"""
WIDE = 2566844160 & 0x1FFF_FFFF
FRAMES = [
    classic(0x123, bytes.fromhex("FC 60FF 02 00000000")),  # -4, -160, 2
    classic(WIDE | can_frame.EFF, bytes.fromhex("0102")),  # Motorola: 0102h
    classic(0x200, bytes.fromhex("00 3412")),
    classic(0x200, bytes.fromhex("01 07 00")),
    classic(0x200, bytes.fromhex("05 0000")),  # no such multiplexed signal
    classic(0x124, b"\1"),
    remote(0x123, 8),
    classic(0x123, bytes.fromhex("FC 60")),  # shorter than the message
]


@pytest.fixture
def recording(bench):
    record_frames("a.mcap", [Frame(n, "can0", one) for n, one in enumerate(FRAMES)], {})
    Path("a.dbc").write_text(DBC)
    return "a.mcap"


@pytest.fixture
def cantools():
    return pytest.importorskip("cantools", reason="needs cantools: pip install cantools")


def test_known_messages_are_shown_with_units(recording, say, cantools):
    status, out, err = say("show", recording, "--dbc", "a.dbc")
    assert (status, err) == (0, "")
    lines = [line.split("can0", 1)[1].strip() for line in out.splitlines()]
    assert lines[0] == "Status: Temperature = 8 degC, Speed = -40 rad/s, State = Moving"
    assert lines[1] == "Wide: Big = 258 V"
    assert lines[2] == "Chosen: Which = 0, First = 4660 A"
    assert lines[3] == "Chosen: Which = 1, Second = 14 N"
    assert lines[4].startswith("Chosen: not decodable: expected multiplexer id 0 or 1")
    assert lines[7] == "Status: Temperature = 8 degC"


def test_unknown_identifiers_and_remote_frames_stay(recording, say, cantools):
    plain = say("show", recording)[1].splitlines()
    named = say("show", recording, "--dbc", "a.dbc")[1].splitlines()
    assert [plain[at] for at in (5, 6)] == [named[at] for at in (5, 6)]


def test_json_has_the_signals_as_numbers(recording, say, cantools):
    out = say("show", recording, "--dbc", "a.dbc", "--json", "--id", "123")[1]
    message = json.loads(out.splitlines()[0])["message"]
    assert message == {
        "name": "Status",
        "signals": {
            "Temperature": {"value": 8, "unit": "degC"},
            "Speed": {"value": -40, "unit": "rad/s"},
            "State": {"value": "Moving", "unit": ""},
        },
    }


def test_unusable_dbc_is_one_line(recording, say, cantools):
    Path("bad.dbc").write_text(DBC + 'VAL_ 999 Missing 0 "x" ;\nBO_ nonsense\n')
    status, out, err = say("show", recording, "--dbc", "bad.dbc")
    assert (status, out) == (2, "")
    assert err.startswith("bad.dbc: is not a usable DBC: ")
    assert err.count("\n") == 1
    garbage = "9" * 3000
    Path("long.dbc").write_text(f'VERSION ""\nBO_ 100 Foo: 8 {garbage}\n')
    _, _, err = say("show", recording, "--dbc", "long.dbc")
    place = "long.dbc: is not a usable DBC: invalid syntax at line 2, column 16: 999999"
    assert err.startswith(place)
    assert len(err) < 160
    status, _, err = say("show", recording, "--dbc", "missing.dbc")
    told = "missing.dbc: cannot be read: no such file or directory; check the name\n"
    assert (status, err) == (2, told)


def test_missing_cantools_is_explained(recording, say, monkeypatch):
    monkeypatch.setitem(sys.modules, "cantools", None)
    status, out, err = say("show", recording, "--dbc", "a.dbc")
    assert (status, out) == (2, "")
    assert err == "a.dbc: cannot be read without cantools; pip install 'motorhil[dbc]'\n"


@pytest.mark.data
def test_real_dbc_with_an_error_is_refused(recording, say, shared, cantools):
    status, _, err = say("show", recording, "--dbc", str(shared / "data/eds/uw_2024CAR.dbc"))
    assert status == 2
    assert "unused VAL_ entries" in err
    assert err.count("\n") == 1
