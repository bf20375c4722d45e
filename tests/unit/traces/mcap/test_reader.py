import io
import struct

import pytest
from mcap.writer import CompressionType, IndexType, Writer

from motorhil.traces.errors import TraceError
from motorhil.traces.mcap import records
from motorhil.traces.mcap.reader import Summary, Trace, read_summary, read_trace
from motorhil.traces.schema import CAN_FRAME, Direction, Schema, encode_can_frame
from tests.support.recordings.written import MS, SECOND, Recording, counted_frame, write


def payloads(trace, **options):
    return [(c.topic, time_ns, payload) for c, time_ns, payload in trace.messages(**options)]


def expected(recording):
    """Return the expected messages, made without the writer's bulk packing."""
    out = []
    for source, time_ns, data in recording.entries:
        if source < 0:
            out.append(("/events", time_ns, data))
        else:
            sender = ("left", "host", "right")[source]
            direction = (Direction.RECEIVED, Direction.TRANSMITTED, Direction.RECEIVED)[source]
            topic = ("/can/can0", "/can/can0", "/can/can1")[source]
            out.append((topic, time_ns, encode_can_frame(data, sender, direction)))
    return out


def test_recording_is_read_as_written(tmp_path):
    path = tmp_path / "a.mcap"
    recording = Recording(path, {"run": {"seed": "7"}})
    recording.writer.attach("rig.toml", b"x = 1\n", "application/toml", 3)
    recording.fill(1000, 5 * MS).writer.close()
    with read_trace(path) as trace:
        assert payloads(trace) == expected(recording)
        assert trace.cut is None
        assert trace.metadata == {"run": {"seed": "7"}}
        assert [(a.name, a.data, a.log_time_ns) for a in trace.attachments] == [
            ("rig.toml", b"x = 1\n", 3)
        ]
        assert [c.topic for c in trace.channels.values()] == ["/can/can0", "/can/can1", "/events"]
        assert trace.channels[1].schema == Schema.of(CAN_FRAME)
        assert trace.library == "motorhil"


def test_messages_are_selected_by_topic_and_time(tmp_path):
    recording = write(tmp_path / "a.mcap")
    with read_trace(tmp_path / "a.mcap") as trace:
        everything = payloads(trace)
        assert payloads(trace, topics=["/events"]) == [m for m in everything if m[0] == "/events"]
        low, high = 1 * SECOND + 50 * MS, 3 * SECOND
        within = [m for m in everything if low <= m[1] < high]
        assert payloads(trace, from_ns=low, to_ns=high) == within
        assert len(within) == 39
        assert payloads(trace, from_ns=99 * 50 * MS) == everything[-1:]
        assert payloads(trace, from_ns=99 * 50 * MS + 1) == []
        assert payloads(trace, to_ns=0) == []
    assert len(everything) == len(recording.entries)


def test_cut_file_has_all_messages_of_whole_chunks(tmp_path):
    whole = tmp_path / "whole.mcap"
    recording = Recording(whole, {"run": {"seed": "1"}})
    recording.writer.attach("rig.toml", b"x")
    ends = []  # (size of the file, messages in it) after each chunk
    for second in range(3):
        recording.fill(10, 100 * MS, first=10 * second)
        start = whole.stat().st_size
        recording.writer.flush()
        length = int.from_bytes(whole.read_bytes()[start + 1 : start + 9], "little")
        ends.append((start + 9 + length, 10 * (second + 1)))
    recording.writer.close()
    data, messages = whole.read_bytes(), expected(recording)
    data_end = next(offset for offset, kind in walk(data) if kind == 0x0F)
    for size in range(len(data)):
        if size < 8:
            with pytest.raises(TraceError, match="is empty" if not size else "is not an MCAP file"):
                Trace("cut", io.BytesIO(data[:size]))
            continue
        with Trace("cut", io.BytesIO(data[:size])) as trace:
            found = payloads(trace)
            sure = max((count for end, count in ends if end <= size), default=0)
            assert found == messages[: len(found)], size
            assert len(found) - trace.salvaged == sure, size
            assert trace.cut is not None, size
            assert trace.cut.offset <= size
            assert trace.cut.offset + trace.cut.size == size
            assert trace.cut.messages_missing == (trace.cut.offset <= data_end), size


