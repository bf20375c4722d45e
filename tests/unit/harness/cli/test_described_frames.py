"""Options `--dbc` and `--decoder` of `judge` and `report`: frames in words of their own."""

import json
from pathlib import Path

import pytest

from tests.support.recordings.story import record
from tests.unit.harness.cli.test_show_decoder import record as record_with_plugin
from tests.unit.harness.oracles.test_broken import without
from tests.unit.harness.report.conftest import document_in

plugin = record_with_plugin  # the fixture, by another name than that of the function above
DBC = """VERSION ""
NS_ :
BS_:
BU_: Drive
BO_ 385 DriveStatus: 6 Drive
 SG_ Word : 0|16@1+ (1,0) [0|0] "" Host
 SG_ Place : 16|32@1- (0.5,0) [0|0] "mm" Host
BO_ 129 Alarm: 8 Drive
 SG_ Code : 0|16@1+ (1,0) [0|0] "" Host
VAL_ 385 Word 561 "Ready" ;
VAL_ 129 Code 34321 "Lag" ;
"""
SAID = "DriveStatus: Word = Ready, Place = 0 mm"


@pytest.fixture
def broken(bench):
    """Return a recording without two controlwords, beside a DBC."""
    pytest.importorskip("cantools", reason="needs cantools: pip install cantools")
    Path("a.dbc").write_text(DBC)
    record(bench / "broken.mcap", without((0x201, 410, 410), (0x201, 1610, 1610)))
    return "broken.mcap"


def test_judge_adds_the_message_to_its_finding(say, broken):
    plain = say("judge", broken, "--only", "pds-legal")[1].splitlines()
    status, out, err = say("judge", broken, "--only", "pds-legal", "--dbc", "a.dbc")
    assert (status, err) == (1, "")
    assert out.splitlines() == [*plain[:3], f"pds-legal: in this frame: {SAID}", *plain[3:]]


def test_judge_json_has_messages_of_each_finding(say, broken):
    out = say("judge", broken, "--json", "--dbc", "a.dbc")[1]
    messages = {one["oracle"]: one["messages"] for one in json.loads(out)["findings"]}
    assert messages["pds-legal"] == [
        {
            "name": "DriveStatus",
            "signals": {
                "Word": {"value": "Ready", "unit": ""},
                "Place": {"value": 0.0, "unit": "mm"},
            },
        }
    ]
    assert messages["limit-torque"] == []


def test_judge_describes_frames_of_other_formats(say, broken):
    assert say("convert", broken, "-o", "broken.log")[0] == 0
    out = say("judge", "broken.log", "--dbc", "a.dbc")[1]
    assert f"pds-legal: in this frame: {SAID}\n" in out


def test_report_names_messages_in_load_and_incidents(say, broken):
    status, _, err = say("report", broken, "--dbc", "a.dbc")
    assert (status, err) == (0, "")
    document, _ = document_in(Path("broken.html"))
    [traffic] = document["traffic"]
    names = dict(zip(traffic["labels"], traffic["names"], strict=True))
    assert (names["181h"], names["081h"]) == ("DriveStatus", "Alarm")
    assert names["601h"] == "SDO to left"
    texts = [text for *_, text in document["incidents"]["list"]]
    assert "Alarm: Code = Lag" in texts


def test_report_uses_the_decoder_of_the_rigs_kind(say, plugin):
    status, _, err = say("report", plugin("echo"))
    assert (status, err) == (0, "")
    document, _ = document_in(Path("a.html"))
    assert document["traffic"][0]["names"] == ["Speed left", "RPDO 2 node 2"]


@pytest.mark.parametrize("verb", ["judge", "report"])
def test_wrong_descriptions_are_refused_before_reading(say, plugin, verb):
    path = plugin()
    status, out, err = say(verb, path, "--decoder", "1=ecko")
    assert (status, out) == (2, "")
    assert err.startswith("--decoder ecko: no installed package has a decoder of this name")
    status, out, err = say(verb, path, "--dbc", "missing.dbc")
    assert (status, out) == (2, "")
    assert err.startswith("missing.dbc: cannot be read")
    status, out, err = say(verb, path, "--decoder", "x=1")
    assert (status, out) == (2, "")
    assert "is not [BUS:]NODE=NAME with a node-ID of 0 to 255" in err
