import struct

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from hypothesis import given
from hypothesis import strategies as st

from motorhil.traces.protobuf import decode, file_descriptor_set
from motorhil.traces.schema import (
    CAN_FRAME,
    JOINT_STATE,
    LOG,
    MOTOR_LOCK,
    Direction,
    DoublesDecoder,
    FrameDecoder,
    JointStateEncoder,
    Level,
    LockAction,
    Schema,
    TruthDecoder,
    TruthEncoder,
    encode_can_frame,
    truth_message,
)
from tests.support.recordings.protobuf_classes import google_class

# Source: foxglove-schemas-protobuf 0.4.0 (PyPI), `DESCRIPTOR.serialized_pb` of each file.
FOXGLOVE_JOINT_STATE = (
    "0a19666f78676c6f76652f4a6f696e7453746174652e70726f746f1208666f78676c6f766522ae010a0a4a6f696e74"
    "5374617465120c0a046e616d6518012001280912150a08706f736974696f6e180220012801480088010112150a0876"
    "656c6f63697479180320012801480188010112190a0c616363656c65726174696f6e18042001280148028801011213"
    "0a066566666f72741805200128014803880101420b0a095f706f736974696f6e420b0a095f76656c6f63697479420f"
    "0a0d5f616363656c65726174696f6e42090a075f6566666f7274620670726f746f33"
)
FOXGLOVE_LOG = (
    "0a12666f78676c6f76652f4c6f672e70726f746f1208666f78676c6f76651a1f676f6f676c652f70726f746f627566"
    "2f74696d657374616d702e70726f746f22e1010a034c6f67122d0a0974696d657374616d7018012001280b321a2e67"
    "6f6f676c652e70726f746f6275662e54696d657374616d7012220a056c6576656c18022001280e32132e666f78676c"
    "6f76652e4c6f672e4c6576656c120f0a076d657373616765180320012809120c0a046e616d65180420012809120c0a"
    "0466696c65180520012809120c0a046c696e65180620012807224c0a054c6576656c120b0a07554e4b4e4f574e1000"
    "12090a054445425547100112080a04494e464f1002120b0a075741524e494e47100312090a054552524f5210041209"
    "0a05464154414c1005620670726f746f33"
)


def test_foxglove_schemas_are_byte_identical():
    for message, theirs in ((JOINT_STATE, FOXGLOVE_JOINT_STATE), (LOG, FOXGLOVE_LOG)):
        ours = FileDescriptorSet.FromString(file_descriptor_set(message)).file[-1]
        assert ours.SerializeToString().hex() == theirs


def test_event_levels_are_foxgloves():
    levels = google_class(LOG).DESCRIPTOR.fields_by_name["level"].enum_type.values_by_name
    assert {name: value.number for name, value in levels.items()} == {
        level.name: level.value for level in Level
    }


def test_field_numbers_of_can_frame_are_permanent():
    assert {field.name: field.number for field in CAN_FRAME.fields} == {
        "id": 1,
        "extended": 2,
        "remote": 3,
        "error": 4,
        "fd": 5,
        "brs": 6,
        "esi": 7,
        "direction": 8,
        "sender": 9,
        "remote_length": 10,
        "data": 15,
    }
    values = google_class(CAN_FRAME).DESCRIPTOR.fields_by_name["direction"].enum_type.values
    assert {v.name: v.number for v in values} == {d.name: d.value for d in Direction}


def test_numbers_of_lock_events_are_permanent():
    assert {field.name: field.number for field in MOTOR_LOCK.fields} == {
        "action": 1,
        "owner": 2,
        "holder": 3,
        "waited_s": 4,
        "held_s": 5,
        "token": 6,
        "pid": 7,
        "program": 8,
        "purpose": 9,
        "sender": 10,
        "looked": 11,
    }
    assert {action.name: action.value for action in LockAction} == {
        "UNKNOWN": 0,
        "TAKEN": 1,
        "RELEASED": 2,
        "WAITING": 3,
        "REFUSED": 4,
        "BROKEN": 5,
        "TAKEN_OVER": 6,
        "LOST": 7,
    }


def test_truth_message_has_one_field_per_key_in_order():
    message = truth_message("cia402", ["position_rad", "current_a", "state"])
    fields = google_class(message).DESCRIPTOR.fields
    assert [(f.number, f.name) for f in fields] == [
        (1, "position_rad"),
        (2, "current_a"),
        (3, "state"),
    ]
    assert message.name == "motorhil.truth.cia402"


def test_truth_message_renames_invalid_keys_uniquely():
    message = truth_message("my-drive", ["2nd load", "_2nd_load_", "2nd-load"])
    assert message.name == "motorhil.truth.my_drive"
    names = [field.name for field in google_class(message).DESCRIPTOR.fields]
    assert len(set(names)) == 3
    assert names[0] == "_2nd_load"


def test_schema_names_its_encoding():
    schema = Schema.of(LOG)
    assert (schema.name, schema.encoding) == ("foxglove.Log", "protobuf")


def test_frame_decoder_tells_senders_of_one_identifier_apart():
    """Node 1 of two buses has other names; their messages begin with the same identifier."""
    decoder = FrameDecoder()
    data = struct.pack("<IB3x8s", 0x181, 8, bytes(range(8)))
    for _ in range(2):
        for sender in ("left", "rear", *(f"n{number:03}" for number in range(40))):
            payload = encode_can_frame(data, sender, Direction.RECEIVED)
            assert decoder.decode(payload) == (data, Direction.RECEIVED, sender)


@given(
    st.lists(
        st.tuples(
            st.sampled_from(("", "wheel", "x" * 9)),
            st.lists(st.floats(allow_nan=False) | st.none(), min_size=3, max_size=3),
        ),
        max_size=30,
    )
)
def test_cached_doubles_equal_the_table(told):
    """Messages with any joint's name, and with any of the quantities, in one channel."""
    decoder = DoublesDecoder(JOINT_STATE)
    for name, values in told:
        payload = JointStateEncoder(name).encode(*values) if name else b""
        expected = decode(JOINT_STATE, payload)
        expected.pop("name", None)
        assert decoder.decode(payload) == expected


@pytest.mark.parametrize("tail", [b"\x09", b"\x0a\x01a", b"\x09" + bytes(7), b"\x11" + bytes(9)])
def test_changed_payload_of_known_size_is_decoded_anew(tail):
    decoder = DoublesDecoder(JOINT_STATE)
    good = JointStateEncoder("m").encode(1.0, 2.0, 3.0)
    assert decoder.decode(good) == {"position": 1.0, "velocity": 2.0, "effort": 3.0}
    payload = good[: len(good) - len(tail)] + tail
    try:
        expected = {k: v for k, v in decode(JOINT_STATE, payload).items() if k != "name"}
    except ValueError:
        with pytest.raises(ValueError, match=r"byte|ends|bytes"):
            decoder.decode(payload)
    else:
        assert decoder.decode(payload) == expected


def test_truth_without_a_field_reads_as_zero():
    """In protobuf an absent number is 0."""
    decoder = TruthDecoder(truth_message("toy", ("a", "b")))
    assert decoder.decode(b"\x11" + struct.pack("<d", 2.5)) == {"a": 0.0, "b": 2.5}
    both = TruthEncoder(truth_message("toy", ("a", "b"))).encode((1.5, 2.5))
    assert decoder.decode(both) == {"a": 1.5, "b": 2.5}