def test_cut_chunk_is_salvaged(tmp_path):
    path = tmp_path / "a.mcap"
    recording = Recording(path)
    start = path.stat().st_size
    recording.fill(15_000, 50_000).writer.close()  # 0.75 s: one chunk of about 1 MB
    data = path.read_bytes()
    length = int.from_bytes(data[start + 1 : start + 9], "little")
    path.write_bytes(data[: start + length * 6 // 10])
    with read_trace(path) as trace:
        found = payloads(trace)
        assert found == expected(recording)[: len(found)]
        assert 5_000 < len(found) < 12_000
        assert trace.salvaged == len(found)
        assert trace.cut.offset == start
        assert trace.cut.messages_missing
        assert "in a chunk of" in str(trace.cut)
        assert f"cut at byte {start}" in str(trace.cut)


def test_end_overwritten_with_zeros_is_a_cut(tmp_path):
    # A file system can leave this behind after a power failure.
    path = tmp_path / "a.mcap"
    recording = Recording(path).fill(40, 50 * MS)
    recording.writer.flush()
    size = path.stat().st_size
    data = path.read_bytes()
    recording.writer.close()
    path.write_bytes(data + bytes(10_000))
    with read_trace(path) as trace:
        assert payloads(trace) == expected(recording)
        assert trace.cut.offset == size
        assert "no record begins there" in str(trace.cut)


def test_damaged_chunk_is_reported_after_good_messages(tmp_path):
    path = tmp_path / "a.mcap"
    recording = Recording(path)
    recording.fill(20, 50 * MS).writer.flush()
    offset = path.stat().st_size
    recording.fill(20, 50 * MS, first=20).writer.close()
    data = bytearray(path.read_bytes())
    for place in (offset + 60, offset + 9 + 24):  # inside the compressed data; its CRC
        hurt = data.copy()
        hurt[place] ^= 0x10
        path.write_bytes(hurt)
        with read_trace(path) as trace:
            messages = trace.messages()
            found = [next(messages) for _ in range(20)]
            assert [(c.topic, t, p) for c, t, p in found] == expected(recording)[:20]
            with pytest.raises(TraceError, match=f"damaged chunk .* at byte {offset}") as caught:
                next(messages)
        assert caught.value.offset == offset
        assert caught.value.path == str(path)


def test_record_exceeding_chunk_is_reported(tmp_path):
    path = tmp_path / "a.mcap"
    recording = Recording(path)
    offset = path.stat().st_size
    recording.writer.close()
    data = path.read_bytes()
    message = records.MESSAGE_HEAD.pack(5, 22 + 3, 1, 0, 7, 7) + b"abc"
    broken = records.chunk(7, 7, 34 + 33, 0, "", message + message[:-1])
    path.write_bytes(data[:offset] + broken + data[offset:])
    with read_trace(path) as trace:
        messages = trace.messages()
        assert next(messages)[1:] == (7, b"abc")
        with pytest.raises(TraceError, match=f"a record goes beyond its chunk at byte {offset}"):
            next(messages)


def test_message_of_unknown_channel_is_reported(tmp_path):
    path = tmp_path / "a.mcap"
    message = records.MESSAGE_HEAD.pack(5, 22, 9, 0, 7, 7)
    path.write_bytes(records.MAGIC + records.header("", "x") + message)
    with read_trace(path) as trace, pytest.raises(TraceError, match="of unknown channel 9"):
        list(trace.messages())


@pytest.mark.parametrize("place", ["schema", "channel", "attachment"])
def test_damaged_record_is_reported_with_offset(tmp_path, place):
    path = tmp_path / "a.mcap"
    recording = Recording(path)
    recording.writer.attach("rig", b"0123456789")
    recording.fill(5, MS).writer.close()
    data = bytearray(path.read_bytes())
    opcode, inside = {"schema": (3, 14), "channel": (4, 16), "attachment": (9, -6)}[place]
    offset = next(o for o, kind in walk(data) if kind == opcode)
    end = offset + 9 + int.from_bytes(data[offset + 1 : offset + 9], "little")
    data[(end if inside < 0 else offset) + inside] ^= 0x7F  # a length, or a byte under a CRC
    path.write_bytes(data)
    with pytest.raises(TraceError, match=f"damaged {place} record .* at byte {offset}"):
        read_trace(path)


def walk(data):
    offset = 8
    while offset < len(data) - 8:
        yield offset, data[offset]
        offset += 9 + int.from_bytes(data[offset + 1 : offset + 9], "little")


def test_damage_anywhere_is_trace_error_or_harmless():
    file = io.BytesIO()
    recording = Recording(file, {"run": {"seed": "1"}})
    recording.writer.attach("rig.toml", b"x")
    recording.fill(30, 100 * MS).writer.close()
    data = file.getvalue()
    refused = 0
    for place in range(8, len(data)):
        for damage in (0xFF, data[place] ^ 1, data[place] ^ 0x80):
            hurt = data[:place] + bytes((damage,)) + data[place + 1 :]
            try:
                with Trace("hurt", io.BytesIO(hurt)) as trace:
                    for _ in trace.messages():
                        pass
            except TraceError:
                refused += 1
    assert refused > len(data) // 4


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "is empty"),
        (b"\x89MCAP1\r\n" + bytes(50), "not an MCAP file"),
        (b"(0.0) can0", "not an MCAP"),
    ],
)
def test_file_other_than_recording_is_refused(tmp_path, content, complaint):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(TraceError, match=complaint) as caught:
        read_trace(path)
    assert str(caught.value).startswith(str(path))


