import io
from collections import Counter

import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType, IndexType, Writer

from motorhil.traces.digest import digest
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap import records
from motorhil.traces.mcap.reader import Trace
from motorhil.traces.mcap.recovery import recover, recover_bytes
from tests.support.recordings.written import MS, Recording, write

RIG = b"[rig]\nname = 'small'\n" * 3


def small(compact=False, chunks=4):
    """Return a recording's bytes, its messages by chunk, and the chunks' (begin, end)."""
    file = io.BytesIO()
    recording = Recording(file, {"run": {"seed": "1"}}, compact)
    recording.writer.attach("rig.toml", RIG)
    spans = []
    for second in range(chunks):
        start = len(file.getvalue())
        recording.fill(6, 150 * MS, first=7 * second)
        recording.writer.flush()
        length = int.from_bytes(file.getvalue()[start + 1 : start + 9], "little")
        spans.append((start, start + 9 + length))
    recording.writer.close()
    data = file.getvalue()
    by_chunk = [[] for _ in spans]
    for number, message in enumerate(read(data)):
        by_chunk[number // 6].append(message)
    return data, by_chunk, spans


def read(data):
    with Trace("it", io.BytesIO(data)) as trace:
        return [(c.topic, t, p) for c, t, p in trace.messages()]


def recovered(data):
    out = io.BytesIO()
    done = recover_bytes(data, out)
    return done, out.getvalue()


def by_mcap(data):
    """Return the contents found by mcap's own reader, with check sums, by summary and scan."""
    seeking = make_reader(io.BytesIO(data), validate_crcs=True)
    messages = seeking.iter_messages(log_time_order=False)
    listed = [(c.topic, m.log_time, m.data) for _, c, m in messages]
    reader = NonSeekingReader(io.BytesIO(data), validate_crcs=True)
    messages = reader.iter_messages(log_time_order=False)
    streamed = [(c.topic, m.log_time, m.data) for _, c, m in messages]
    assert listed == streamed
    summary = seeking.get_summary()
    assert summary.statistics.message_count == len(listed)
    names = [a.name for a in seeking.iter_attachments()]
    return listed, names, [m.name for m in seeking.iter_metadata()]


def flat(by_chunk):
    return [message for messages in by_chunk for message in messages]


@pytest.mark.parametrize("compact", [False, True])
def test_recover_complete_recording_is_unchanged(tmp_path, compact):
    source, target = str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap")
    write(source, compact=compact)
    done = recover(source, target)
    assert done.losses == []
    assert done.messages == done.expected == 100
    assert digest(source) == digest(target)
    with open(source, "rb") as one, open(target, "rb") as other:
        assert one.read() == other.read()


def test_recover_foreign_file_keeps_digest_and_times(tmp_path):
    source, target = tmp_path / "a.mcap", tmp_path / "b.mcap"
    for chunking in (True, False):
        with source.open("wb") as file:
            writer = Writer(file, 400, CompressionType.ZSTD, IndexType.ALL, use_chunking=chunking)
            writer.start("ros1", "somebody")
            schema = writer.register_schema("s", "ros1msg", b"string data")
            channels = [writer.register_channel("/a", "ros1", schema, {"k": "v"})]
            channels.append(writer.register_channel("/b", "json", 0))
            for number in range(100):
                writer.add_message(
                    channels[number % 2], number, b"%d" % number, number + 7, sequence=number
                )
            writer.finish()
        done = recover(str(source), str(target), overwrite=True)
        assert done.losses == []
        assert digest(source) == digest(target)
        with source.open("rb") as one, target.open("rb") as other:
            told, same = make_reader(one), make_reader(other, validate_crcs=True)
            assert list(told.iter_messages()) == list(same.iter_messages())
            assert same.get_header().library == told.get_header().library


def test_recover_file_cut_anywhere_loses_nothing_present():
    data, by_chunk, spans = small()
    saved = Counter()
    told = Counter()
    for size in range(8, len(data)):
        done, whole = recovered(data[:size])
        if size % 3 == 0:
            _, names, tables = by_mcap(whole)
            if size >= spans[0][0]:
                assert (names, tables) == (["rig.toml"], ["run"])
        listed = read(whole)
        sure = flat(by_chunk[: sum(end <= size for _, end in spans)])
        assert listed[: len(sure)] == sure, size
        assert listed == flat(by_chunk)[: len(listed)], size
        assert len(listed) - done.salvaged == len(sure), size
        assert done.losses, size
        assert done.losses[-1].offset + done.losses[-1].size == size
        assert listed == read(data[:size])  # including the salvaged messages
        saved[done.salvaged > 0] += 1
        told[done.losses[-1].what.split(",")[0]] += 1
    assert saved[False] > 100
    lengths = dict.fromkeys(range(0x10), 0)
    offset = 8
    while offset < len(data) - 8:
        length = int.from_bytes(data[offset + 1 : offset + 9], "little")
        lengths[data[offset]] += length
        offset += 9 + length
    assert told["an index of messages whose end is missing"] == lengths[records.MESSAGE_INDEX]


def test_recover_large_cut_chunk_saves_first_messages():
    file = io.BytesIO()
    recording = Recording(file)
    start = len(file.getvalue())
    recording.fill(15_000, 50_000).writer.close()  # 0.75 s: one chunk of about 1 MB
    data = file.getvalue()
    length = int.from_bytes(data[start + 1 : start + 9], "little")
    done, whole = recovered(data[: start + length * 6 // 10])
    listed, _, _ = by_mcap(whole)
    assert 5_000 < len(listed) == done.salvaged == done.messages < 12_000
    (loss,) = done.losses
    assert loss.first_ns == listed[-1][1]  # the messages after the last one saved are lost
    assert loss.last_ns == 14_999 * 50_000
    assert "messages were saved" in str(loss)


@pytest.mark.parametrize(("compact", "mask"), [(False, 0x01), (True, 0xFF)])
def test_recover_wrong_byte_loses_at_most_its_chunk(compact, mask):
    data, by_chunk, spans = small(compact, chunks=3)
    harmless = lost = 0
    for place in range(8, len(data)):
        hurt = data[:place] + bytes((data[place] ^ mask,)) + data[place + 1 :]
        done, whole = recovered(hurt)
        listed = by_mcap(whole)[0] if place % 7 == 0 else read(whole)
        everything = flat(by_chunk)
        inside = [k for k, (begin, end) in enumerate(spans) if begin <= place < end]
        if listed == everything:
            harmless += 1
            continue
        assert len(inside) == 1, (place, done.losses)
        others = flat(by_chunk[: inside[0]] + by_chunk[inside[0] + 1 :])
        assert listed == others, place
        (loss,) = done.losses
        begin, end = spans[inside[0]]
        assert begin == loss.offset, place
        assert loss.offset + loss.size == end, place
        times = [time_ns for _, time_ns, _ in by_chunk[inside[0]]]
        assert (loss.first_ns, loss.last_ns) == (times[0], times[-1])
        assert done.expected == len(everything)
        lost += 1
    assert lost > 3 * 150
    assert harmless > 3 * 40


def test_recover_contradicted_wrong_length_loses_nothing():
    data, by_chunk, spans = small()
    for begin, _ in spans:
        stored = begin + 9 + 28 + 4 + 4  # after the name of the compression
        for place in (*range(begin, begin + 9), *range(stored, stored + 8)):
            for mask in (1 << bit for bit in range(8)):
                hurt = data[:place] + bytes((data[place] ^ mask,)) + data[place + 1 :]
                done, whole = recovered(hurt)
                assert (read(whole), done.losses) == (flat(by_chunk), []), (place - begin, mask)


def test_recover_bit_flip_without_summary_loses_one_chunk():
    data, by_chunk, spans = small()
    cut = data[: spans[-1][1]]
    for place in range(spans[1][0], spans[1][1]):
        hurt = cut[:place] + bytes((cut[place] ^ 0x10,)) + cut[place + 1 :]
        listed = by_mcap(recovered(hurt)[1])[0]
        assert listed in (flat(by_chunk), flat(by_chunk[:1] + by_chunk[2:])), place


def test_recover_reports_each_damage_with_offset():
    data, by_chunk, spans = small(chunks=6)
    hurt = bytearray(data)
    for number in (1, 4):
        hurt[spans[number][0] + 60] ^= 0x55
    hurt[spans[2][1] : spans[2][1]] = b"some other program wrote this here" * 3
    done, whole = recovered(bytes(hurt))
    assert by_mcap(whole)[0] == flat(by_chunk[:1] + by_chunk[2:4] + by_chunk[5:])
    offsets = [loss.offset for loss in done.losses]
    assert offsets[:2] == [spans[1][0], spans[2][1]]
    assert "a damaged chunk, 1.050 s to 1.800 s" in str(done.losses[0])
    assert done.losses[1].size == 3 * 34
    assert done.lost_bytes == sum(loss.size for loss in done.losses)


def test_recover_ignores_attached_recording():
    inner, _, _ = small()
    file = io.BytesIO()
    recording = Recording(file)
    recording.writer.attach("inner.mcap", inner)
    recording.fill(20, MS).writer.close()
    data = bytearray(file.getvalue())
    expected = read(bytes(data))
    data[data.index(inner) + 300] ^= 1
    done, whole = recovered(bytes(data))
    assert by_mcap(whole)[:2] == (expected, [])
    assert len(done.losses) == 1


def test_recover_messages_of_lost_channel_are_kept():
    data, by_chunk, spans = small()
    cut = bytearray(data[: spans[-1][1]])  # no summary to use
    place = cut.index(records.string("/can/can1"))
    cut[place + 1] ^= 0xFF  # the length of its topic
    done, whole = recovered(bytes(cut))
    topics = {"/can/can1": "/channel/2"}
    expected = [(topics.get(topic, topic), t, p) for topic, t, p in flat(by_chunk)]
    assert by_mcap(whole)[0] == expected
    assert done.nameless == [2]


def test_recover_impossible_request_is_refused(tmp_path):
    source, target = tmp_path / "a.mcap", tmp_path / "b.mcap"
    write(source)
    for content, complaint in [(b"", "is empty"), (b"(0.0) can0 123#", "is not an MCAP file")]:
        (tmp_path / "x").write_bytes(content)
        with pytest.raises(TraceError, match=complaint):
            recover(str(tmp_path / "x"), str(target))
    with pytest.raises(TraceError, match="cannot be read"):
        recover(str(tmp_path / "none"), str(target))
    with pytest.raises(TraceError, match="is the source itself"):
        recover(str(source), str(source), overwrite=True)
    target.write_text("precious")
    with pytest.raises(TraceError, match="exists"):
        recover(str(source), str(target))
    with pytest.raises(TraceError, match="cannot be written"):
        recover(str(source), str(tmp_path / "no" / "b.mcap"))
    assert target.read_text() == "precious"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "b.mcap", "x"]


@pytest.mark.parametrize("name", [b"a.Name", b"/topic"])
def test_string_beyond_its_record_costs_only_that_record(tmp_path, name):
    """Another writer's chunk without compression and check sum holds the damaged record."""
    file = io.BytesIO()
    writer = Writer(file, compression=CompressionType.NONE, enable_crcs=False, use_chunking=True)
    writer.start()
    schema = writer.register_schema("a.Name", "protobuf", bytes(8))
    channel = writer.register_channel("/topic", "protobuf", schema)
    for number in range(5):
        writer.add_message(channel, number, bytes([number]), number)
    writer.finish()
    data = bytearray(file.getvalue())
    at = data.index(name) - 4
    data[at : at + 4] = b"\xff\xff\xff\xff"
    (tmp_path / "a.mcap").write_bytes(data)
    done = recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert done.messages == 5
    assert "a part of a chunk's content (the fields of a" in str(done.losses[0])
    assert [payload for *_, payload in read((tmp_path / "b.mcap").read_bytes())] == [
        bytes([number]) for number in range(5)
    ]
