"""TRC rows of all versions. Sources: PEAK CAN TRC File Format 2.1.1; real files."""

import pytest

from motorhil.harness.recording.conversion import convert
from motorhil.traces import can_frame
from motorhil.traces.can_frame import classic, flexible, remote
from motorhil.traces.formats.frames import Findings, Frame, read_lines
from motorhil.traces.formats.registry import open_source, record_frames
from motorhil.traces.formats.trc import TrcReader
from motorhil.traces.schema import Direction

R, T, U = Direction.RECEIVED, Direction.TRANSMITTED, Direction.UNKNOWN
EXT = 0x18FFEF00 | can_frame.EFF
HEAD_2 = (";$FILEVERSION=2.1", ";$STARTTIME=25570.5", ";$COLUMNS=N,O,T,B,I,d,R,L,D")
DAY_AND_HALF_NS = 129_600 * 10**9


def read(*lines):
    findings = Findings()
    frames = list(findings.watched(read_lines(lines, TrcReader(), findings)))
    return frames, findings


@pytest.mark.parametrize(
    ("row", "time_ns", "bus", "frame", "way"),
    [
        ("     1)      1841 0001 8 00 11 22 33 44 55 66 77", 1841000000, "can0",
         classic(1, bytes.fromhex("0011223344556677")), U),
        ("     1)    1059.9  Rx         0300  2  1A 2B ", 1059900000, "can0",
         classic(0x300, b"\x1a\x2b"), R),
        ("     1)    1059.9  Tx     18FFEF00  0", 1059900000, "can0", classic(EXT, b""), T),
        ("     1)    1059.9  Rx         0300  4  RTR", 1059900000, "can0", remote(0x300, 4), R),
        ("     1)   1059.900 1  Rx        0300  1  FF", 1059900000, "can0",
         classic(0x300, b"\xff"), R),
        ("     1)   1059.900 2  Rx        0300 -  1    FF", 1059900000, "can1",
         classic(0x300, b"\xff"), R),
        ("   Line 12:  1)   1059.900   Rx     0300  1  FF", 1059900000, "can0",
         classic(0x300, b"\xff"), R),
    ],
)  # fmt: skip
def test_row_of_version_1_is_read(row, time_ns, bus, frame, way):
    frames, findings = read(row)
    assert findings.problems == []
    assert [tuple(found)[:4] for found in frames] == [(time_ns, bus, frame, way)]


@pytest.mark.parametrize(
    ("row", "bus", "frame", "way"),
    [
        ("1 1059.900 DT 1 0300 Rx - 2 00 01", "can0", classic(0x300, b"\0\1"), R),
        ("1 1059.900 RR 2 18FFEF00 Tx - 3", "can1", remote(EXT, 3), T),
        ("1 1059.900 FB 1 0300 Rx - 9 " + "11 " * 12, "can0", flexible(0x300, 1, b"\x11" * 12), R),
        ("1 1059.900 FE 1 0300 Rx - 0", "can0", flexible(0x300, 3, b""), R),
        ("1 1059.900 BI 1 0300 Rx - 1 55", "can0", flexible(0x300, 2, b"\x55"), R),
        ("1 1059.900 FD 1 0300 Rx - 1 55", "can0", flexible(0x300, 0, b"\x55"), R),
    ],
)
def test_row_of_version_2_is_read(row, bus, frame, way):
    frames, findings = read(*HEAD_2, row)
    assert findings.problems == []
    time_ns = DAY_AND_HALF_NS + 1_059_900_000
    assert [tuple(found)[:4] for found in frames] == [(time_ns, bus, frame, way)]


