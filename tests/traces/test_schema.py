from tests.traces.protobuf_classes import google_class
from traces.schema import CAN_FRAME, JOINT_STATE, LOG, Direction, Level, Schema, truth_message

# Source: foxglove-sdk, schemas/proto/foxglove/{JointState,Log}.proto, read 2026-11.
FOXGLOVE_JOINT_STATE = [
    (1, "timestamp", "google.protobuf.Timestamp", False),
    (2, "name", "string", True),
    (3, "position", "double", True),
    (4, "velocity", "double", True),
    (5, "effort", "double", True),
]
FOXGLOVE_LOG = [
    (1, "timestamp", "google.protobuf.Timestamp", False),
    (2, "level", "foxglove.Log.Level", False),
    (3, "message", "string", False),
    (4, "name", "string", False),
    (5, "file", "string", False),
    (6, "line", "fixed32", False),
]
FOXGLOVE_LEVELS = {"UNKNOWN": 0, "DEBUG": 1, "INFO": 2, "WARNING": 3, "ERROR": 4, "FATAL": 5}
TYPES = {1: "double", 7: "fixed32", 9: "string"}


def facts(message):
    out = []
    for field in google_class(message).DESCRIPTOR.fields:
        of = field.message_type or field.enum_type
        kind = of.full_name if of else TYPES[field.type]
        out.append((field.number, field.name, kind, field.is_repeated))
    return out


def test_joint_state_and_log_are_foxgloves():
    assert facts(JOINT_STATE) == FOXGLOVE_JOINT_STATE
    assert facts(LOG) == FOXGLOVE_LOG
    levels = google_class(LOG).DESCRIPTOR.fields_by_name["level"].enum_type.values_by_name
    assert {name: value.number for name, value in levels.items()} == FOXGLOVE_LEVELS
    assert {level.name: level.value for level in Level} == FOXGLOVE_LEVELS


def test_field_numbers_of_a_can_frame_are_kept_forever():
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


def test_a_controllers_truth_has_one_field_a_quantity_in_the_order_of_the_keys():
    message = truth_message("cia402", ["position_rad", "current_a", "state"])
    fields = google_class(message).DESCRIPTOR.fields
    assert [(f.number, f.name) for f in fields] == [
        (1, "position_rad"),
        (2, "current_a"),
        (3, "state"),
    ]
    assert message.name == "motorhil.truth.cia402"


def test_keys_that_protobuf_cannot_name_are_altered_and_stay_apart():
    message = truth_message("my-drive", ["2nd load", "_2nd_load_", "2nd-load"])
    assert message.name == "motorhil.truth.my_drive"
    names = [field.name for field in google_class(message).DESCRIPTOR.fields]
    assert len(set(names)) == 3
    assert names[0] == "_2nd_load"


def test_a_schema_says_what_it_is_encoded_with():
    schema = Schema.of(LOG)
    assert (schema.name, schema.encoding) == ("foxglove.Log", "protobuf")
