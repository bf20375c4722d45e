"""CSV tables: ours, python-can's, SavvyCAN's. Sources: can/io/csv.py; framefileio.cpp."""

import csv
from io import StringIO

import can
import pytest

from motorhil.traces import can_frame
from motorhil.traces.can_frame import classic, flexible, remote
from motorhil.traces.formats.csv import COLUMNS, CsvReader, write_csv
from motorhil.traces.formats.frames import Findings, Frame, read_lines
from motorhil.traces.schema import Direction

OURS = ",".join(COLUMNS)
SAVVY = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8"


def read(*lines):
    findings = Findings()
    return list(findings.watched(read_lines(lines, CsvReader(), findings))), findings


def test_our_row_has_bus_with_blank_and_sender():
    frames, findings = read(OURS, "12.000000001,a b,181,0,data,0,0,received,left,2,0102")
    assert findings.problems == []
    told = (12_000_000_001, "a b", classic(0x181, b"\1\2"), Direction.RECEIVED, "left")
    assert tuple(frames[0]) == told


def test_python_can_table_is_read(tmp_path):
    with can.CSVWriter(tmp_path / "a.csv") as writer:
        writer(can.Message(1700000000.25, 0x123, False, data=b"\1\2"))
        writer(can.Message(1700000000.5, 0x1ABCDEF, True, is_remote_frame=True, dlc=3))
        writer(can.Message(1700000000.75, 0x7, False, is_fd=True, data=bytes(12)))
    frames, findings = read(*(tmp_path / "a.csv").read_text().splitlines())
    assert findings.problems == []
    second = 1_700_000_000 * 10**9
    assert [(frame.time_ns - second, frame.frame) for frame in frames] == [
        (250_000_000, classic(0x123, b"\1\2")),
        (500_000_000, remote(0x1ABCDEF | can_frame.EFF, 3)),
        (750_000_000, flexible(0x7, 0, bytes(12))),
    ]


def test_savvycan_table_has_microseconds():
    row = "166064000,0000021A,false,Rx,0,8,FE,36,12,FE,69,05,07,AD,"
    frames, findings = read(SAVVY, row, "166064001,1ABCDEF0,true,Tx,1,1,FF,")
    assert findings.problems == []
    assert [tuple(frame)[:4] for frame in frames] == [
        (166_064_000_000, "can0", classic(0x21A, bytes.fromhex("FE3612FE690507AD")),
         Direction.RECEIVED),
        (166_064_001_000, "can1", classic(0x1ABCDEF0 | can_frame.EFF, b"\xff"),
         Direction.TRANSMITTED),
    ]  # fmt: skip


def test_error_frame_in_savvycan_table_is_one():
    """SocketCAN's class of the error is in the identifier, with its flag 20000000h."""
    frames, findings = read(SAVVY, "166064000,20000088,true,Rx,0,8,0,0,80,19,0,0,0,0,")
    assert findings.problems == []
    error = classic(can_frame.ERR | 0x88, bytes.fromhex("0000801900000000"))
    assert [frame.frame for frame in frames] == [error]


@pytest.mark.parametrize(
    ("head", "row", "why"),
    [
        (OURS, "1.0,can0,181,0,data", "ends in the middle"),
        (OURS, "1.0,can0,181,0,data,0,0,received,,3,0102", "2 of 3 bytes"),
        (OURS, "1.0,can0,181,0,data,0,0,received,,2,01020", "not a sequence of bytes"),
        (OURS, "1.0,can0,181,0,data,0,0,sideways,,1,01", "'sideways'"),
        (OURS, "1.0,can0,181,0,noise,0,0,received,,1,01", "'noise'"),
        (OURS, "x,can0,181,0,data,0,0,received,,1,01", "not a time stamp"),
        (OURS, "1.0,can0,FFF,0,data,0,0,received,,1,01", "too large"),
        (OURS, '1.0,"can0,181', "unexpected end"),
        (SAVVY, "1,21A,false,Rx,0,2,FE", "ends in the middle"),
        (SAVVY, "1,21A,false,Rx,0,1,FEFE", "not a byte"),
        ("timestamp,arbitration_id,extended,remote,error,dlc,data", "1,1,0,0,0,1,A", "not base64"),
    ],
)
def test_unreadable_row_is_reported_with_line(head, row, why):
    frames, findings = read(head, row)
    assert frames == []
    ((line, text),) = findings.problems
    assert line == 2
    assert why in text


@pytest.mark.parametrize("name", ["=1+1", "+1", "-1", "@SUM(A1)", "'quoted", "\ttab", "left"])
@pytest.mark.parametrize("column", ["bus", "sender"])
def test_name_is_no_formula_of_a_spreadsheet_and_returns(column, name):
    if column == "bus":
        name = name.strip()  # it is written as one word
    told = StringIO()
    names = {"bus": "can0", "sender": "left", column: name}
    frame = Frame(1_000, names["bus"], classic(0x123, b"\0"), Direction.RECEIVED, names["sender"])
    write_csv(told, 9, iter([frame]))
    head, row = told.getvalue().splitlines()
    cell = next(csv.reader([row]))[head.split(",").index(column)]
    assert cell[0] not in "=+-@\t\r"
    reader, findings = CsvReader(), Findings()
    assert [one for line in (head, row) for one in reader.take(line, findings)] == [frame]
