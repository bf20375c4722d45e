"""Incidents of a recording: faults, events, commands; limited in number.

Snapshots of controllers, whose channel defines its own fields.
"""

from collections import Counter
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, final

from motorhil.traces.mcap.protobuf import Field, Kind, Message, decode
from motorhil.traces.schema import Schema

KEPT: Final = 2_000
"""Limit for each kind; a longer list is not readable."""


@final
class Severity(IntEnum):
    """The severity of an incident."""

    INFO = 0
    WARNING = 1
    ERROR = 2


@final
@dataclass(frozen=True, slots=True)
class Incident:
    """One incident.

    Attributes:
        time_ns: from the recording's beginning [ns].
        severity: the severity.
        kind: the kind, in a few words.
        place: the bus, the motor, or the source of the message.
        text: the description.
    """

    time_ns: int
    severity: Severity
    kind: str
    place: str
    text: str


@final
class Incidents:
    """All incidents, the first `KEPT` of each kind.

    Attributes:
        kept: the incidents, in order of arrival.
        counts: the number of all incidents, by kind.
    """

    def __init__(self) -> None:
        self.kept: list[Incident] = []
        self.counts: Counter[str] = Counter()

    def add(self, time_ns: int, severity: Severity, kind: str, place: str, text: str) -> None:
        """Add an incident."""
        self.counts[kind] += 1
        if self.counts[kind] <= KEPT:
            self.kept.append(Incident(time_ns, severity, kind, place, text))

    def left_out(self) -> list[str]:
        """Return a remark for each kind that exceeds the limit."""
        return [
            f"the last {count - KEPT} of {count} incidents of kind “{kind}” are not shown"
            for kind, count in self.counts.items()
            if count > KEPT
        ]


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
