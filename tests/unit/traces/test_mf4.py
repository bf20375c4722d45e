"""Bus events in MDF 4 files, against python-can and asammdf."""

import sys
import tempfile
from pathlib import Path

import can
import pytest
from hypothesis import given

from motorhil.harness.recording.conversion import convert
from motorhil.traces import can_frame
from motorhil.traces.can_frame import classic, flexible, remote
from motorhil.traces.errors import TraceError
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.formats.registry import WRITABLE, open_source, record_frames
from motorhil.traces.schema import Direction
from tests.properties.test_formats_random import expected, recordings, told

MF4 = next(form for form in WRITABLE if form.name == "mf4")
START_NS = 1_700_000_000_123_456_789
R, T = Direction.RECEIVED, Direction.TRANSMITTED
HEAD = b"MDF     4.10    "


def message(at_s, **values):
    return can.Message(timestamp=1_700_000_000 + at_s, channel=1, **values)


@pytest.fixture
def asammdf():
    return pytest.importorskip("asammdf", reason="needs asammdf: pip install asammdf")


@pytest.mark.filterwarnings("ignore")  # of asammdf and its dependencies
@pytest.mark.usefixtures("asammdf")
def test_frames_of_python_can_are_read(tmp_path):
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


@pytest.mark.usefixtures("asammdf")
def test_damaged_file_is_refused_by_name(tmp_path):
    (tmp_path / "a.mf4").write_bytes(HEAD + bytes(200))
    with pytest.raises(TraceError, match=r"a\.mf4: is not a readable MDF 4 file: no head"):
        list(open_source(tmp_path / "a.mf4").frames(Findings()))


@pytest.mark.usefixtures("asammdf")
@given(recordings(MF4.holds))
def test_python_can_reads_the_frames_written(frames):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record_frames(folder / "a.mcap", frames, {})
        convert(folder / "a.mcap", folder / "b.mf4", "mf4")
        with can.MF4Reader(folder / "b.mf4") as reader:
            found = list(reader)
    # Its times are floats since 1970, from a start in microseconds: near frames change places.
    assert sorted((one[0] - 1, *one[1:]) for one in map(told, found)) == sorted(
        map(expected, frames)
    )
    for message, frame in zip(found, frames, strict=True):
        assert message.timestamp == pytest.approx(frame.time_ns / 1e9, rel=1e-15, abs=1e-6)


DBC = 'VERSION ""\n\nBU_: A\n\nBO_ 291 Speed: 8 A\n SG_ rpm : 0|16@1+ (0.5,0) [0|0] "rpm" A\n'


@pytest.fixture
def written(tmp_path, asammdf):
    """Return an open file with frames of two buses, one of each kind, and 12 with a speed."""
    speeds = [(n, f"can{n % 2}", classic(0x123, bytes([n, 0] * 4)), R) for n in range(12)]
    others = [
        (20, "can1", flexible(0x1ABCDEF0 | can_frame.EFF, 3, bytes(range(12))), T),
        (21, "can0", remote(0x701, 3), R),
        (22, "can1", classic(can_frame.ERR | 0x8, bytes(range(8))), R),
    ]
    frames = [Frame(START_NS + at * 1001, *one) for at, *one in speeds + others]
    record_frames(tmp_path / "a.mcap", frames, {})
    convert(tmp_path / "a.mcap", tmp_path / "b.mf4", "mf4")
    with asammdf.MDF(tmp_path / "b.mf4") as mdf:
        yield mdf


def test_bus_logging_has_groups_fields_and_start(written):
    assert written.header.abs_time == START_NS
    assert written.header.start_time.isoformat() == "2023-11-14T22:13:20.123457+00:00"
    fields = {}
    for number, kind in enumerate(("CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame")):
        signal = written.get(kind, number)
        last = signal.samples[-1]
        fields[kind] = {name.removeprefix(f"{kind}."): last[name] for name in last.dtype.names}
    data = fields["CAN_DataFrame"]
    assert bytes(data.pop("DataBytes")[:12]) == bytes(range(12))
    assert data == {
        **{"BusChannel": 2, "ID": 0x1ABCDEF0, "IDE": 1, "DLC": 9, "DataLength": 12, "Dir": 1},
        **{"EDL": 1, "BRS": 1, "ESI": 1},
    }
    remote_frame, error = fields["CAN_RemoteFrame"], fields["CAN_ErrorFrame"]
    assert (remote_frame["ID"], remote_frame["DLC"], remote_frame["DataLength"]) == (0x701, 3, 0)
    assert (error["BusChannel"], error["ID"], bytes(error["DataBytes"][:8])) == (
        *(2, 8),
        bytes(range(8)),
    )


def test_asammdf_extracts_signals_of_each_bus(written, tmp_path):
    (tmp_path / "speed.dbc").write_text(DBC)
    with written.extract_bus_logging({"CAN": [(tmp_path / "speed.dbc", 0)]}) as found:
        signals = [found.get("rpm", number, at) for number, at in found.channels_db["rpm"]]
    values = sorted(value for one in signals for value in one.samples.tolist())
    assert values == [0.5 * n for n in range(12)]


@pytest.mark.usefixtures("asammdf")
def test_failed_write_leaves_no_file(tmp_path, monkeypatch):
    record_frames(tmp_path / "a.mcap", [Frame(0, "can0", classic(1, b""), R)], {})
    (tmp_path / "b.mf4").write_bytes(b"before")

    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("asammdf.MDF.save", fail)
    with pytest.raises(TraceError, match=r"b\.mf4: cannot be written: no space left"):
        convert(tmp_path / "a.mcap", tmp_path / "b.mf4", "mf4", overwrite=True)
    assert (tmp_path / "b.mf4").read_bytes() == b"before"
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.mcap", "b.mf4"]


def test_writing_without_asammdf_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "asammdf", None)
    (tmp_path / "a.log").write_text("(1.0) can0 123#01\n")
    with pytest.raises(TraceError, match=r"without asammdf; pip install 'motorhil\[mf4\]', or"):
        convert(tmp_path / "a.log", tmp_path / "b.mf4", "mf4")
    assert not list(tmp_path.glob("b.mf4*"))
