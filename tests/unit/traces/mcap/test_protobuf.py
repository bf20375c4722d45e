from contextlib import suppress

import pytest
from google.protobuf import timestamp_pb2
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.json_format import MessageToDict
from hypothesis import given
from hypothesis import strategies as st

from motorhil.traces.protobuf import decode, delimited, encode, file_descriptor_set, varint
from motorhil.traces.schema import (
    CAN_FRAME,
    GROUP_SYNC,
    JOINT_STATE,
    LOG,
    MOTOR_LOCK,
    TIMESTAMP,
    truth_message,
)
from tests.support.recordings.protobuf_classes import google_class

TRUTH = truth_message("cia402", ["position_rad", "state"])
MESSAGES = [CAN_FRAME, JOINT_STATE, LOG, MOTOR_LOCK, GROUP_SYNC, TIMESTAMP, TRUTH]

# Every field of every message, with a value that is not the default one.
FULL = {
    CAN_FRAME.name: {
        "id": 0x1ABCDEF0,
        "extended": True,
        "remote": True,
        "error": True,
        "fd": True,
        "brs": True,
        "esi": True,
        "direction": 2,
        "sender": "wheel_ä",
        "remote_length": 300,
        "data": b"\x00\xff",
    },
    JOINT_STATE.name: {
        "name": "a",
        "position": 1.5,
        "velocity": 0.0,
        "acceleration": -2.0,
        "effort": 1e-300,
    },
    LOG.name: {
        "timestamp": {"seconds": 3_000_000_000, "nanos": 999_999_999},
        "level": 3,
        "message": "x" * 200,
        "name": "left",
        "file": "f",
        "line": 0xFFFFFFFF,
    },
    MOTOR_LOCK.name: {
        "action": 5,
        "owner": "a",
        "holder": "b",
        "waited_s": 0.5,
        "held_s": -1.0,
        "token": 1_795_298_400_005,
        "pid": 4_194_303,
        "program": "mast.py",
        "purpose": "panorama",
        "sender": "mast.py[4194303]",
        "looked": True,
    },
    GROUP_SYNC.name: {
        "phase": 1,
        "motor": ["a", "b"],
        "offset_s": [0.0, 1e-4],
        "skew_s": 1e-4,
        "predicted_skew_s": 2e-4,
        "method": "sync",
    },
    TIMESTAMP.name: {"seconds": -1, "nanos": -2},
    TRUTH.name: {"position_rad": 0.25, "state": 7.0},
}


def by_name(message):
    return message.name


# Source: protobuf.dev, "Encoding": 150 is 96 01; -2 is ten bytes; and the boundaries of one byte.
@pytest.mark.parametrize(
    ("value", "wire"),
    [
        (0, "00"),
        (127, "7f"),
        (128, "8001"),
        (150, "9601"),
        (-2, "feffffffffffffffff01"),
    ],
)
def test_varints_match_encoding_guide(value, wire):
    assert varint(value).hex() == wire


@pytest.mark.parametrize("message", MESSAGES, ids=by_name)
def test_google_parses_descriptors_to_same_bytes(message):
    data = file_descriptor_set(message)
    parsed = FileDescriptorSet.FromString(data)
    assert parsed.SerializeToString(deterministic=True) == data
    assert parsed.file[-1].message_type[0].name == message.name.rpartition(".")[2]


def test_timestamp_equals_well_known_type():
    theirs = FileDescriptorProto.FromString(timestamp_pb2.DESCRIPTOR.serialized_pb)
    ours = FileDescriptorSet.FromString(file_descriptor_set(TIMESTAMP)).file[0]
    assert (ours.name, ours.package, ours.syntax) == (theirs.name, theirs.package, theirs.syntax)
    for one, other in zip(ours.message_type[0].field, theirs.message_type[0].field, strict=True):
        facts = (one.name, one.number, one.type, one.label)
        assert facts == (other.name, other.number, other.type, other.label)


@pytest.mark.parametrize("message", MESSAGES, ids=by_name)
def test_google_decodes_every_field_to_same_bytes(message):
    values = FULL[message.name]
    assert list(values) == [field.name for field in message.fields]  # all fields are covered
    payload = encode(message, values)
    parsed = google_class(message).FromString(payload)
    assert parsed.SerializeToString(deterministic=True) == payload
    for name, value in values.items():
        if name == "timestamp":
            assert MessageToDict(parsed)["timestamp"] == "2065-01-24T05:20:00.999999999Z"
        else:
            assert getattr(parsed, name) == value, name


@pytest.mark.parametrize("message", MESSAGES, ids=by_name)
def test_encoded_message_is_decoded(message):
    values = FULL[message.name]
    assert decode(message, encode(message, values)) == values


def test_unpacked_numbers_are_decoded():
    # Source: protobuf.dev, "Packed repeated fields": parsers must accept both forms.
    one_by_one = b"\x19" + bytes(7) + b"\x40" + b"\x19" + bytes(6) + b"\xf0\x3f"
    assert decode(GROUP_SYNC, one_by_one) == {"offset_s": [2.0, 1.0]}


def test_unknown_fields_are_skipped():
    later = delimited(100, b"new") + b"\xa5\x06abcd" + b"\xa1\x06abcdefgh" + b"\xa0\x06\x05"
    assert decode(LOG, later + b"\x10\x02") == {"level": 2}


@pytest.mark.parametrize(
    ("message", "payload", "complaint"),
    [
        (LOG, b"\x10", "varint without end"),
        (LOG, b"\x1a\x05abc", "goes beyond the end"),
        (LOG, b"\x18\x05", "foxglove.Log.message has wire type 0"),
        (LOG, b"\x13", "wire type 3"),
    ],
)
def test_broken_message_is_reported(message, payload, complaint):
    with pytest.raises(ValueError, match=complaint):
        decode(message, payload)


@given(st.binary(max_size=60), st.sampled_from(MESSAGES))
def test_garbage_is_decoded_or_value_error(payload, message):
    with suppress(ValueError):
        decode(message, payload)


def test_unknown_field_is_refused_with_known_names():
    with pytest.raises(ValueError, match="has no field 'speed'; it has action, owner"):
        encode(MOTOR_LOCK, {"speed": 1.0})


@pytest.mark.parametrize(
    ("message", "values"),
    [
        (MOTOR_LOCK, {"owner": 3}),
        (MOTOR_LOCK, {"waited_s": "long"}),
        (GROUP_SYNC, {"motor": "left"}),
        (GROUP_SYNC, {"offset_s": 1.0}),
        (LOG, {"timestamp": 5}),
    ],
)
def test_value_of_wrong_type_is_refused(message, values):
    with pytest.raises(ValueError, match=r"is .* not"):
        encode(message, values)
