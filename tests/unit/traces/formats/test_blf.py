"""Foreign BLF files are read to the nanosecond, damaged ones as far as possible."""

import shutil
import struct
import subprocess

import can
import pytest

from motorhil.traces import can_frame
from motorhil.traces.can_frame import classic, flexible, remote
from motorhil.traces.formats import frames as traffic
from motorhil.traces.formats.blf import blf_frames, write_blf
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.formats.registry import open_source
from motorhil.traces.schema import Direction

R, T, U = Direction.RECEIVED, Direction.TRANSMITTED, Direction.UNKNOWN
START = 1_700_000_000
MESSAGES = [
    can.Message(START, 0x123, False, data=b"\1\2", channel=0),
    can.Message(START + 0.25, 0x1ABCDEF, True, data=bytes(8), channel=1, is_rx=False),
    can.Message(START + 0.5, 0x7, False, is_remote_frame=True, dlc=3, channel=0),
    can.Message(START + 0.75, 0x8, False, is_fd=True, bitrate_switch=True, data=bytes(12)),
    can.Message(START + 1, 0x44, False, is_error_frame=True, dlc=8, data=bytes(range(8))),
]
FRAMES = [
    (START * 10**9, "can0", classic(0x123, b"\1\2"), R),
    (START * 10**9 + 250_000_000, "can1", classic(0x1ABCDEF | can_frame.EFF, bytes(8)), T),
    (START * 10**9 + 500_000_000, "can0", remote(0x7, 3), R),
    (START * 10**9 + 750_000_000, "can0", flexible(0x8, 1, bytes(12)), R),
    (START * 10**9 + 1_000_000_000, "can0", classic(can_frame.ERR | 0x44, bytes(range(8))), U),
]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "some.blf"


def write(path, messages, compression=-1):
    with can.BLFWriter(path, compression_level=compression) as writer:
        for message in messages:
            writer(message)


def read(path):
    findings = Findings()
    return [tuple(frame)[:4] for frame in blf_frames(str(path), findings)], findings


@pytest.mark.parametrize("compression", [0, 6])
def test_file_of_python_can_is_read(path, compression):
    write(path, MESSAGES, compression)
    frames, findings = read(path)
    assert findings.problems == []
    assert frames == FRAMES
    assert open_source(path).format == "blf"


def test_object_spanning_containers_is_complete(path):
    write(path, MESSAGES[:1] * 5000, 1)
    frames, findings = read(path)
    assert findings.problems == []
    assert frames == FRAMES[:1] * 5000


def test_stamps_keep_nanoseconds(path):
    write(path, MESSAGES[:1], 0)
    data = bytearray(path.read_bytes())
    at = data.rindex(b"LOBJ")
    struct.pack_into("<Q", data, at + 24, 123_456_789)
    path.write_bytes(data)
    assert read(path)[0][0][0] == START * 10**9 + 123_456_789
    struct.pack_into("<I", data, at + 16, 1)  # units of 10 us
    path.write_bytes(data)
    assert read(path)[0][0][0] == START * 10**9 + 123_456_789 * 10_000


def test_file_cut_anywhere_is_read_up_to_cut(path):
    write(path, MESSAGES, 0)
    whole = path.read_bytes()
    between = (144, len(whole))  # where complete objects end, a cut cannot be detected
    for end in range(4, len(whole)):
        path.write_bytes(whole[:end])
        frames, findings = read(path)
        assert frames == FRAMES[: len(frames)]
        assert findings.problems or len(frames) == len(FRAMES) or end in between
    assert len(frames) >= 4


def test_damaged_container_loses_only_its_frames(path):
    many = [
        can.Message(START, 0x123, False, data=struct.pack("<Q", n * 0x9E3779B97F4A7C15 % 2**64))
        for n in range(5000)
    ]
    write(path, many)
    data = bytearray(path.read_bytes())
    size = struct.unpack_from("<I", data, 144 + 8)[0]  # of the first container
    damaged = 144 + size * 3 // 4
    data[damaged : damaged + 20] = bytes(20)
    path.write_bytes(data)
    frames, findings = read(path)
    in_first = 128 * 1024 // 48  # python-can's container, an object itself
    assert len({frame[2] for frame in frames}) > 4900 - in_first + in_first // 2
    assert findings.notes == ["frames of a damaged container may be wrong"]
    assert any("damaged" in problem.text for problem in findings.problems)


def test_written_file_has_nanoseconds_and_counts(path):
    frames = [
        Frame(START * 10**9 + 1_999_999 + n, "can3", classic(n % 2048, bytes(n % 9)), T)
        for n in range(20_000)
    ]
    with path.open("wb") as file:
        write_blf(file, ["can3"], frames[0].time_ns, iter(frames))
    found, findings = read(path)
    assert found == [frame[:4] for frame in frames]
    assert findings.problems == []
    with can.BLFReader(path) as reader:
        assert reader.object_count == 20_000
        assert reader.file_size == path.stat().st_size
        assert reader.start_timestamp == START + 0.001
        assert [message.arbitration_id for message in reader] == [n % 2048 for n in range(20_000)]


@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
def test_tshark_reads_written_file(path):
    sent = flexible(0x77, 3, bytes(range(12)))
    frames = [
        *(Frame(*frame) for frame in FRAMES[:3]),
        Frame(START * 10**9 + 999_999_999, "can2", sent, T),
        Frame(START * 10**9 + 1_000_000_001, "can0", classic(can_frame.ERR | 0x20, bytes(8)), R),
    ]
    with path.open("wb") as file:
        write_blf(file, ["can0", "can1", "can2"], frames[0].time_ns, iter(frames))
    names = "frame.time_epoch frame.interface_name can.id can.flags.rtr can.len data"
    names += " frame.packet_flags_direction can.err.ack"
    fields = [word for name in names.split() for word in ("-e", name)]
    command = ["tshark", "-r", str(path), "-T", "fields", "-E", "separator=;", *fields]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    rows = [line.split(";") for line in done.stdout.splitlines()]
    stamps = [traffic.decimal(frame.time_ns) for frame in frames]
    assert [row[0] for row in rows] in (stamps, stamps[:4])  # version 4.0 skips error frames
    assert [row[1] for row in rows[:4]] == ["CAN-1", "CAN-2", "CAN-1", "CAN-3"]
    assert [int(row[2], 0) for row in rows[:4]] == [0x123, 0x1ABCDEF, 0x7, 0x77]
    assert [row[3] for row in rows[:3]] == ["0", "0", "1"]
    assert [row[4] for row in rows[:4]] == ["2", "8", "3", "12"]
    assert [row[5] for row in rows[:4]] == ["0102", "00" * 8, "", bytes(range(12)).hex()]
    assert [int(row[6], 0) for row in rows[:4]] == [1, 2, 1, 2]
    assert [row[7] for row in rows[4:]] in ([], ["1"])
