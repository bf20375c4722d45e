"""Damaged or invented lines of any text format do not raise exceptions."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motorhil.traces.formats.asc import AscReader
from motorhil.traces.formats.candump import CandumpReader, SdRowReader
from motorhil.traces.formats.csv import COLUMNS, CsvReader
from motorhil.traces.formats.frames import Findings, read_lines
from motorhil.traces.formats.trc import TrcReader
from tests.support.repetition import examples

WHOLE = {
    CandumpReader: [
        "(1345212884.318850) can0 12345678##3.11.22 R",
        " (2012-08-17 14:14:44.318850)  can0  RX B E  123  [02]  11 22  # why",
        "  can0  123   [3]  remote request",
    ],
    TrcReader: [
        ";$STARTTIME=45364.369224537",
        "     1)   1059.900 1  Rx        0300 -  2    FF 00",
        ";$COLUMNS=N,O,T,B,I,d,R,L,D",
        "1 1059.900 FB 1 0300 Rx - 9 11 11 11 11 11 11 11 11 11 11 11 11",
    ],
    AscReader: [
        "date Sat Sep 30 10:06:13.191 PM 2017",
        "base hex  timestamps relative",
        "0.5 2  18EBFF00x       Rx   d 1 01  Length = 273910 BitCount = 141",
        "0.5 CANFD   1 Rx   4EE   Name_1  1 0 1 1 a1 0 0 303000 0 0",
        "0.5 1  ErrorFrame",
    ],
    CsvReader: [",".join(COLUMNS), "12.5,can0,181,0,data,0,0,received,left,2,0102"],
    SdRowReader: ["000000ADx089A0C020000000000000000"],
}
PIECES = st.text(alphabet="0123456789ABCDEFx#[]().,:;$=- \t\0Rrdé²\"'", max_size=4)


@pytest.mark.parametrize("reader", WHOLE, ids=lambda reader: reader.name)
@settings(max_examples=examples(60))
@given(data=st.data())
def test_damaged_line_is_read_or_reported(reader, data):
    lines = list(WHOLE[reader])
    which = data.draw(st.integers(0, len(lines) - 1))
    line = lines[which]
    begin = data.draw(st.integers(0, len(line)))
    end = data.draw(st.integers(begin, min(len(line), begin + 3) if begin else len(line)))
    lines[which] = line[:begin] + data.draw(PIECES) + line[end:]
    findings = Findings()
    for frame in read_lines(lines, reader(), findings):
        assert frame.time_ns >= 0
        assert len(frame.frame) in (16, 72)
