"""python-can's readers and writers for CAN FD and error frames, against ours.

Features that they do not store are listed where they occur, as of python-can 4.6.1.
"""

import can
import pytest

from motorhil.harness.recording.conversion import convert
from motorhil.traces import can_frame
from motorhil.traces.can_frame import ERR, classic, flexible
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.formats.registry import WRITABLE, open_source, record_frames
from motorhil.traces.schema import Direction

R = Direction.RECEIVED
S = 1_000_000_000
FORMAT_OF = {form.ending: form.name for form in WRITABLE} | {".log": "candump-x"}
FD = [
    Frame((n + 1) * S, "can0", flexible(can_id, flags, bytes(range(size))), R)
    for n, (can_id, flags, size) in enumerate(
        [(0x123, 0, 8), (0x123, 1, 12), (0x7FF, 3, 64), (0x1ABCDEF0 | can_frame.EFF, 1, 48)]
    )
]
ERRORS = [
    Frame(10 * S, "can0", classic(ERR | 0x204, bytes.fromhex("0020000000008000")), R),
    Frame(11 * S, "can0", classic(ERR | 0x0A8, bytes.fromhex("0000801900000000")), R),
]


def facts(message):
    flags = message.is_fd, message.bitrate_switch, message.error_state_indicator
    return (
        *(message.arbitration_id, message.is_extended_id, message.is_error_frame, flags),
        bytes(message.data),
    )


def facts_of(frame):
    told = can_frame.fields(frame.frame)
    flags = told.fd, bool(told.flags & can_frame.BRS), bool(told.flags & can_frame.ESI)
    is_error = bool(told.can_id & ERR)
    return told.identifier, bool(told.can_id & can_frame.EFF), is_error, flags, told.data


def message_of(frame):
    can_id, extended, is_error, (fd, brs, esi), data = facts_of(frame)
    return can.Message(
        timestamp=frame.time_ns / 1e9,
        arbitration_id=can_id,
        is_extended_id=extended,
        is_error_frame=is_error,
        is_fd=fd,
        bitrate_switch=brs,
        error_state_indicator=esi,
        data=data,
        channel=0,
    )


@pytest.mark.parametrize("ending", [".log", ".asc", ".blf", ".trc"])
def test_python_can_reads_our_fd_frames(tmp_path, ending):
    record_frames(tmp_path / "a.mcap", FD, {})
    convert(tmp_path / "a.mcap", tmp_path / f"b{ending}", FORMAT_OF[ending])
    with can.LogReader(tmp_path / f"b{ending}") as reader:
        found = list(reader)
    assert [facts(message) for message in found] == [facts_of(frame) for frame in FD]


@pytest.mark.parametrize("ending", [".log", ".asc", ".blf", ".csv"])
def test_fd_frames_of_python_can_are_read(tmp_path, ending):
    """Its CSV does not mark CAN FD frames; its TRC writer omits them."""
    with can.Logger(tmp_path / f"a{ending}") as writer:
        for frame in FD:
            writer(message_of(frame))
    findings = Findings()
    found = list(open_source(tmp_path / f"a{ending}").frames(findings))
    assert findings.problems == []
    if ending == ".csv":
        assert [facts_of(frame)[-1] for frame in found] == [facts_of(frame)[-1] for frame in FD]
        assert [facts_of(frame)[3][0] for frame in found] == [False, True, True, True]
    else:
        assert [facts_of(frame) for frame in found] == [facts_of(frame) for frame in FD]


WRITTEN = {  # class and data that python-can's writer keeps of an error frame
    ".log": lambda told, data: (0x80, data),
    ".asc": lambda told, data: (0x80, bytes(8)),
    ".blf": lambda told, data: (told, data),
    ".csv": lambda told, data: (told, data),
}


@pytest.mark.parametrize("ending", WRITTEN)
def test_error_frames_of_python_can_are_read(tmp_path, ending):
    with can.Logger(tmp_path / f"a{ending}") as writer:
        for frame in ERRORS:
            writer(message_of(frame))
    findings = Findings()
    found = list(open_source(tmp_path / f"a{ending}").frames(findings))
    assert findings.problems == []
    left = WRITTEN[ending]
    wanted = [can_frame.fields(frame.frame) for frame in ERRORS]
    assert [frame.frame for frame in found] == [
        classic(ERR | one[0], one[1]) for one in (left(w.identifier, w.data) for w in wanted)
    ]


@pytest.mark.parametrize("ending", [".log", ".asc", ".blf"])
def test_python_can_reads_our_error_frames(tmp_path, ending):
    record_frames(tmp_path / "a.mcap", ERRORS, {})
    convert(tmp_path / "a.mcap", tmp_path / f"b{ending}", FORMAT_OF[ending])
    with can.LogReader(tmp_path / f"b{ending}") as reader:
        found = list(reader)
    if ending == ".blf":
        assert [facts(message) for message in found] == [facts_of(frame) for frame in ERRORS]
    elif ending == ".asc":
        assert [message.is_error_frame for message in found] == [True, True]
    else:  # it reads candump's rows of classes other than "bus error" as frames of 29 bits
        assert [message.is_error_frame for message in found] == [False, True]
