"""Option `--eds`: objects of the nodes in a recording without a rig."""

import json
import shutil
from pathlib import Path

import pytest

from motorhil.harness.cli.options import GivenEds, attachments_of
from motorhil.harness.recording.conversion import as_mcap
from motorhil.traces.digest import digest
from motorhil.traces.mcap.reader import read_trace
from tests.support.recordings.story import SET_UP, record, story

# The same PDOs as in the SDO traffic of the story, as an EDS has them (CiA 306).
HEAD = "[FileInfo]\nFileName=one.eds\n"
OF_JUDGE = ("pds-legal", "rest-when-told", "following-bounded", "torque-off", "fault-told")


def section(index, subindex, value, name="entry"):
    place = f"{index:04X}sub{subindex:X}" if subindex else f"{index:04X}sub0"
    return f"[{place}]\nParameterName={name}\nDataType=0x0007\nDefaultValue=0x{value:X}\n"


@pytest.fixture
def eds(bench):
    """Write one.eds with the PDOs of the story."""
    pdos = [
        section(index, sub, value) for index, sub, _, value in SET_UP if 0x1600 <= index < 0x1B00
    ]
    Path("one.eds").write_text(HEAD + "".join(pdos))
    return "one.eds"


@pytest.fixture
def lost(bench, say, eds):
    """Write lost.log: the story without its rig and without the SDO traffic about PDOs."""
    frames = [f for f in story() if f[1] not in (0x581, 0x601) or not 0x16 <= f[2][2] < 0x1B]
    record("whole.mcap", story())
    record("lost.mcap", frames)
    assert say("convert", "lost.mcap", "-o", "lost.log")[0] == 0
    return "lost.log"


def judged(say, *words):
    told = json.loads(say("judge", "--json", "--complete", *words)[1])
    return {one["oracle"]: (one["verdict"], one["looked"]) for one in told["findings"]}


def test_judge_with_eds_judges_as_with_the_rig(lost, say):
    without, given = judged(say, lost), judged(say, lost, "--eds", "1=one.eds")
    whole = judged(say, "whole.mcap")
    for oracle in OF_JUDGE:
        assert without[oracle] == ("could not judge", 0)
        assert given[oracle] == whole[oracle]
        assert given[oracle][0] == "held"


@pytest.mark.parametrize(("place", "is_known"), [("can0:1", True), ("1", True), ("can1:1", False)])
def test_show_with_eds_names_objects_of_pdos(lost, say, place, is_known):
    out = say("show", lost, "--eds", f"{place}=one.eds", "--id", "181")[1]
    assert ("TPDO 1: 6041h statusword = 0250h" in out) == is_known


def test_eds_of_one_bus_beats_the_one_of_all(lost, say):
    Path("other.eds").write_text(HEAD + section(0x1A00, 1, 0x60640020) + section(0x1A00, 0, 1))
    both = ("--eds", "can0:1=one.eds", "--eds", "1=other.eds")
    assert "6041h statusword" in say("show", "lost.mcap", *both[:2])[1]
    assert "6041h statusword" not in say("show", lost, *both[2:], "--id", "181")[1]
    assert "6041h statusword" in say("show", lost, *both[2:], *both[:2], "--id", "181")[1]


def test_converted_recording_keeps_the_eds(lost, say):
    assert say("convert", lost, "-o", "kept.mcap", "--eds", "1=one.eds")[0] == 0
    assert "6041h statusword" in say("show", "kept.mcap", "--id", "181")[1]
    with read_trace("kept.mcap") as trace:
        assert trace.attachments[0].data == Path("one.eds").read_bytes()


def test_eds_in_a_foreign_target_is_refused(lost, say):
    status, _, err = say("convert", lost, "-o", "kept.asc", "--eds", "1=one.eds")
    assert (status, Path("kept.asc").exists()) == (2, False)
    assert "--eds: asc holds no EDS; write mcap" in err


def test_report_and_replay_take_an_eds(lost, say):
    assert say("report", lost, "-o", "a.html", "--eds", "1=one.eds")[0] == 0
    assert say("report", lost, "-o", "b.html")[0] == 0
    assert len(Path("a.html").read_bytes()) > len(Path("b.html").read_bytes())
    Path("nothing.py").write_text("")
    words = ("--as", "device", "nothing.py", "--partial", "--eds", "1=one.eds")
    status, _, err = say("replay", lost, *words)
    assert status == 0, err


def test_copy_with_an_eds_has_the_same_messages(lost):
    more = attachments_of([GivenEds("", 1, "one.eds")])
    with as_mcap(Path("lost.mcap"), print, more) as path:
        assert digest(path) == digest("lost.mcap")
        with read_trace(path) as copy, read_trace("lost.mcap") as trace:
            assert copy.metadata == trace.metadata
            assert copy.attachments == [*trace.attachments, *more]


def test_judge_of_an_unheard_node_is_an_error(lost, say):
    status, _, err = say("judge", lost, "--eds", "7=one.eds")
    assert status == 2
    assert "--eds 7=one.eds: nothing of node 7 is in the recording; heard: can0:1" in err


@pytest.mark.parametrize("given", ["1", "0=one.eds", "128=one.eds", "one.eds", "x:y=one.eds"])
def test_wrong_place_of_an_eds_is_explained(lost, say, given):
    status, out, err = say("show", lost, "--eds", given)
    assert (status, out) == (2, "")
    assert f"{given!r} is not [BUS:]NODE=FILE with a node-ID of 1 to 127" in err


@pytest.mark.parametrize(
    ("name", "text"), [("none.eds", None), ("bad.eds", "hello"), ("empty.eds", "")]
)
def test_unusable_eds_is_refused_by_name(lost, say, name, text):
    if text is not None:
        Path(name).write_text(text)
    status, out, err = say("show", lost, "--eds", f"1={name}")
    assert (status, out) == (2, "")
    assert f"{name}: {'cannot be read' if text is None else 'holds no objects of an EDS'}" in err


@pytest.mark.data
def test_vendor_eds_names_objects_of_a_real_drive(bench, say, shared):
    folder = shared / "data"
    name = "roboteq_mbl1660_node12_candump.txt"
    shutil.copy(folder / "traffic" / name, name)
    words = ("show", name, "--id", "20C")
    assert "2000h:1" not in say(*words)[1]
    given = ("--eds", f"12={folder / 'eds' / 'roboteq_v80.eds'}")
    name = "2000h:1 Cmd_CANGO Set Motor Command, Channel 1"
    assert f"RPDO 1 to node 12: {name} = 0" in say(*words, *given)[1]
