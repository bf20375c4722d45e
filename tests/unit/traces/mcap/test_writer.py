"""Our files, verified by mcap's own reader with all CRC checks."""

import io
import struct
import tracemalloc
import zlib
from collections import Counter

import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Attachment, Chunk, DataEnd, Footer, Message, MessageIndex
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from motorhil.traces.digest import digest
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.writer import CHUNK_BYTES, TraceWriter
from motorhil.traces.schema import CAN_FRAME, LOG, Direction, Schema, decode_can_frame
from tests.support.recordings.written import MS, SECOND, Recording, can_frame, counted_frame, write


def records(data, **options):
    return list(StreamReader(io.BytesIO(data), validate_crcs=True, **options).records)


def chunks(data):
    return [one for one in records(data, emit_chunks=True) if isinstance(one, Chunk)]


def times(data):
    return [one.log_time for one in records(data) if isinstance(one, Message)]


def test_mcap_reader_finds_every_frame_unchanged(tmp_path):
    path = tmp_path / "a.mcap"
    written = write(path)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        messages = list(reader.iter_decoded_messages(log_time_order=False))
    assert len(messages) == len(written.entries)
    topics = ["/can/can0", "/can/can0", "/can/can1"]
    for message, (source, time_ns, data) in zip(messages, written.entries, strict=True):
        assert message.message.log_time == message.message.publish_time == time_ns
        if source < 0:
            assert message.channel.topic == "/events"
            assert message.message.data == data
            continue
        assert message.channel.topic == topics[source]
        decoded = message.decoded_message
        assert (decoded.id, decoded.data) == (data[0] + 256 * data[1], data[8:])
        assert decoded.sender == ["left", "host", "right"][source]
        assert decoded.direction == [1, 2, 1][source]


def test_summary_describes_file(tmp_path):
    path = tmp_path / "a.mcap"
    written = Recording(path, {"run": {"seed": "1"}, "versions": {"python": "3"}})
    written.writer.attach("rig.toml", b"[rig]\n", "application/toml", 5)
    written.fill(100, 50 * MS)
    written.writer.close()
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        metadata = {one.name: one.metadata for one in reader.iter_metadata()}
        attachments = list(reader.iter_attachments())
    count = Counter(source for source, _, _ in written.entries)
    statistics = summary.statistics
    assert statistics.message_count == 100
    assert statistics.channel_message_counts == {1: count[0] + count[1], 2: count[2], 3: 10}
    assert (statistics.message_start_time, statistics.message_end_time) == (0, 99 * 50 * MS)
    assert (statistics.schema_count, statistics.channel_count, statistics.chunk_count) == (2, 3, 5)
    assert (statistics.metadata_count, statistics.attachment_count) == (2, 1)
    assert [one.message_start_time for one in summary.chunk_indexes] == [
        k * SECOND for k in range(5)
    ]
    assert [one.message_end_time for one in summary.chunk_indexes] == [
        k * SECOND + 950 * MS for k in range(5)
    ]
    assert metadata == {"run": {"seed": "1"}, "versions": {"python": "3"}}
    assert [(a.name, a.data, a.media_type, a.log_time) for a in attachments] == [
        ("rig.toml", b"[rig]\n", "application/toml", 5)
    ]


@pytest.mark.parametrize("seconds", [20, 600])
def test_every_index_points_at_its_record(tmp_path, seconds):
    path = tmp_path / "a.mcap"
    recording = write(path, 2 * seconds, 500 * MS)
    data = path.read_bytes()
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) == seconds
    ends = 0
    for index in summary.chunk_indexes:
        assert data[index.chunk_start_offset] == 0x06
        length = int.from_bytes(data[index.chunk_start_offset + 1 :][:8], "little")
        assert index.chunk_length == 9 + length
        assert ends <= index.chunk_start_offset
        ends = index.chunk_start_offset + index.chunk_length
    assert [c.uncompressed_size for c in chunks(data)] == [
        index.uncompressed_size for index in summary.chunk_indexes
    ]
    assert recording.writer.error is None


