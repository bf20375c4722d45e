"""The selected messages of a recording's beginning teach as much as all of them."""

import struct

from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.traces.can_frame import classic
from motorhil.traces.decoding.narrative import Story, telling
from motorhil.traces.formats.frames import Frame
from motorhil.traces.formats.registry import record_frames
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, Direction, Schema

S = 1_000_000_000
MS = 1_000_000


def sdo(node, index, subindex, value, size=4):
    """Return a download and its confirmation."""
    command = 0x23 | (4 - size) << 2
    head = struct.pack("<BHB", command, index, subindex)
    ask = classic(0x600 + node, head + struct.pack("<I", value))
    return [ask, classic(0x580 + node, b"\x60" + head[1:] + bytes(4))]


NODES = st.sampled_from([1, 2])
COMMANDS = st.sampled_from([1, 0x80, 0x81, 0x82])
DATA = st.lists(st.integers(1, 255), min_size=1, max_size=8)
CAN_IDS = st.sampled_from([0x80, 0x85, 0x100, 0x181, 0x182, 0x201, 0x281, 0x3FF, 0x701, 0x702])
ENTRIES = st.sampled_from([0x60400010, 0x60410010, 0x60600008, 0x60610008, 0x60640020])
# one value each: a PDO's mapping, its COB-ID, the mode by SDO, resets, boot-ups, and PDOs
STEPS = st.one_of(
    st.builds(lambda n, i, e: sdo(n, i, 1, e), NODES, st.sampled_from([0x1600, 0x1A00]), ENTRIES),
    st.builds(lambda n, i, k: sdo(n, i, 0, k, 1), NODES, st.sampled_from([0x1600, 0x1A00]), NODES),
    st.builds(lambda n, i, e: sdo(n, i, 2, e), NODES, st.sampled_from([0x1600, 0x1A00]), ENTRIES),
    st.builds(lambda n, c: sdo(n, 0x1800, 1, c), NODES, CAN_IDS),
    st.builds(lambda n, m: sdo(n, 0x6060, 0, m, 1), NODES, st.sampled_from([1, 3, 6, 8])),
    st.builds(lambda n, t: sdo(n, 0x1000, 0, t), NODES, st.sampled_from([402, 401])),
    st.builds(lambda n, c: [classic(0, bytes((c, n)))], NODES, COMMANDS),
    st.builds(lambda n, s: [classic(0x700 + n, bytes((s,)))], NODES, st.sampled_from([0, 5, 0x7F])),
    st.builds(lambda i, d: [classic(i, bytes(d))], CAN_IDS, DATA),
)


def lines_after(trace, from_ns, learn):
    """Return the story from `from_ns` on; `learn` processes the messages before it."""
    story = Story(trace)
    learn(story)
    for bus in story._buses.values():
        bus.forget_transfers()
    told = [story.line(message) for message in trace.messages(from_ns=from_ns)]
    return [line.text for line in told]


@given(st.lists(STEPS, max_size=30), st.lists(STEPS, min_size=1, max_size=8))
def test_preamble_teaches_as_much_as_all_messages(tmp_path_factory, before, after):
    path = tmp_path_factory.mktemp("story") / "a.mcap"
    frames = [Frame(n * MS, "can0", f) for n, f in enumerate(f for step in before for f in step)]
    frames += [Frame(9 * S + n, "can0", f) for n, f in enumerate(f for step in after for f in step)]
    record_frames(path, frames, {})
    with read_trace(path) as trace:
        wanted = lines_after(
            trace, 9 * S, lambda story: [story.line(m) for m in trace.messages(to_ns=9 * S)]
        )
        found = [line.text for line in Story(trace).lines(from_ns=9 * S)]
    event("mapped" if any(" = " in text and "PDO" in text for text in wanted) else "not mapped")
    assert found == wanted


def test_pdo_is_decoded_by_mapping_of_its_time(tmp_path):
    frames = [*sdo(1, 0x1A00, 1, 0x60610008), classic(0x181, b"\3")]
    frames += [*sdo(1, 0x1A00, 1, 0x60410010), classic(0x701, b"\5")]
    frames.append(classic(0x181, b"\x37\x12"))
    record_frames(tmp_path / "a.mcap", [Frame(n * S, "can0", f) for n, f in enumerate(frames)], {})
    with read_trace(tmp_path / "a.mcap") as trace:
        told = [line.text for line in Story(trace).lines(from_ns=6 * S)]
    assert told == ["node 1 TPDO 1: 6041h statusword = 1237h operation enabled, speed is 0"]


def test_few_messages_of_much_traffic_are_selected(tmp_path):
    frames = [Frame(n, "can0", f) for n, f in enumerate(sdo(1, 0x1A00, 1, 0x60410010))]
    frames += [Frame(9 + n, "can0", classic(0x181, bytes([n % 200, 2]))) for n in range(1000)]
    frames += [Frame(2000 + n, "can0", classic(0x701, b"\5")) for n in range(100)]
    record_frames(tmp_path / "a.mcap", frames, {})
    with read_trace(tmp_path / "a.mcap") as trace:
        assert len(list(telling(trace.messages(), 50_000))) == 3
        assert len(list(telling(trace.messages(), 2))) == 2


def test_all_frames_of_other_layout_are_selected(tmp_path):
    with TraceWriter(tmp_path / "a.mcap") as writer:
        channel = writer.channel("/can/can0", Schema.of(CAN_FRAME))
        for n in range(3):  # its direction first: a writer can choose the order of fields
            payload = bytes([0x40, Direction.RECEIVED, 0x0D]) + struct.pack("<I", 0x181) + b"\x7a\0"
            writer.write(channel, n, payload)
    with read_trace(tmp_path / "a.mcap") as trace:
        assert len(list(telling(trace.messages(), 50_000))) == 3
