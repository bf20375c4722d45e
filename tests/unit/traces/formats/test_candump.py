"""Rows of candump as people keep them. Source of the forms: can-utils, candump.c and lib.c."""

from calendar import timegm

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.traces import can_frame
from motorhil.traces.can_frame import classic, flexible, remote
from motorhil.traces.formats import frames as traffic
from motorhil.traces.formats.candump import CandumpReader, log_row, marked_row, plain_row
from motorhil.traces.formats.frames import Findings, Frame, read_lines
from motorhil.traces.schema import Direction


def read(*lines):
    findings = Findings()
    return list(findings.watched(read_lines(lines, CandumpReader(), findings))), findings


def one(line):
    frames, findings = read(line)
    assert findings.problems == []
    assert len(frames) == 1
    return frames[0]


EXT = 0x12345678 | can_frame.EFF
R, T = Direction.RECEIVED, Direction.TRANSMITTED


@pytest.mark.parametrize(
    ("line", "time_ns", "frame"),
    [
        ("(1345212884.318850) can0 123#0102", 1345212884318850000, classic(0x123, b"\1\2")),
        ("(1345212884.318850123) can0 123#", 1345212884318850123, classic(0x123, b"")),
        ("(1.5) can0 12345678#11.22", 1_500_000_000, classic(EXT, b"\x11\x22")),
        ("(0.0) can0 00000123#11", 0, classic(0x123 | can_frame.EFF, b"\x11")),
        ("(0.0) can0 123#R", 0, remote(0x123, 0)),
        ("(0.0) can0 123#R5", 0, remote(0x123, 5)),
        ("(0.0) can0 123##3AABB", 0, flexible(0x123, 3, b"\xaa\xbb")),
        ("(0.0) can0 20000004#0001000000000000", 0, classic(0x20000004, b"\0\1" + bytes(6))),
        ("  can0  123   [2]  01 02", 0, classic(0x123, b"\1\2")),
        ("  can0  12345678   [1]  01   '.'", 0, classic(EXT, b"\1")),
        ("  can0       123  [02]  01 02", 0, flexible(0x123, 0, b"\1\2")),
        ("  can0  123   [3]  remote request", 0, remote(0x123, 3)),
        ("  can0  080   [0] ", 0, classic(0x80, b"")),
        ("0128 [2] 0b 61 ", 0, classic(0x128, b"\x0b\x61")),
        (" (000.000123)  can0  123   [1]  01", 123_000, classic(0x123, b"\1")),
        (
            " (2012-08-17 14:14:44.318850)  can0  123   [1]  01",
            1345212884318850000,
            classic(0x123, b"\1"),
        ),
        ("  can0  20000004   [8]  00 01 00 00 00 00 00 00   ERRORFRAME", 0,
         classic(0x20000004, b"\0\1" + bytes(6))),
        ("  can0  TX B E  123  [01]  FF", 0, flexible(0x123, 3, b"\xff")),
    ],
)  # fmt: skip
def test_row_is_read(line, time_ns, frame):
    found = one(line)
    assert (found.time_ns, found.bus, found.frame) == (time_ns, "can0", frame)


@pytest.mark.parametrize(
    ("line", "direction"),
    [
        ("(0.0) can0 123#01 R", Direction.RECEIVED),
        ("(0.0) can0 123#01 T", Direction.TRANSMITTED),
        ("(0.0) can0 123#01", Direction.UNKNOWN),
        ("  can0  RX - -  123   [1]  01", Direction.RECEIVED),
        ("  can0  TX - -  123   [1]  01", Direction.TRANSMITTED),
    ],
)
def test_direction_is_read(line, direction):
    assert one(line).direction is direction


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("candump can0", "not a frame"),
        ("  can0  123   [8]  01 02 03", "3 of 8 bytes"),
        ("  can0  123   [1]  01 02", "more than 1 bytes"),
        ("  can0  123   [8]  01 02 0", "2 of 8 bytes"),
        ("(0.0) can0 123#012", "an incomplete byte"),
        ("(0.0) can0 123#010203040506070809", "9 bytes in a classic frame"),
        ("(0.0) can0 1234#01", "4 digits"),
        ("(0.0) can0 FFF#01", "29 bits|FFF"),
        ("(0.0) can0 123##", "without flags"),
        ("(0.0) can0 123#45:00:00#11", "CAN XL"),
        ("(99999999999999.0) can0 123#01", "2554"),
        ("\x00\x00\x00", "not a frame"),
    ],
)
def test_unreadable_row_is_reported_and_rest_is_read(line, why):
    frames, findings = read("(0.0) can0 001#01", line, "(0.1) can0 002#02")
    if line.startswith("(0.0) can0 FFF"):  # three digits beyond 11 bits can only be 29 bit
        assert len(frames) == 3
        return
    assert [frame.time_ns for frame in frames] == [0, 100_000_000]
    ((number, text),) = findings.problems
    assert number == 2
    assert why in text