def test_an_hour_of_recording_takes_little_memory(tmp_path):
    recording = Recording(tmp_path / "a.mcap").fill(512, SECOND)
    tracemalloc.start()
    try:
        for second in range(512, 512 + 3600):
            recording.writer.can_frame(second % 3, second * SECOND, counted_frame(second))
        assert tracemalloc.get_traced_memory()[0] < 3600 * 64
    finally:
        tracemalloc.stop()
    recording.writer.close()


def test_all_crcs_are_present_and_correct(tmp_path):
    path = tmp_path / "a.mcap"
    recording = Recording(path)
    recording.writer.attach("a", b"data")
    recording.fill(30, 50 * MS).writer.close()
    data = path.read_bytes()
    found = records(data)  # checks chunks and data section
    assert next(r for r in found if isinstance(r, DataEnd)).data_section_crc != 0
    assert all(chunk.uncompressed_crc != 0 for chunk in chunks(data))
    footer = next(r for r in found if isinstance(r, Footer))
    # Source: mcap.dev/spec, Footer: up to and including summary_offset_start; then CRC and magic.
    assert footer.summary_crc == zlib.crc32(data[footer.summary_start : -8 - 4])
    at = data.index(b"\x09" + (8 + 8 + 4 + 1 + 4 + 24 + 8 + 4 + 4).to_bytes(8, "little"))
    end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    assert int.from_bytes(data[end - 4 : end], "little") == zlib.crc32(data[at + 9 : end - 4])
    assert any(isinstance(r, Attachment) for r in found)


def test_message_index_finds_every_message(tmp_path):
    path = tmp_path / "a.mcap"
    written = write(path, 1000, 5 * MS)
    data = path.read_bytes()
    found = records(data, emit_chunks=True)
    places = 0
    for number, chunk in enumerate(found):
        if not isinstance(chunk, Chunk):
            continue
        content = zstandard.decompress(chunk.data)
        heads = found[number + 1 : number + 4]  # one for each channel, directly after the chunk
        assert [type(head) for head in heads] == [MessageIndex] * 3
        assert sorted(head.channel_id for head in heads) == [1, 2, 3]
        for head in heads:
            for time_ns, offset in head.records:
                opcode, _, channel, _, log_time = struct.unpack_from("<BQHIQ", content, offset)
                assert (opcode, channel, log_time) == (5, head.channel_id, time_ns)
                places += 1
    assert places == len(written.entries)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    for index in summary.chunk_indexes:
        offsets = sorted(index.message_index_offsets.values())
        assert offsets[0] == index.chunk_start_offset + index.chunk_length
        lengths = [9 + int.from_bytes(data[o + 1 : o + 9], "little") for o in offsets]
        assert index.message_index_length == sum(lengths)
        for channel, offset in index.message_index_offsets.items():
            assert (data[offset], data[offset + 9]) == (7, channel)


def test_compact_recording_has_no_message_index(tmp_path):
    paths = tmp_path / "a.mcap", tmp_path / "b.mcap"
    for path in paths:
        write(path, 5000, MS, compact=path is paths[1])
    assert digest(paths[0]) == digest(paths[1])
    assert not any(isinstance(one, MessageIndex) for one in records(paths[1].read_bytes()))
    assert paths[1].stat().st_size + 5000 * 16 < paths[0].stat().st_size
    with paths[1].open("rb") as file:
        assert len(list(make_reader(file, validate_crcs=True).iter_messages())) == 5000


def test_chunk_ends_with_its_second():
    file = io.BytesIO()
    recording = Recording(file)
    for time_ns in (SECOND - 1, SECOND, 2 * SECOND - 1, 2 * SECOND, 7 * SECOND + 5):
        recording.writer.can_frame(recording.sources[0], time_ns, can_frame(1))
    recording.writer.close()
    spans = [(c.message_start_time, c.message_end_time) for c in chunks(file.getvalue())]
    assert spans == [
        (SECOND - 1, SECOND - 1),
        (SECOND, 2 * SECOND - 1),
        (2 * SECOND, 2 * SECOND),
        (7 * SECOND + 5, 7 * SECOND + 5),
    ]


