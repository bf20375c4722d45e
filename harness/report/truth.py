"""Snapshots of controllers, whose channel defines its own fields."""

from typing import Final, final

from traces.protobuf import Field, Kind, Message, decode
from traces.schema import Schema

PREFIX: Final = "motorhil.truth."

# Source: google/protobuf/descriptor.proto; only the fields used here.
_FIELD: Final = Message(
    "google.protobuf.FieldDescriptorProto",
    (Field(1, "name", Kind.STRING), Field(3, "number", Kind.INT32), Field(5, "type", Kind.INT32)),
)
_MESSAGE: Final = Message(
    "google.protobuf.DescriptorProto",
    (
        Field(1, "name", Kind.STRING),
        Field(2, "field", Kind.MESSAGE, repeated=True, of=_FIELD),
    ),
)
_FILE: Final = Message(
    "google.protobuf.FileDescriptorProto",
    (
        Field(2, "package", Kind.STRING),
        Field(4, "message_type", Kind.MESSAGE, repeated=True, of=_MESSAGE),
    ),
)
_SET: Final = Message(
    "google.protobuf.FileDescriptorSet",
    (Field(1, "file", Kind.MESSAGE, repeated=True, of=_FILE),),
)


def message_of(schema: Schema) -> Message | None:
    """Return the message type of a truth channel with its double fields, or None."""
    if not schema.name.startswith(PREFIX) or schema.encoding != "protobuf":
        return None
    try:
        files = decode(_SET, schema.data).get("file", [])
    except ValueError:
        return None
    for file in files if isinstance(files, list) else []:
        if not isinstance(file, dict):
            continue
        package = file.get("package", "")
        messages = file.get("message_type", [])
        for message in messages if isinstance(messages, list) else []:
            if isinstance(message, dict) and f"{package}.{message.get('name')}" == schema.name:
                return Message(schema.name, _doubles(message.get("field", [])))
    return None


def _doubles(fields: object) -> tuple[Field, ...]:
    found: list[Field] = []
    for one in fields if isinstance(fields, list) else []:
        if isinstance(one, dict) and one.get("type") == Kind.DOUBLE.value:
            number = one.get("number")
            if isinstance(number, int):
                found.append(Field(number, str(one.get("name", "")), Kind.DOUBLE))
    return tuple(found)


@final
class TruthReader:
    """Reader of the messages of one truth channel."""

    def __init__(self, message: Message) -> None:
        self._message = message
        self._names = [field.name for field in message.fields]

    def read(self, payload: bytes) -> dict[str, float]:
        """Return every field; a missing one is 0, as in protobuf.

        Raises:
            ValueError: the payload is not such a message.
        """
        told = decode(self._message, payload)
        values: dict[str, float] = {}
        for name in self._names:
            value = told.get(name, 0.0)
            values[name] = value if isinstance(value, float) else 0.0
        return values
