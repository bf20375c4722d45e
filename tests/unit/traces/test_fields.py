import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.traces.protobuf import encode
from motorhil.traces.schema import (
    CAN_FRAME,
    JOINT_STATE,
    LOG,
    Direction,
    JointStateEncoder,
    Level,
    TruthEncoder,
    decode_can_frame,
    encode_can_frame,
    encode_log,
    timestamp_field,
    truth_message,
)
from tests.support.recordings.protobuf_classes import google_class

# Source: linux/can.h.
EFF, RTR, ERR = 0x80000000, 0x40000000, 0x20000000
BRS, ESI, FDF = 1, 2, 4
GOOGLE_CAN_FRAME = google_class(CAN_FRAME)
GOOGLE_JOINT_STATE = google_class(JOINT_STATE)


def can_frame(can_id, data=b"", length=None):
    return struct.pack("<IB3x8s", can_id, len(data) if length is None else length, data)


def canfd_frame(can_id, data=b"", flags=FDF):
    return struct.pack("<IBB2x64s", can_id, len(data), flags, data)


def test_encoded_frame_has_promised_layout():
    payload = encode_can_frame(can_frame(0x181, b"\x37\x16"), "left", Direction.RECEIVED)
    # By hand: fixed32 1, varint 8 = 1, string 9 = "left", bytes 15 = 37 16.
    assert payload.hex() == "0d81010000" + "4001" + "4a04" + b"left".hex() + "7a02" + "3716"


FRAMES = [
    (can_frame(0x7FF, bytes(8)), {"id": 0x7FF, "data": bytes(8)}),
    (can_frame(0, b""), {"id": 0, "data": b""}),
    (can_frame(0x1FFFFFFF | EFF, b"\1"), {"id": 0x1FFFFFFF, "extended": True, "data": b"\1"}),
    (can_frame(0x181 | EFF, b"\1"), {"id": 0x181, "extended": True, "data": b"\1"}),
    (can_frame(0x701 | RTR, length=8), {"id": 0x701, "remote": True, "remote_length": 8}),
    (can_frame(0x701 | RTR), {"id": 0x701, "remote": True, "remote_length": 0}),
    (
        can_frame(0x1FFFFFF8 | ERR, bytes(range(8))),
        {"id": 0x1FFFFFF8, "error": True, "data": bytes(range(8))},
    ),
    (canfd_frame(0x123, bytes(range(64))), {"id": 0x123, "fd": True, "data": bytes(range(64))}),
    (canfd_frame(0x123, b"", FDF | BRS), {"id": 0x123, "fd": True, "brs": True}),
    (
        canfd_frame(5 | EFF, b"x" * 12, FDF | BRS | ESI),
        {"id": 5, "extended": True, "fd": True, "brs": True, "esi": True, "data": b"x" * 12},
    ),
]


@pytest.mark.parametrize(("frame", "values"), FRAMES)
def test_google_decodes_every_kind_of_frame(frame, values):
    parsed = GOOGLE_CAN_FRAME.FromString(encode_can_frame(frame, "s", Direction.TRANSMITTED))
    expected = GOOGLE_CAN_FRAME(sender="s", direction=2, **values)
    assert parsed == expected


@pytest.mark.parametrize(("frame", "values"), FRAMES)
def test_recorded_frame_is_unchanged(frame, values):
    recorded = decode_can_frame(encode_can_frame(frame, "wheel_ä", Direction.RECEIVED))
    assert recorded.frame == frame
    assert (recorded.sender, recorded.direction) == ("wheel_ä", Direction.RECEIVED)


@given(
    st.integers(0, 0x1FFFFFFF),
    st.sampled_from([0, EFF, RTR, ERR, EFF | RTR]),
    st.binary(max_size=8),
)
def test_any_classical_frame_is_unchanged(can_id, flags, data):
    can_id &= 0x1FFFFFFF if flags & (EFF | ERR) else 0x7FF
    frame = can_frame(can_id | flags, b"" if flags & RTR else data, len(data))
    assert decode_can_frame(encode_can_frame(frame)).frame == frame


