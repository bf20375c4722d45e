"""Arrays contain the same frames as single reading, for recordings of any writer."""

import io
import struct

import numpy as np
import pytest
from hypothesis import event, given
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer

from motorhil.traces.can_frame import FDF, classic, flexible
from motorhil.traces.columns import read_can_arrays
from motorhil.traces.errors import TraceError
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.formats.registry import Feature, record_frames, recorded_frames
from motorhil.traces.mcap import records
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, LOG, Direction, Schema, encode_can_frame
from tests.properties.test_formats_random import recordings
from tests.support.recordings.written import MS, Recording, write

ALL = ~Feature(0)


def frames_of(arrays):
    """Return the frames in arrays in the form of single reading."""
    out = []
    for n in range(len(arrays)):
        fd = arrays.flags[n] & FDF
        head = struct.pack("<IBBxx", arrays.can_id[n], arrays.length[n], arrays.flags[n])
        data = arrays.data[n].tobytes()
        assert fd or not any(data[8:])
        out.append(
            Frame(
                int(arrays.time_ns[n]),
                arrays.buses[arrays.bus[n]],
                head + (data if fd else data[:8]),
                Direction(arrays.direction[n]),
                arrays.senders[arrays.sender[n]],
            )
        )
    return out


def one_by_one(path):
    findings = Findings()
    with read_trace(path) as trace:
        frames = list(recorded_frames(trace, findings))
    return frames, sum(problem.line > 0 for problem in findings.problems)


def check(path):
    """Check that arrays contain the same frames as single reading; return their number."""
    frames, unreadable = one_by_one(path)
    arrays = read_can_arrays(path)
    assert frames_of(arrays) == frames
    assert arrays.unreadable == unreadable
    kinds = {"time_ns": "u8", "can_id": "u4", "flags": "u1", "length": "u1", "bus": "u2"}
    for name, kind in (kinds | {"sender": "u4", "direction": "u1"}).items():
        column = getattr(arrays, name)
        assert (column.shape, column.dtype) == ((len(frames),), np.dtype(kind))
    wide = any(len(frame.frame) > 16 for frame in frames)
    assert (arrays.data.shape, arrays.data.dtype) == ((len(frames), 64 if wide else 8), np.uint8)
    return len(frames)


@given(st.lists(recordings(ALL), min_size=1, max_size=4), st.booleans())
def test_arrays_any_recording_equal_single_reading(tmp_path_factory, parts, repeated):
    path = tmp_path_factory.mktemp("arrays") / "a.mcap"
    frames = [frame for part in parts for frame in part] * (20 if repeated else 1)
    record_frames(path, frames, {})
    event("FD" if any(len(frame.frame) > 16 for frame in frames) else "classic only")
    assert check(path) == len(frames)


@pytest.mark.parametrize("compact", [False, True])
def test_arrays_with_other_messages_between(tmp_path, compact):
    write(tmp_path / "a.mcap", 3000, 5 * MS, compact)
    assert check(tmp_path / "a.mcap") == 2700
    arrays = read_can_arrays(tmp_path / "a.mcap")
    assert arrays.buses == ("can0", "can1")
    assert set(arrays.senders) == {"left", "host", "right"}


def test_arrays_many_senders_of_one_identifier(tmp_path):
    frames = [
        Frame(n, "can0", classic(0x80, bytes(n % 3)), Direction.RECEIVED, f"node{n % 40:02d}")
        for n in range(2000)
    ]
    record_frames(tmp_path / "a.mcap", frames, {})
    assert check(tmp_path / "a.mcap") == 2000


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.ZSTD},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE, "index_types": IndexType.NONE},
        {"chunk_size": 200},
        {"use_chunking": False},
    ],
    ids=str,
)
def test_arrays_of_another_writers_file(tmp_path, options):
    file = io.BytesIO()
    writer = Writer(file, **options)
    writer.start(profile="p", library="theirs")
    schema = writer.register_schema("motorhil.CanFrame", "protobuf", Schema.of(CAN_FRAME).data)
    can = writer.register_channel("/can/a", "protobuf", schema)
    plain = writer.register_channel("/plain", "json", 0)
    for n in range(300):
        frame = classic(n, b"\1\2\3") if n % 3 else flexible(n, 1, bytes(range(12)))
        payload = encode_can_frame(frame, "me", Direction.RECEIVED)
        if n % 5 == 0:  # its fields in a different order
            payload = payload[5:] + payload[:5]
        if n % 7 == 0:
            payload = (b"", b"\x0d", b"\x0d\1\0\0\0\x7a\5", b"\xff\xff")[n % 4]
        if n % 11 == 0:  # a future field
            payload += b"\x78\x01" if n % 2 else b"\xa2\x06\x01x"
        writer.add_message(plain if n % 13 == 0 else can, n, payload, n)
    writer.finish()
    (tmp_path / "a.mcap").write_bytes(file.getvalue())
    assert check(tmp_path / "a.mcap") > 200


def test_arrays_of_file_cut_anywhere(tmp_path):
    write(tmp_path / "whole.mcap", 200, 50 * MS)
    whole = (tmp_path / "whole.mcap").read_bytes()
    path = tmp_path / "cut.mcap"
    counts = set()
    for size in range(2000, len(whole), 397):
        path.write_bytes(whole[:size])
        counts.add(check(path))
        assert (read_can_arrays(path).cut is None) == (size == len(whole))
    assert len(counts) > 5


@pytest.mark.parametrize(
    ("options", "is_wanted"),
    [
        ({"bus": "can1"}, lambda f: f.bus == "can1"),
        ({"bus": ["can0", "no"]}, lambda f: f.bus == "can0"),
        ({"bus": []}, lambda f: False),
        ({"from_ns": 1234 * MS}, lambda f: f.time_ns >= 1234 * MS),
        ({"from_ns": -1, "to_ns": 1250 * MS}, lambda f: f.time_ns < 1250 * MS),
        ({"from_ns": 5000 * MS, "to_ns": 4000 * MS}, lambda f: False),
        ({"bus": "can0", "from_ns": 2**70}, lambda f: False),
    ],
)
def test_arrays_of_bus_or_span(tmp_path, options, is_wanted):
    write(tmp_path / "a.mcap", 300, 25 * MS)
    frames = [frame for frame in one_by_one(tmp_path / "a.mcap")[0] if is_wanted(frame)]
    assert frames_of(read_can_arrays(tmp_path / "a.mcap", **options)) == frames


def test_arrays_without_frames_are_empty(tmp_path):
    with TraceWriter(tmp_path / "a.mcap") as writer:
        writer.write(writer.channel("/events", Schema.of(LOG)), 1, b"")
    assert check(tmp_path / "a.mcap") == 0


def test_arrays_unknown_channel_is_reported(tmp_path):
    message = records.MESSAGE_HEAD.pack(5, 22, 9, 0, 7, 7)
    (tmp_path / "a.mcap").write_bytes(records.MAGIC + records.header("", "x") + message)
    with pytest.raises(TraceError, match="of unknown channel 9"):
        read_can_arrays(tmp_path / "a.mcap")


def test_arrays_damaged_chunk_is_reported(tmp_path):
    path = tmp_path / "a.mcap"
    recording = Recording(path)
    recording.fill(20, 50 * MS).writer.flush()
    offset = path.stat().st_size
    recording.fill(20, 50 * MS, first=20).writer.close()
    data = bytearray(path.read_bytes())
    data[offset + 60] ^= 0x10
    path.write_bytes(data)
    with pytest.raises(TraceError, match=f"damaged chunk .* at byte {offset}"):
        read_can_arrays(path)