def test_missing_file_is_reported_in_os_words(tmp_path):
    with pytest.raises(TraceError, match="cannot be read: no such file or directory"):
        read_trace(tmp_path / "x.mcap")
    with pytest.raises(TraceError, match="cannot be read: is a directory"):
        read_trace(tmp_path)


OTHER_WRITERS = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "uncompressed": {"compression": CompressionType.NONE},
    "without-index": {"index_types": IndexType.NONE},
    "small-chunks": {"chunk_size": 200},
    "without-chunks": {"use_chunking": False},
    "without-summary": {
        "use_chunking": False,
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
}


def written_by_mcap(options, count=300):
    file = io.BytesIO()
    writer = Writer(file, **options)
    writer.start(profile="p", library="theirs")
    schema = writer.register_schema("motorhil.CanFrame", "protobuf", Schema.of(CAN_FRAME).data)
    channels = [writer.register_channel(f"/can/{i}", "protobuf", schema) for i in range(2)]
    channels.append(writer.register_channel("/plain", "json", 0))
    writer.add_attachment(1, 2, "a", "text/plain", b"data")
    writer.add_metadata("m", {"k": "v"})
    wanted = []
    for number in range(count):
        payload = b"" if number % 5 == 4 else encode_can_frame(counted_frame(number))
        channel = channels[number % 3]
        writer.add_message(channel, number * 7, payload, number * 6, number)
        wanted.append((("/can/0", "/can/1", "/plain")[number % 3], number * 7, payload))
    writer.finish()
    return file.getvalue(), wanted


@pytest.mark.parametrize("options", OTHER_WRITERS.values(), ids=OTHER_WRITERS)
def test_file_of_another_writer_is_read(tmp_path, options):
    path = tmp_path / "a.mcap"
    data, wanted = written_by_mcap(options)
    path.write_bytes(data)
    with read_trace(path) as trace:
        assert payloads(trace) == wanted
        assert (trace.library, trace.cut) == ("theirs", None)
        assert trace.metadata == {"m": {"k": "v"}}
        assert [(a.name, a.data) for a in trace.attachments] == [("a", b"data")]
        plain = next(c for c in trace.channels.values() if c.topic == "/plain")
        assert (plain.schema, plain.encoding) == (None, "json")
        assert payloads(trace, from_ns=700, to_ns=1400) == [m for m in wanted if 700 <= m[1] < 1400]


@pytest.mark.parametrize("options", OTHER_WRITERS.values(), ids=OTHER_WRITERS)
def test_cut_file_of_another_writer_is_read(tmp_path, options):
    path = tmp_path / "a.mcap"
    data, wanted = written_by_mcap(options)
    for size in range(8, len(data), 97):
        path.write_bytes(data[:size])
        with read_trace(path) as trace:
            found = payloads(trace)
            assert found == wanted[: len(found)]
            assert trace.cut is not None


@pytest.mark.parametrize("options", OTHER_WRITERS.values(), ids=OTHER_WRITERS)
def test_summary_equals_scan_of_file(tmp_path, monkeypatch, options):
    path = tmp_path / "a.mcap"
    path.write_bytes(written_by_mcap(options)[0])
    told = traced(path)
    monkeypatch.setattr("motorhil.traces.mcap.reader.read_summary", lambda file: Summary({}, []))
    assert traced(path) == told


def test_our_summary_has_all_chunks(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    write(path, 100)
    with path.open("rb") as file, read_trace(path) as trace:
        places = read_summary(file).places
        assert [place.chunk for place in places.values()] == trace._chunks
        assert len(places) == 5
    told = traced(path)
    data = bytearray(path.read_bytes())
    data[-50] ^= 1  # the summary's CRC is wrong: it is ignored
    path.write_bytes(data)
    with path.open("rb") as file:
        assert read_summary(file) == ({}, [])
    assert traced(path) == told


def traced(path):
    with read_trace(path) as trace:
        found = payloads(trace)
        span = trace.span_ns()
        return found, span, trace.metadata, trace.attachments, trace.channels, trace.cut


def test_channels_inside_skipped_chunks_are_known(tmp_path):
    path = tmp_path / "a.mcap"
    data, wanted = written_by_mcap(OTHER_WRITERS["small-chunks"])
    path.write_bytes(data)
    with read_trace(path) as trace:
        assert payloads(trace, from_ns=1400) == [m for m in wanted if m[1] >= 1400]


def test_unknown_records_are_skipped(tmp_path):
    path = tmp_path / "a.mcap"
    recording = write(path)
    data = path.read_bytes()
    first = next(o for o, kind in walk(data) if kind == 6)
    new = b"\x90" + struct.pack("<Q", 5) + b"12345"
    path.write_bytes(data[:first] + new + data[first:])
    with read_trace(path) as trace:
        assert payloads(trace) == expected(recording)
