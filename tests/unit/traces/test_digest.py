import hashlib
import io
import struct

import pytest
from mcap.reader import make_reader

from motorhil.traces.digest import digest, first_mismatch
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, LOG, Direction, Schema, encode_can_frame
from tests.support.recordings.written import MS, Recording, can_frame, write


def test_digest_matches_definition(tmp_path):
    path = tmp_path / "a.mcap"
    writer = TraceWriter(path)
    channel = writer.channel("/can/a", Schema.of(CAN_FRAME))
    writer.can_frame(writer.source(channel, "x", Direction.RECEIVED), 5, can_frame(1, b"\2"))
    writer.close()
    payload = encode_can_frame(can_frame(1, b"\2"), "x", Direction.RECEIVED)
    by_hand = struct.pack("<I", 6) + b"/can/a" + struct.pack("<QI", 5, len(payload)) + payload
    assert digest(path) == hashlib.sha256(by_hand).hexdigest()


def test_digest_of_many_messages_matches_definition(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, 25_000, MS)
    by_hand = hashlib.sha256()
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            topic = channel.topic.encode()
            by_hand.update(struct.pack("<I", len(topic)) + topic)
            by_hand.update(struct.pack("<QI", message.log_time, len(message.data)) + message.data)
    assert digest(path) == by_hand.hexdigest()


def test_digest_ignores_chunks_metadata_and_numbers(tmp_path):
    one, other = tmp_path / "a.mcap", tmp_path / "b.mcap"
    recording = write(one)
    second = TraceWriter(other, {"run": {"seed": "2", "versions": "others"}})
    second.attach("rig.toml", b"x")
    events = second.channel("/events", Schema.of(LOG))  # before the buses, this time
    can = [second.channel(f"/can/can{i}", Schema.of(CAN_FRAME)) for i in (1, 0)]
    host = second.source(can[1], "host", Direction.TRANSMITTED)
    sources = [
        second.source(can[1], "left", Direction.RECEIVED),
        host,
        second.source(can[0], "right", Direction.RECEIVED),
    ]
    for source, time_ns, data in recording.entries:
        second.extend([(sources[source] if source >= 0 else -events, time_ns, data)])
        second.flush()  # a chunk for every message
    second.close()
    assert one.read_bytes() != other.read_bytes()
    assert digest(one) == digest(other)
    assert first_mismatch(one, other) is None


def changed(path, entries, at, entry):
    recording = Recording(path)
    recording.writer.extend([*entries[:at], entry(*entries[at]), *entries[at + 1 :]])
    recording.writer.close()


@pytest.mark.parametrize(
    "entry",
    [
        lambda source, time_ns, data: (source, time_ns + 1, data),
        lambda source, time_ns, data: (1 - source, time_ns, data),
        lambda source, time_ns, data: (source, time_ns, data[:-1] + bytes([data[-1] ^ 1])),
    ],
    ids=["time", "sender", "one bit of data"],
)
def test_any_change_of_message_changes_digest(tmp_path, entry):
    one, other = tmp_path / "a.mcap", tmp_path / "b.mcap"
    changed(other, write(one, 30).entries, 12, entry)
    assert digest(one) != digest(other)
    found = first_mismatch(one, other)
    assert found is not None
    assert found.number == 12
    assert found.first != found.second
    assert str(found).startswith("message 12: /can/can0 at 0.600000000 s")


def test_digest_depends_on_order_and_end(tmp_path):
    paths = [tmp_path / name for name in ("a", "b", "c")]
    frames = [(0, 7, can_frame(1)), (0, 7, can_frame(2))]
    for path, entries in zip(paths, (frames, frames[::-1], frames[:1]), strict=True):
        recording = Recording(path)
        recording.writer.extend(entries)
        recording.writer.close()
    assert len({digest(path) for path in paths}) == 3
    found = first_mismatch(paths[0], paths[2])
    assert found is not None
    assert (found.number, found.second) == (1, None)
    assert str(found).endswith("against the end")


def test_digest_delimits_topic_and_payload(tmp_path):
    one, other = tmp_path / "a", tmp_path / "b"
    for path, topic, payload in ((one, "/a", b"bc"), (other, "/ab", b"c")):
        with TraceWriter(path) as writer:
            writer.write(writer.channel(topic, Schema.of(LOG)), 1, payload)
    assert digest(one) != digest(other)


def test_digest_of_cut_file_needs_all_messages(tmp_path):
    path = tmp_path / "a.mcap"
    recording = Recording(path).fill(30, 50 * MS)
    recording.writer.flush()
    size = path.stat().st_size
    recording.writer.close()
    data, whole = path.read_bytes(), digest(path)
    path.write_bytes(data[:size])
    with pytest.raises(TraceError, match="has no digest: cut at byte"):
        digest(path)
    path.write_bytes(data[: size + 13 + 20])  # data end is there, the summary is not
    assert digest(path) == whole


def test_file_object_works_like_path(tmp_path):
    path = tmp_path / "a.mcap"
    write(path)
    file = io.BytesIO()
    write(file)
    (tmp_path / "b.mcap").write_bytes(file.getvalue())
    assert digest(tmp_path / "b.mcap") == digest(path)
