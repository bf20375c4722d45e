"""Rows of BUSMASTER and MiniMon. Sources: SavvyCAN; canopen-message-interpreter; Wireshark."""

import shutil
import subprocess
from itertools import pairwise

import pytest

from motorhil.traces import can_frame
from motorhil.traces.can_frame import classic, remote
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.registry import open_source
from motorhil.traces.schema import Direction

R, T, U = Direction.RECEIVED, Direction.TRANSMITTED, Direction.UNKNOWN
EXT = can_frame.EFF
START_S = 1407498547  # 2014-08-08 11:49:07 UTC
HEAD = """***BUSMASTER Ver 2.4.0***
***PROTOCOL CAN***
***NOTE: PLEASE DO NOT EDIT THIS DOCUMENT***
***[START LOGGING SESSION]***
***START DATE AND TIME 8:8:2014 11:49:7:965***
***{base}***
***{mode} MODE***
***START CHANNEL BAUD RATE***
***CHANNEL 1 - Kvaser - Kvaser Leaf Light HS #0 (Channel 0), Serial Number- 0 - 500000 bps***
***END CHANNEL BAUD RATE***
***START DATABASE FILES (DBF/DBC)***
***END OF DATABASE FILES (DBF/DBC)***
***<Time><Tx/Rx><Channel><CAN ID><Type><DLC><DataBytes>***
"""
TAIL = "***END DATE AND TIME 8:8:2014 11:50:7:965***\n***[STOP LOGGING SESSION]***\n"
ROWS = """11:49:12:9420 Rx 1 0x023 s 1 40
11:49:12:9440 Tx 1 0x460 s 8 03 E0 00 00 C0 00 00 00
11:49:12:9531 Rx 2 0x18EF1234 x 2 01 02
11:49:12:9680 Rx 1 0x408 sr 3
"""
MINIMON = """ASCII Trace IXXAT MiniMon V3  Version: 1.1.4.4533
Date: 5/9/2024
Start time: 2:37:37 PM
Stop time: 2:37:37 PM
Overruns:
Baudrate: 500 kbit/s
"Time","Identifier (hex)","Format","Flags","Data (hex)"
"00:30:06.866","184","Std","","00 06 00 16 75 EE 00 3C"
"00:30:06.867","1ABCDEF0","Ext","","00 "
"00:30:06.9","701","Std","Rtr","Remote request  DLC = 1"
"00:30:06.901","7FF","Std","",""
"""


def read(tmp_path, text):
    (tmp_path / "some.log").write_text(text)
    source = open_source(tmp_path / "some.log")
    findings = Findings()
    return source.format, list(source.frames(findings)), findings


def test_busmaster_rows_are_read(tmp_path):
    text = HEAD.format(base="HEX", mode="SYSTEM") + ROWS + TAIL
    name, frames, findings = read(tmp_path, text)
    assert (name, findings.problems) == ("busmaster", [])
    at = [(START_S + 5) * 10**9 + part * 100_000 for part in (9420, 9440, 9531, 9680)]
    assert [tuple(frame)[:4] for frame in frames] == [
        (at[0], "can0", classic(0x23, b"\x40"), R),
        (at[1], "can0", classic(0x460, bytes.fromhex("03E00000C0000000")), T),
        (at[2], "can1", classic(0x18EF1234 | EXT, b"\1\2"), R),
        (at[3], "can0", remote(0x408, 3), R),
    ]


def test_decimal_rows_have_decimal_bytes(tmp_path):
    text = HEAD.format(base="DEC", mode="SYSTEM") + "11:49:12:9420 Rx 1 35 s 2 255 010\n"
    _, frames, findings = read(tmp_path, text)
    assert findings.problems == []
    assert frames[0].frame == classic(35, b"\xff\x0a")


@pytest.mark.parametrize(
    ("mode", "rows", "since_ms"),
    [
        ("ABSOLUTE", ("0:0:1:0000", "0:0:2:5000"), (1000, 2500)),
        ("RELATIVE", ("0:0:1:0000", "0:0:2:5000"), (1000, 3500)),
    ],
)
def test_other_times_count_from_start_or_row_before(tmp_path, mode, rows, since_ms):
    text = "".join(f"{stamp} Rx 1 0x023 s 0\n" for stamp in rows)
    _, frames, _ = read(tmp_path, HEAD.format(base="HEX", mode=mode) + text)
    start_ms = START_S * 1000 + 965
    assert [frame.time_ns // 10**6 - start_ms for frame in frames] == list(since_ms)


def test_midnight_begins_the_next_day(tmp_path):
    rows = "23:59:59:0000 Rx 1 0x023 s 0\n00:00:01:0000 Rx 1 0x023 s 0\n"
    _, frames, findings = read(tmp_path, HEAD.format(base="HEX", mode="SYSTEM") + rows)
    assert frames[1].time_ns - frames[0].time_ns == 2 * 10**9
    assert findings.backward == 0


@pytest.mark.parametrize(
    ("row", "why"),
    [
        ("11:49:12:9420 Rx 1 0x023 s 3 40", "1 of 3 bytes"),
        ("11:49:12:9420 Rx 1 0x823 s 1 40", "is too large"),
        ("11:49:12:9420 Rx 1 0x023 s 1 GG", "is not a number"),
        ("11:49:12:9420 Rx 1", "not a frame"),
    ],
)
def test_unreadable_busmaster_row_is_reported(tmp_path, row, why):
    text = HEAD.format(base="HEX", mode="SYSTEM") + ROWS + row + "\n"
    _, frames, findings = read(tmp_path, text)
    assert len(frames) == 4
    assert why in findings.problems[0].text


def test_busmaster_times_and_frames_match_tshark(tmp_path):
    program = shutil.which("tshark")
    if program is None:
        pytest.skip("tshark is not installed: apt-get install tshark")
    text = HEAD.format(base="HEX", mode="SYSTEM") + ROWS + TAIL
    _, frames, _ = read(tmp_path, text)
    words = [program, "-r", str(tmp_path / "some.log"), "-T", "fields", "-e", "can.id"]
    words += ["-e", "frame.time_delta", "-e", "can.len"]
    out = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    rows = [line.split("\t") for line in out.splitlines()]
    told = [can_frame.fields(frame.frame) for frame in frames]
    assert [int(row[0], 0) for row in rows] == [one.identifier for one in told]
    assert [int(row[2]) for row in rows] == [one.length for one in told]
    deltas = [0] + [b.time_ns - a.time_ns for a, b in pairwise(frames)]
    assert [round(float(row[1]) * 1e9) for row in rows] == deltas


@pytest.mark.parametrize("separator", [",", ";"])
def test_minimon_rows_are_read(tmp_path, separator):
    name, frames, findings = read(tmp_path, MINIMON.replace('","', f'"{separator}"'))
    assert (name, findings.problems) == ("minimon", [])
    assert [tuple(frame)[:4] for frame in frames] == [
        (1806_866_000_000, "can0", classic(0x184, bytes.fromhex("0006001675EE003C")), U),
        (1806_867_000_000, "can0", classic(0x1ABCDEF0 | EXT, b"\0"), U),
        (1806_900_000_000, "can0", remote(0x701, 1), U),
        (1806_901_000_000, "can0", classic(0x7FF, b""), U),
    ]


def test_unreadable_minimon_row_is_reported(tmp_path):
    text = MINIMON + '"00:30:06.902","184","Std","","0G"\n"00:30:06.9\n'
    _, frames, findings = read(tmp_path, text)
    assert len(frames) == 4
    assert [problem.line for problem in findings.problems] == [12, 13]