def test_frame_of_another_writer_is_decoded():
    theirs = encode(CAN_FRAME, {"data": b"\1\2", "id": 0x181, "extended": True})
    assert decode_can_frame(theirs).frame == can_frame(0x181 | EFF, b"\1\2")


@pytest.mark.parametrize(
    ("frame", "complaint"),
    [
        (can_frame(1, length=9), "length 9 in a CAN frame with room for 8"),
        (can_frame(1)[:15], "16 or 72 bytes, not 15"),
        (canfd_frame(1, flags=0), "without CANFD_FDF"),
    ],
)
def test_invalid_frame_is_refused(frame, complaint):
    with pytest.raises(ValueError, match=complaint):
        encode_can_frame(frame)


def test_recorded_frame_with_too_much_data_is_refused():
    with pytest.raises(ValueError, match="9 bytes with room for 8"):
        decode_can_frame(encode(CAN_FRAME, {"id": 1, "data": bytes(9)}))


@pytest.mark.parametrize(
    ("time_ns", "seconds", "nanos"),
    [
        (0, 0, 0),
        (999_999_999, 0, 999_999_999),
        (1_000_000_000, 1, 0),
        (4 * 10**18 + 5, 4 * 10**9, 5),
    ],
)
def test_google_decodes_times(time_ns, seconds, nanos):
    parsed = google_class(LOG).FromString(timestamp_field(time_ns))
    assert parsed.SerializeToString() == timestamp_field(time_ns)
    assert (parsed.timestamp.seconds, parsed.timestamp.nanos) == (seconds, nanos)
    assert parsed.HasField("timestamp")


@pytest.mark.parametrize(
    "reading", [(0.25, -1.0, 0.0), (None, -1.0, None), (1.0, None, None), (None, None, None)]
)
def test_google_decodes_joint_state_without_unknowns(reading):
    payload = JointStateEncoder("left").encode(*reading)
    parsed = GOOGLE_JOINT_STATE.FromString(payload)
    assert parsed.name == "left"
    known = {
        name: value
        for name, value in zip(("position", "velocity", "effort"), reading, strict=True)
        if value is not None
    }
    assert {f.name: v for f, v in parsed.ListFields() if f.name != "name"} == known
    # The generic encoder, which agrees with Google's, writes the same bytes.
    assert payload == encode(JOINT_STATE, {"name": "left", **known})


def test_google_decodes_event():
    parsed = google_class(LOG).FromString(
        encode_log(7, Level.WARNING, "bus übervoll " * 20, "can0")
    )
    assert (parsed.timestamp.nanos, parsed.level) == (7, 3)
    assert (parsed.message, parsed.name) == ("bus übervoll " * 20, "can0")


@pytest.mark.parametrize("count", [1, 9, 15, 16, 40])  # field 16 is the first with a tag of 2 bytes
def test_google_decodes_snapshot_of_any_width(count):
    message = truth_message("x", [f"k{i}" for i in range(count)])
    encoder = TruthEncoder(message)
    for start in (0.5, -1e300):
        parsed = google_class(message).FromString(encoder.encode([start + i for i in range(count)]))
        assert [getattr(parsed, f"k{i}") for i in range(count)] == [start + i for i in range(count)]


def test_snapshots_keep_every_bit():
    message = truth_message("x", ["a", "b", "c"])
    values = [-0.0, math.inf, 5e-324]
    parsed = google_class(message).FromString(TruthEncoder(message).encode(values))
    assert struct.pack("<3d", parsed.a, parsed.b, parsed.c) == struct.pack("<3d", *values)


def test_snapshot_of_wrong_width_is_refused():
    encoder = TruthEncoder(truth_message("x", ["a", "b"]))
    with pytest.raises(ValueError, match="sequence of size 1"):
        encoder.encode([1.0])
