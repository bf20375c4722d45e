from google.protobuf.descriptor_pb2 import FileDescriptorSet

from motorhil.traces.protobuf import file_descriptor_set
from motorhil.traces.schema import (
    CAN_FRAME,
    JOINT_STATE,
    LOG,
    MOTOR_LOCK,
    Direction,
    Level,
    LockAction,
    Schema,
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