def test_two_rows_in_one_line_are_two_frames():
    frames, findings = read("  can0  080   [0]   can0  481   [2]  52 1A  # why")
    assert [frame.frame for frame in frames] == [classic(0x80, b""), classic(0x481, b"\x52\x1a")]
    assert (findings.problems, findings.comments) == ([], 1)
    assert "more than one row" in findings.notes[0]


def test_cut_second_row_is_problem_of_its_line():
    frames, findings = read("(0.0) can0 080#01(0.1) can0 481#5", "(0.2) can0 081# (0.3) can0 48")
    assert [frame.time_ns for frame in frames] == [0, 200_000_000]
    assert [problem.line for problem in findings.problems] == [1, 2]


def test_comments_are_counted_without_problem():
    frames, findings = read(
        "# boot",
        "// said",
        "",
        "  can0  701   [1]  7F    # Heartbeat",
        "  can0  701   [1]  7F <--- x",
    )
    assert (len(frames), findings.comments, findings.problems) == (2, 4, [])


def test_words_after_error_frame_are_not_a_row():
    _, findings = read(
        "  can0  20000004   [8]  00 01 00 00 00 00 00 00   ERRORFRAME",
        "\tcontroller-problem{rx-overflow}",
        "  can0  701   [1]  7F",
        "\tcontroller-problem{rx-overflow}",
    )
    assert [problem.line for problem in findings.problems] == [4]


def test_missing_or_backward_stamps_are_counted():
    frames, findings = read("(5.0) a 1FF#", "(4.5) a 1FF#", "(7.0) a 1FF#", "  a  1FF   [0] ")
    assert [frame.time_ns for frame in frames] == [5 * 10**9, 45 * 10**8, 7 * 10**9, 0]
    assert (findings.unstamped, findings.backward) == (1, 2)
    assert findings.largest_step_back_ns == 7 * 10**9


IDENTIFIERS = st.integers(0, 0x7FF) | st.integers(0, 0x1FFFFFFF).map(lambda n: n | can_frame.EFF)
FRAMES = (
    st.builds(classic, IDENTIFIERS, st.binary(max_size=8))
    | st.builds(remote, IDENTIFIERS, st.integers(0, 8))
    | st.builds(flexible, IDENTIFIERS, st.integers(0, 3), st.binary(max_size=64))
    | st.builds(
        classic,
        st.integers(0, 0x1FFFFFFF).map(lambda n: n | can_frame.ERR),
        st.binary(min_size=8, max_size=8),
    )
)


@given(st.integers(0, traffic.TIME_MAX), FRAMES, st.sampled_from(Direction))
def test_written_log_row_is_read_again(time_ns, frame, direction):
    told = Frame(time_ns, "vcan-7", frame, direction)
    assert one(marked_row(told, places=9)) == told
    assert one(log_row(told, places=9)) == told._replace(direction=Direction.UNKNOWN)


@pytest.mark.parametrize("bus", ["[", "[8]", "(1)", "123", "RX"])
def test_interface_can_have_any_name_without_blank(bus):
    told = Frame(1, bus, classic(0x123, bytes(8)), R)
    for row in (plain_row(told, places=9), marked_row(told, places=9)):
        assert one(row) == told


@given(st.text(alphabet=" ()#[]0189AFRT.:_can'-\t", max_size=60))
def test_any_line_is_read_or_reported(line):
    frames, findings = read(line)
    assert frames or findings.problems or findings.comments or not line.strip()


@given(st.integers(0, traffic.TIME_MAX))
def test_dates_match_standard_library(time_ns):
    day_s = time_ns // 10**9 // 86400 * 86400
    assert timegm((*traffic.date_of(time_ns), 0, 0, 0)) == day_s
    assert traffic.date_ns(*traffic.date_of(time_ns)) == day_s * 10**9


@pytest.mark.parametrize(
    ("frame", "row"),
    [  # columns as in `candump -t a -x`
        (Frame(1, "can0", classic(0x123, b"\1\2"), R),
         " (0000000000.000000)  can0  RX - -  123   [2]  01 02\n"),
        (Frame(10**18, "vcan1", classic(EXT, b""), T),
         " (1000000000.000000)  vcan1  TX - -  12345678   [0]\n"),
        (Frame(0, "can0", remote(0x701, 3), R),
         " (0000000000.000000)  can0  RX - -  701   [3]  remote request\n"),
        (Frame(0, "can0", flexible(0x77, 3, b"\xff"), R),
         " (0000000000.000000)  can0  RX B E  077   [01]  FF\n"),
        (Frame(0, "can0", classic(can_frame.ERR | 4, bytes(8)), R),
         " (0000000000.000000)  can0  RX - -  20000004   [8]"
         "  00 00 00 00 00 00 00 00   ERRORFRAME\n"),
    ],
)  # fmt: skip
def test_plain_row_is_written(frame, row):
    assert plain_row(frame) == row