@pytest.mark.parametrize("batch", [1, 7, 4095, 4096, 4097, 30_000])
def test_chunks_end_at_same_seconds_for_any_batch(batch):
    file = io.BytesIO()
    recording = Recording(file)
    entries = [(0, number * 100_000, counted_frame(number)) for number in range(0, 30_000)]
    for start in range(0, len(entries), batch):
        recording.writer.extend(entries[start : start + batch])
    recording.writer.close()
    spans = [(c.message_start_time, c.message_end_time) for c in chunks(file.getvalue())]
    assert spans == [(k * SECOND, (k + 1) * SECOND - 100_000) for k in range(3)]
    assert times(file.getvalue()) == [time for _, time, _ in entries]


def test_chunk_ends_at_one_mebibyte():
    file = io.BytesIO()
    recording = Recording(file).fill(40_000, 1_000)
    recording.writer.close()
    sizes = [chunk.uncompressed_size for chunk in chunks(file.getvalue())]
    assert len(sizes) == 2
    assert all(CHUNK_BYTES <= size < 2 * CHUNK_BYTES for size in sizes[:-1])
    assert len(times(file.getvalue())) == 40_000


def test_message_larger_than_chunk_is_written():
    file = io.BytesIO()
    recording = Recording(file)
    large = b"\x1a" + bytes(5 * CHUNK_BYTES)
    recording.writer.write(recording.events, 1, large)
    recording.writer.extend([(0, 2, can_frame(1)), (-recording.events, 3, large)])
    recording.writer.close()
    data = [one.data for one in records(file.getvalue()) if isinstance(one, Message)]
    assert [len(one) for one in data] == [len(large), len(data[1]), len(large)]


def test_backward_times_are_kept():
    file = io.BytesIO()
    recording = Recording(file)
    wanted = [5 * SECOND, 4 * SECOND, 4 * SECOND + 7, 9 * SECOND, 2 * SECOND]
    for time_ns in wanted:
        recording.writer.can_frame(0, time_ns, can_frame(1))
    recording.writer.flush()
    recording.writer.can_frame(0, 3 * SECOND, can_frame(1))
    recording.writer.close()
    wanted.append(3 * SECOND)
    assert times(file.getvalue()) == wanted
    spans = [(c.message_start_time, c.message_end_time) for c in chunks(file.getvalue())]
    assert spans == [(4 * SECOND, 5 * SECOND), (2 * SECOND, 9 * SECOND), (3 * SECOND, 3 * SECOND)]
    file.seek(0)
    reader = make_reader(file)
    assert [m.log_time for _, _, m in reader.iter_messages()] == sorted(wanted)
    statistics = reader.get_summary().statistics
    assert (statistics.message_start_time, statistics.message_end_time) == (2 * SECOND, 9 * SECOND)


def test_senders_with_long_names_fit():
    file = io.BytesIO()
    writer = TraceWriter(file)
    channel = writer.channel("/can/a", Schema.of(CAN_FRAME))
    source = writer.source(channel, "x" * 600, Direction.UNKNOWN)
    writer.extend([(source, 1, can_frame(1 + number % 5)) for number in range(4096)])
    writer.close()
    assert len(times(file.getvalue())) == 4096


def test_finished_second_is_written_without_more_frames(tmp_path):
    path = tmp_path / "a.mcap"
    recording = Recording(path)
    before = path.stat().st_size
    recording.writer.can_frame(0, 10, can_frame(1))
    recording.writer.advance(SECOND - 1)
    assert path.stat().st_size == before
    recording.writer.advance(SECOND)
    assert path.stat().st_size > before
    recording.writer.close()


