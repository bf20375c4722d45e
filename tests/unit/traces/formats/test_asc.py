"""ASC rows, classic and CAN FD. Sources: Vector's format description; python-can; real files."""

import can
import pytest

from motorhil.traces import can_frame
from motorhil.traces.can_frame import classic, flexible, remote
from motorhil.traces.formats.asc import AscReader
from motorhil.traces.formats.frames import Findings, read_lines
from motorhil.traces.schema import Direction

R, T, U = Direction.RECEIVED, Direction.TRANSMITTED, Direction.UNKNOWN
EXT = 0x18EBFF00 | can_frame.EFF


def read(*lines):
    findings = Findings()
    frames = list(findings.watched(read_lines(lines, AscReader(), findings)))
    return frames, findings


@pytest.mark.parametrize(
    ("row", "bus", "frame", "way"),
    [
        ("0.5 1  C8  Tx   d 2 09 08", "can0", classic(0xC8, b"\x09\x08"), T),
        ("0.5 2  18EBFF00x       Rx   d 1 01  Length = 273910 BitCount = 141 ID = 418119424x",
         "can1", classic(EXT, b"\1"), R),
        ("0.5 1  64              Rx   r", "can0", remote(0x64, 0), R),
        ("0.5 1  64              Rx   r 8 Length = 0 BitCount = 64 ID = 100x", "can0",
         remote(0x64, 8), R),
        ("0.5 1  64              Rx   r Length = 0 BitCount = 64 ID = 100", "can0",
         remote(0x64, 0), R),
        ("0.5 1  4EE  Rx   d f " + "a1 " * 64, "can0", flexible(0x4EE, 0, b"\xa1" * 64), R),
        ("0.5 1  4EE  Rx   d 40 " + "a1 " * 64, "can0", flexible(0x4EE, 0, b"\xa1" * 64), R),
        ("0.5 1  4EE  Rx   d 9 " + "a1 " * 8 + "Length = 0 BitCount = 64 ID = 1262", "can0",
         classic(0x4EE, b"\xa1" * 8), R),
        ("0.5 CANFD   1 Rx   4EE   1 0 f 64 " + "a1 " * 64, "can0",
         flexible(0x4EE, 1, b"\xa1" * 64), R),
        ("0.5 1  ErrorFrame", "can0", classic(can_frame.ERR | 0x80, bytes(8)), U),
        ("0.5 CANFD   1 Rx   4EE   Name_1  1 0 f 64 " + "a1 " * 64 + "0 0 303000 0 0", "can0",
         flexible(0x4EE, 1, b"\xa1" * 64), R),
        ("0.5 CANFD   1 Tx 18EBFF00x  0 1 2  2 01 02  130 4 1000 0 0", "can0",
         flexible(EXT, 2, b"\1\2"), T),
        ("0.5 CANFD   1 Tx 4EE  0 0 2  2 01 02  130 4 0 0 0", "can0", classic(0x4EE, b"\1\2"), T),
    ],
)  # fmt: skip
def test_row_is_read(row, bus, frame, way):
    frames, findings = read("base hex  timestamps absolute", row)
    assert findings.problems == []
    assert [tuple(found)[:4] for found in frames] == [(500_000_000, bus, frame, way)]


def test_decimal_identifiers_and_data_are_read():
    frames, _ = read("base dec  timestamps absolute", "0.5 1  200  Rx   d 2 10 255")
    assert frames[0].frame == classic(200, b"\x0a\xff")


def test_relative_times_count_from_previous_row():
    frames, _ = read("base hex timestamps relative", *["0.250001 1 64 Rx d 0"] * 3)
    assert [frame.time_ns for frame in frames] == [250_001_000, 500_002_000, 750_003_000]


@pytest.mark.parametrize(
    ("date", "start_s"),
    [
        ("date Sat Sep 09 02:13:00 AM 2018", 1536459180),
        ("date Sat Sep 30 15:06:13.191 2017", 1506783973.191),
        ("date Sam Mai 6 10:06:13.191 pm 2017", 1494108373.191),
        ("date Thu Jan 1 12:30:00 PM 2015", 1420115400),
        ("date Thu Jan 1 12:30:00 AM 2015", 1420072200),
        ("date 9.9.2018", 0),
    ],
)
def test_date_is_start_time(date, start_s):
    frames, findings = read(date, "0.0 1 64 Rx d 0")
    assert frames[0].time_ns == round(start_s * 1000) * 1_000_000
    assert bool(findings.notes) is (start_s == 0)


@pytest.mark.parametrize(
    ("row", "why"),
    [
        ("0.5 1  C8  Tx   d 3 09 08", "2 of 3 bytes"),
        ("0.5 1  C8  Tx   d", "ends in the middle"),
        ("0.5 1  C8", "ends in the middle"),
        ("0.5", "ends in the middle"),
        ("0.5 1  C8  Tx   d 2 09 GG", "not a sequence of bytes"),
        ("0.5 1  FFF  Tx   d 0", "too large"),
        ("0.5 1  xyz  Tx   d 0", "not an identifier"),
        ("0.5 CANFD 1 Rx 4EE 1 0 f 64 a1", "1 of 64 bytes"),
        ("0.5 CANFD 1 Rx", "ends in the middle"),
        ("0.5 J1939TP FEE3p 6 0 0 - Rx d 23", "another event"),
        ("nonsense", "not a row"),
    ],
)
def test_unreadable_row_is_reported_with_line(row, why):
    frames, findings = read("base hex timestamps absolute", row)
    assert frames == []
    ((line, text),) = findings.problems
    assert line == 2
    assert why in text


def test_file_of_python_can_is_read(tmp_path):
    told = [
        can.Message(1.5, 0x123, False, data=b"\1\2", channel=0),
        can.Message(1.75, 0x1ABCDEF, True, data=bytes(8), channel=1, is_rx=False),
        can.Message(2.0, 0x7, False, is_remote_frame=True, dlc=3, channel=0),
        can.Message(2.5, 0x8, False, is_fd=True, bitrate_switch=True, data=bytes(12), channel=0),
    ]
    with can.ASCWriter(tmp_path / "a.asc") as writer:
        for message in told:
            writer(message)
    frames, findings = read(*(tmp_path / "a.asc").read_text().splitlines())
    assert findings.problems == []
    first_ns = frames[0].time_ns
    found = [(f.time_ns - first_ns, f.bus, f.frame, f.direction) for f in frames]
    assert found == [
        (0, "can0", classic(0x123, b"\1\2"), R),
        (250_000_000, "can1", classic(0x1ABCDEF | can_frame.EFF, bytes(8)), T),
        (500_000_000, "can0", remote(0x7, 3), R),
        (1_000_000_000, "can0", flexible(0x8, 1, bytes(12)), R),
    ]


def test_stamp_too_late_with_the_date_is_reported():
    row = "18446744073.0 1  C8  Tx   d 0"
    frames, findings = read("date Fri Nov 27 10:00:00 am 2026", "base hex timestamps absolute", row)
    assert not frames
    ((_, told),) = findings.problems
    assert "beyond the year 2554" in told
