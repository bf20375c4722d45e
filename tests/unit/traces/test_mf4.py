"""Bus events in MDF 4 files, as python-can writes them with asammdf."""

import sys

import can
import pytest

from motorhil.traces import can_frame
from motorhil.traces.can_frame import classic, flexible, remote
from motorhil.traces.errors import TraceError
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.registry import open_source
from motorhil.traces.schema import Direction

R, T = Direction.RECEIVED, Direction.TRANSMITTED
HEAD = b"MDF     4.10    "


def message(at_s, **values):
    return can.Message(timestamp=1_700_000_000 + at_s, channel=1, **values)


@pytest.mark.filterwarnings("ignore")  # of asammdf and its dependencies
def test_frames_of_python_can_are_read(tmp_path):
    pytest.importorskip("asammdf", reason="needs asammdf: pip install asammdf")
    data = bytes(range(8))
    with can.MF4Writer(tmp_path / "a.mf4") as writer:
        for one in (
            message(0.5, arbitration_id=0x123, data=data, is_extended_id=False),
            message(0.6, arbitration_id=0x1ABCDEF0, data=b"\1", is_rx=False),
            message(0.7, arbitration_id=0x5, data=bytes(64), is_extended_id=False, is_fd=True,
                    bitrate_switch=True, dlc=64),
            message(0.8, arbitration_id=0x701, is_remote_frame=True, is_extended_id=False, dlc=3),
            message(0.9, is_error_frame=True),
            message(1.0, arbitration_id=0x7FF, is_extended_id=False),
        ):  # fmt: skip
            writer(one)
    source, findings = open_source(tmp_path / "a.mf4"), Findings()
    frames = list(source.frames(findings))
    assert (source.format, findings.problems) == ("mf4", [])
    assert [(frame.frame, frame.direction) for frame in frames] == [
        (classic(0x123, data), R),
        (classic(0x1ABCDEF0 | can_frame.EFF, b"\1"), T),
        (flexible(0x5, can_frame.BRS, bytes(64)), R),
        (remote(0x701, 3), R),
        (classic(can_frame.ERR | 0x80, bytes(8)), R),
        (classic(0x7FF, b""), R),
    ]
    assert {frame.bus for frame in frames} == {"can0"}
    since = [frame.time_ns - frames[0].time_ns for frame in frames]
    assert since == pytest.approx([n * 100_000_000 for n in range(6)], abs=1000)  # floats of 1e9 s


def test_missing_asammdf_is_explained(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "asammdf", None)
    (tmp_path / "a.mf4").write_bytes(HEAD)
    with pytest.raises(TraceError, match=r"which asammdf reads; pip install 'motorhil\[mf4\]'"):
        list(open_source(tmp_path / "a.mf4").frames(Findings()))


def test_damaged_file_is_refused_by_name(tmp_path):
    pytest.importorskip("asammdf", reason="needs asammdf: pip install asammdf")
    (tmp_path / "a.mf4").write_bytes(HEAD + bytes(200))
    with pytest.raises(TraceError, match=r"a\.mf4: is not a readable MDF 4 file: no head"):
        list(open_source(tmp_path / "a.mf4").frames(Findings()))