def test_start_time_is_rounded_to_its_resolution():
    frames, _ = read(";$STARTTIME=45364.369224537", "  1)  0.0  Rx  0001  0")
    assert frames[0].time_ns == 1710319901 * 10**9  # 13.03.2024 08:51:41, as stated in that file


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        (("   3)  5.0  Warng  FFFFFFFF  4  00 00 00 08  BUSHEAVY",), "state of the interface"),
        (("   3)  5  FFFFFFFF  4  00 00 00 08  BUSHEAVY",), "state of the interface"),
        (("   3)  5.0  Rx  0300  3  01 02",), "2 of 3 bytes"),
        (("   3)  5.0  Rx  0300  3  01 02 0",), "not a sequence of bytes"),
        (("   3)  5.0  Rx",), "not a frame"),
        (("   3)  -5.0  Rx  0300  0",), "not a time stamp"),
        ((*HEAD_2, "1 1059.900 ST 1 - Rx - 4 00 00 00 00"), "state of the interface"),
        ((*HEAD_2, "1 1059.900 ER 1 - Rx - 5 04 00 02 00 00"), "error frame"),
        ((*HEAD_2, "1 1059.900 DT 1"), "ends in the middle"),
        ((*HEAD_2, "1 1059.900 DT 1 0300 Rx - 8 00 01"), "2 of 8 bytes"),
        ((*HEAD_2, "1 x DT 1 0300 Rx - 0"), "not a time stamp"),
        ((";$COLUMNS=N,O",), "columns without"),
    ],
)
def test_unreadable_row_is_reported_with_line(lines, why):
    frames, findings = read(*lines)
    assert frames == []
    ((line, text),) = findings.problems
    assert line == len(lines)
    assert why in text


def test_bytes_beyond_8_are_reported_frame_is_kept():
    frames, findings = read(*HEAD_2, "1 0.0 DT 1 0000 Rx - 10 " + "00 " * 8 + "77 E4")
    assert frames[0].frame == classic(0, bytes(8))
    assert findings.problems == [(4, "after 8 bytes of data there are '77 E4'")]


def test_file_of_one_bus_has_what_savvycan_expects(tmp_path):
    """SavvyCAN, framefileio.cpp: PCAN in the first 25 lines, version 2.0, rows of 42 characters."""
    frames = [
        Frame(1_000_056_000, "can0", classic(0x123, b"\1"), R),
        Frame(1_001_000_000, "can0", classic(EXT, bytes(range(8))), T),
        Frame(1_002_000_000, "can0", classic(5, b""), R),
    ]
    record_frames(tmp_path / "a.mcap", frames, {})
    convert(str(tmp_path / "a.mcap"), str(tmp_path / "a.trc"), "trc")
    lines = (tmp_path / "a.trc").read_text().splitlines()
    assert lines[0] == ";$FILEVERSION=2.0"
    assert any("PCAN" in line for line in lines[:25])
    rows = [line for line in lines if not line.startswith(";")]
    assert all(len(row) > 41 for row in rows)
    tokens = [row.split() for row in rows]
    assert [float(row[1]) for row in tokens] == [0.056, 1.0, 2.0]
    assert [row[3] for row in tokens] == ["0123", f"{EXT & 0x1FFFFFFF:08X}", "0005"]
    assert [row[4] for row in tokens] == ["Rx", "Tx", "Rx"]
    assert [(int(row[5]), bytes.fromhex("".join(row[6:]))) for row in tokens] == [
        (1, b"\1"),
        (8, bytes(range(8))),
        (0, b""),
    ]
    assert list(open_source(tmp_path / "a.trc").frames(Findings())) == frames


@pytest.mark.parametrize("can_id", ["1FFFFFFFF0", "8000000000000001"])
def test_identifier_of_more_than_32_bits_is_a_finding(can_id):
    frames, findings = read(*HEAD_2, f"      1      1059.900 DT 1 {can_id} Rx -  1 FF")
    assert frames == []
    assert any("has more than 29 bits" in one for one in map(str, findings.problems))


@pytest.mark.parametrize("row", ["1) 18446744073709 0300 0", "1 18446744073709 DT 1 0300 Rx - 0"])
def test_stamp_too_late_with_the_start_is_reported(row):
    head = HEAD_2[: 3 if "DT" in row else 2]
    frames, findings = read(*head, row)
    assert not frames
    ((_, told),) = findings.problems
    assert "beyond the year 2554" in told
