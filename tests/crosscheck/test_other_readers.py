"""Files of our writers in readers of other tools: the same frames, none left out.

Needs `tshark` (Debian package of that name) and `cantools` (from PyPI); each test is skipped aloud
without its reader. Versions tried: tshark 4.0.17, cantools 45.1.0.
"""

import subprocess

import pytest

from motorhil.harness.recording.conversion import convert
from motorhil.traces import can_frame
from motorhil.traces.can_frame import classic, flexible, remote
from motorhil.traces.formats.frames import Frame
from motorhil.traces.formats.registry import record_frames
from motorhil.traces.schema import Direction
from tests.support.dissector import tshark

R, T = Direction.RECEIVED, Direction.TRANSMITTED
EXT = 0x1ABCDEF0 | can_frame.EFF
S = 1_000_000_000
CANTOOLS = "needs cantools: pip install cantools"
CLASSIC = [
    Frame(1 * S, "can0", classic(0x181, b"\1\2\3"), R),
    Frame(2 * S, "can0", classic(EXT, bytes(range(8))), T),
    Frame(3 * S, "can0", classic(0x7FF, b""), R),
]
FLEXIBLE = [Frame(4 * S, "can0", flexible(0x123, 1, bytes(range(64))), T)]
REMOTE = [Frame(5 * S, "can0", remote(0x701, 1), R)]


@pytest.fixture
def written(tmp_path):
    """Return a function that writes frames in a format, and returns the file."""

    def write(frames, name, file):
        record_frames(tmp_path / "a.mcap", frames, {})
        convert(str(tmp_path / "a.mcap"), str(tmp_path / file), name)
        return str(tmp_path / file)

    return write


@pytest.mark.parametrize("name", ["candump", "blf", "pcapng"])
def test_tshark_reads_every_frame(written, name):
    program = tshark()
    if program is None:
        pytest.skip("tshark is not installed: apt-get install tshark")
    frames = CLASSIC + FLEXIBLE + REMOTE
    path = written(frames, name, "written")
    columns = ("can.id", "can.flags.xtd", "can.flags.rtr", "can.len", "data.data")
    fields = [word for column in columns for word in ("-e", column)]
    done = subprocess.run(
        [program, "-r", path, "-T", "fields", *fields], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    told = [can_frame.fields(frame.frame) for frame in frames]
    rows = [line.split("\t") for line in done.stdout.splitlines()]
    assert [int(row[0], 0) for row in rows] == [one.identifier for one in told]
    assert [row[1] in ("1", "True") for row in rows] == [one.can_id >> 31 == 1 for one in told]
    assert [int(row[3]) for row in rows] == [one.length for one in told]
    data = [row[4] for row in rows if row[2] not in ("1", "True")]
    assert data == [one.data.hex() for one in told if not one.can_id & can_frame.RTR]


@pytest.mark.parametrize(("name", "file"), [("candump", "a.log"), ("candump-x", "x.log")])
def test_cantools_reads_every_candump_row(written, name, file):
    reader = pytest.importorskip("cantools.logreader", reason=CANTOOLS)
    frames = CLASSIC + FLEXIBLE + REMOTE
    with open(written(frames, name, file), encoding="utf-8") as stream:
        found = list(reader.Parser(stream).iterlines(keep_unknowns=True))
    told = [can_frame.fields(frame.frame) for frame in frames]
    assert [one.frame_id for _, one in found] == [one.identifier for one in told]
    assert [bytes(one.data) for _, one in found] == [one.data for one in told]
    assert [one.is_remote_frame for _, one in found] == [one.can_id >> 30 & 1 == 1 for one in told]


@pytest.mark.parametrize("more", [[], [Frame(4 * S, "can1", classic(5, b"\1"), R)]])
def test_cantools_reads_every_row_of_a_trc_file(written, more):
    reader = pytest.importorskip("cantools.logreader", reason=CANTOOLS)
    frames = CLASSIC + more  # versions 2.0 and 2.1
    with open(written(frames, "trc", "a.trc"), encoding="utf-8") as stream:
        found = [one for _, one in reader.Parser(stream).iterlines(keep_unknowns=True) if one]
    told = [can_frame.fields(frame.frame) for frame in frames]
    assert [one.frame_id for one in found] == [one.identifier for one in told]
    assert [bytes(one.data) for one in found] == [one.data for one in told]