def test_classic_and_fd_frames_share_a_channel():
    # The same first 8 bytes: only the size distinguishes a canfd_frame from a can_frame.
    header = b"\x23\x01\x00\x00\x08\x04\x00\x00"
    classical, fd = header + b"12345678", header + b"abcdefgh".ljust(64, b"\0")
    file = io.BytesIO()
    recording = Recording(file)
    recording.writer.extend([(0, 1, fd), (0, 2, classical), (0, 3, fd), (0, 4, classical)])
    recording.writer.close()
    data = [one.data for one in records(file.getvalue()) if isinstance(one, Message)]
    assert [decode_can_frame(one).frame for one in data[::2]] == [fd, fd]
    assert [decode_can_frame(one).frame[8:] for one in data[1::2]] == [b"12345678"] * 2
    assert [len(decode_can_frame(one).frame) for one in data] == [72, 16, 72, 16]


def test_more_identifiers_than_cached_are_recorded():
    file = io.BytesIO()
    writer = TraceWriter(file)
    source = writer.source(writer.channel("/can/a", Schema.of(CAN_FRAME)), "x", Direction.UNKNOWN)
    ids = range(70_000)
    writer.extend([(source, 1, can_frame(0x80000000 | one)) for one in ids])
    assert len(writer._chunk._known) < 66_000
    writer.close()
    data = [one.data for one in records(file.getvalue()) if isinstance(one, Message)]
    assert [int.from_bytes(one[1:5], "little") for one in data] == list(ids)


def test_bad_frame_refuses_only_its_batch():
    file = io.BytesIO()
    recording = Recording(file)
    recording.writer.can_frame(0, 1, can_frame(1))
    with pytest.raises(ValueError, match="16 or 72 bytes"):
        recording.writer.extend([(0, 2, can_frame(1)), (0, 3, b"short")])
    with pytest.raises(struct.error):
        recording.writer.extend([(1, 2, can_frame(1)), (0, -1, can_frame(1))])
    recording.writer.can_frame(0, 4, can_frame(1))
    recording.writer.close()
    assert times(file.getvalue()) == [1, 4]
    indexes = [one for one in records(file.getvalue()) if isinstance(one, MessageIndex)]
    assert [[time for time, _ in one.records] for one in indexes] == [[1, 4]]
    file.seek(0)
    assert make_reader(file).get_summary().statistics.message_count == 2


def test_one_schema_serves_many_channels():
    file = io.BytesIO()
    writer = TraceWriter(file)
    numbers = [
        writer.channel(f"/can/{i}", Schema.of(CAN_FRAME), {"bitrate": "1"}) for i in range(5)
    ]
    writer.channel("/events", Schema.of(LOG))
    writer.close()
    file.seek(0)
    summary = make_reader(file).get_summary()
    assert numbers == [1, 2, 3, 4, 5]
    assert len(summary.schemas) == 2
    assert {c.schema_id for c in summary.channels.values()} == {1, 2}
    assert summary.channels[3].metadata == {"bitrate": "1"}


def test_recording_without_messages_is_a_valid_file(tmp_path):
    path = tmp_path / "empty.mcap"
    TraceWriter(path).close()
    with path.open("rb") as file:
        assert list(make_reader(file, validate_crcs=True).iter_messages()) == []
    assert len(records(path.read_bytes())) == 5  # header, data end, statistics, its offset, footer


def test_writing_after_close_is_refused_close_is_idempotent():
    writer = TraceWriter(io.BytesIO())
    channel = writer.channel("/events", Schema.of(LOG))
    writer.close()
    writer.close()
    with pytest.raises(TraceError, match="is closed"):
        writer.write(channel, 1, b"")


def test_unknown_channel_is_refused():
    writer = TraceWriter(io.BytesIO())
    for number in (0, 1, -1):
        with pytest.raises(ValueError, match="has no channel"):
            writer.write(number, 1, b"")
        with pytest.raises(ValueError, match="has no channel"):
            writer.source(number, "x")
