"""Protocol Buffers without a library: wire format, descriptors, message tables.

Recording needs a dozen fixed messages and must not cost a dependency. A message is therefore a
table (`Message`). Its descriptor is computed from the table (`file_descriptor_set`) and embedded in
the file for any reader. `encode` and `decode` serve rare messages. Frequent messages have their own
code in `motorhil.traces.schema`.

Source: protobuf.dev, "Encoding" (wire types, varints, packed fields) and descriptor.proto (field
numbers of the descriptors).
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import Final, final

Value = int | float | bool | str | bytes | Sequence[float] | Sequence[str] | Mapping[str, "Value"]
"""The value of a field; a mapping is a nested message."""

_VARINT: Final = 0
_FIXED_64: Final = 1
_LENGTH: Final = 2
_FIXED_32: Final = 5
_DOUBLE: Final = struct.Struct("<d")
_UINT32: Final = struct.Struct("<I")


@final
class Kind(Enum):
    """A field's type; the value is its number in descriptor.proto, FieldDescriptorProto.Type."""

    DOUBLE = 1
    INT64 = 3
    INT32 = 5
    FIXED32 = 7
    BOOL = 8
    STRING = 9
    MESSAGE = 11
    BYTES = 12
    UINT32 = 13
    ENUM = 14


_WIRE_TYPE: Final[dict[Kind, int]] = {
    Kind.DOUBLE: _FIXED_64,
    Kind.FIXED32: _FIXED_32,
    Kind.STRING: _LENGTH,
    Kind.BYTES: _LENGTH,
    Kind.MESSAGE: _LENGTH,
}  # the others are varints


@final
@dataclass(frozen=True, slots=True)
class Enumeration:
    """An enum inside a message; the first value must be 0 (proto3)."""

    name: str
    values: tuple[tuple[str, int], ...]


@final
@dataclass(frozen=True, slots=True)
class Field:
    """One line of a message's table; `of` is the type of an ENUM or MESSAGE field.

    An optional field can be absent. For other fields, absent and zero are the same.
    """

    number: int
    name: str
    kind: Kind
    repeated: bool = False
    optional: bool = False
    of: "Enumeration | Message | None" = None


@final
@dataclass(frozen=True, slots=True)
class Message:
    """A proto3 message type; `name` is the full name, such as "motorhil.CanFrame"."""

    name: str
    fields: tuple[Field, ...]

    def file_name(self) -> str:
        """Return the name of the .proto file that would define it."""
        package, _, short = self.name.rpartition(".")
        if self.name == "google.protobuf.Timestamp":  # the well-known types have their own files
            short = "timestamp"
        return f"{package.replace('.', '/')}/{short}.proto"


# ------------------------------------------------------------------------------- wire format


def varint(value: int) -> bytes:
    """Return the base-128 varint of `value`; negative numbers as 64 bit two's complement."""
    value &= 0xFFFF_FFFF_FFFF_FFFF
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def tag(number: int, kind: Kind, packed: bool = False) -> bytes:
    """Return the tag before a field's value."""
    return varint(number << 3 | (_LENGTH if packed else _WIRE_TYPE.get(kind, _VARINT)))


def delimited(number: int, payload: bytes) -> bytes:
    """Return a length-delimited field: bytes, a string, or a nested message."""
    return varint(number << 3 | _LENGTH) + varint(len(payload)) + payload


def _number(number: int, value: int) -> bytes:
    """Return a varint field."""
    return varint(number << 3) + varint(value)


def read_varint(data: bytes, offset: int) -> tuple[int, int]:
    """Return the value of a varint, and the offset after it.

    Raises:
        ValueError: the data ends inside it, or it is longer than 10 bytes.
    """
    if offset < len(data) and data[offset] < 0x80:
        return data[offset], offset + 1
    value = shift = 0
    while offset < len(data) and shift < 70:
        byte = data[offset]
        offset += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, offset
        shift += 7
    raise ValueError(f"varint without end at byte {offset}")


# ------------------------------------------------------------------------------- descriptors


def file_descriptor_set(message: Message) -> bytes:
    """Return the serialised google.protobuf.FileDescriptorSet of a message and its dependencies.

    It has one file per message, dependencies first, as an MCAP schema of encoding "protobuf"
    requires.
    """
    files: list[Message] = []
    _collect(message, files)
    return b"".join(delimited(1, _file_descriptor(one)) for one in files)


def _collect(message: Message, files: list[Message]) -> None:
    for field in message.fields:
        if isinstance(field.of, Message):
            _collect(field.of, files)
    if message not in files:
        files.append(message)


def _file_descriptor(message: Message) -> bytes:
    """Return a FileDescriptorProto: name 1, package 2, dependency 3, message_type 4, syntax 12."""
    package, _, short = message.name.rpartition(".")
    parts = [delimited(1, message.file_name().encode()), delimited(2, package.encode())]
    needed: list[str] = []
    for field in message.fields:
        if isinstance(field.of, Message) and field.of.file_name() not in needed:
            needed.append(field.of.file_name())
    parts += [delimited(3, name.encode()) for name in needed]
    parts += [delimited(4, _descriptor(short, message)), delimited(12, b"proto3")]
    return b"".join(parts)


def _descriptor(short: str, message: Message) -> bytes:
    """Return a DescriptorProto: name 1, field 2, enum_type 4, oneof_decl 8 (name 1).

    Each optional field of proto3 is alone in a "oneof" named after it.
    """
    parts = [delimited(1, short.encode())]
    optional = [field for field in message.fields if field.optional]
    for field in message.fields:
        oneof = optional.index(field) if field.optional else None
        parts.append(delimited(2, _field_descriptor(message.name, field, oneof)))
    enums: list[Enumeration] = []
    for field in message.fields:
        if isinstance(field.of, Enumeration) and field.of not in enums:
            enums.append(field.of)
    parts += [delimited(4, _enum_descriptor(one)) for one in enums]
    parts += [delimited(8, delimited(1, f"_{field.name}".encode())) for field in optional]
    return b"".join(parts)


def _field_descriptor(owner: str, field: Field, oneof: int | None) -> bytes:
    """Return a FieldDescriptorProto: name 1, number 3, label 4, type 5, type_name 6.

    Optional fields also have oneof_index 9 and proto3_optional 17.
    """
    parts = [
        delimited(1, field.name.encode()),
        _number(3, field.number),
        _number(4, 3 if field.repeated else 1),
        _number(5, field.kind.value),
    ]
    if isinstance(field.of, Message):
        parts.append(delimited(6, f".{field.of.name}".encode()))
    elif isinstance(field.of, Enumeration):
        parts.append(delimited(6, f".{owner}.{field.of.name}".encode()))
    if oneof is not None:
        parts.append(_number(9, oneof) + _number(17, 1))
    return b"".join(parts)


def _enum_descriptor(enumeration: Enumeration) -> bytes:
    """Return an EnumDescriptorProto: name 1, value 2 (name 1, number 2)."""
    parts = [delimited(1, enumeration.name.encode())]
    for name, number in enumeration.values:
        parts.append(delimited(2, delimited(1, name.encode()) + _number(2, number)))
    return b"".join(parts)


# ------------------------------------------------------------------- messages from the table


def encode(message: Message, values: Mapping[str, Value]) -> bytes:
    """Encode a message, fields in the order of the table; absent ones are omitted.

    Raises:
        ValueError: a value's name is not in the table, or its type is not the table's.
    """
    unknown = [name for name in values if all(name != field.name for field in message.fields)]
    if unknown:
        known = ", ".join(field.name for field in message.fields)
        raise ValueError(f"{message.name} has no field {unknown[0]!r}; it has {known}")
    parts: list[bytes] = []
    for field in message.fields:
        if field.name not in values:
            continue
        value = values[field.name]
        if not field.repeated:
            parts.append(tag(field.number, field.kind) + _encode_one(message, field, value))
        elif not isinstance(value, Sequence) or isinstance(value, str | bytes):
            raise _wrong(message, field, value)
        elif _WIRE_TYPE.get(field.kind) == _LENGTH:
            head = tag(field.number, field.kind)
            parts += [head + _encode_one(message, field, one) for one in value]
        else:  # numbers are packed in proto3
            packed = b"".join(_encode_one(message, field, one) for one in value)
            parts.append(delimited(field.number, packed))
    return b"".join(parts)


def _wrong(message: Message, field: Field, value: Value) -> ValueError:
    kind = f"repeated {field.kind.name}" if field.repeated else field.kind.name
    return ValueError(f"{message.name}.{field.name} is {kind.lower()}, not {value!r}")


def _encode_one(message: Message, field: Field, value: Value) -> bytes:
    """Encode a value without its tag."""
    payload: bytes | None = None
    if field.kind is Kind.DOUBLE and isinstance(value, int | float):
        return _DOUBLE.pack(value)
    if field.kind is Kind.FIXED32 and isinstance(value, int):
        return _UINT32.pack(value)
    if field.kind is Kind.STRING and isinstance(value, str):
        payload = value.encode()
    elif field.kind is Kind.BYTES and isinstance(value, bytes):
        payload = value
    elif field.kind is Kind.MESSAGE and isinstance(value, Mapping):
        assert isinstance(field.of, Message)
        payload = encode(field.of, value)
    elif _WIRE_TYPE.get(field.kind, _VARINT) == _VARINT and isinstance(value, int):
        return varint(value)
    if payload is None:
        raise _wrong(message, field, value)
    return varint(len(payload)) + payload


def decode(message: Message, payload: bytes) -> dict[str, Value]:
    """Decode the fields of `payload` by name; unknown fields are skipped, as protobuf requires.

    Raises:
        ValueError: the payload ends inside a field, or a field's wire type is not the table's.
    """
    values: dict[str, Value] = {}
    known = _TABLES.get(id(message))
    if known is None or known[0] is not message:
        known = _table(message)
    fields, readers = known[1:]
    offset, end = 0, len(payload)
    while offset < end:
        key = payload[offset]
        offset += 1
        if key > 0x7F:
            key, offset = read_varint(payload, offset - 1)
        raw, offset = _read_raw(payload, offset, key & 7)
        reader = readers.get(key)
        if reader is not None:
            name, read = reader
            values[name] = raw if read is None else read(raw)
        elif key >> 3 in fields:
            field = fields[key >> 3]
            if not field.repeated or not _extend(values, field, key & 7, raw):
                wire_type = f"wire type {key & 7} at byte {offset}"
                raise ValueError(f"{message.name}.{field.name} has {wire_type}")
    return values


_Read = Callable[[int | bytes], Value]
_Table = tuple[Message, dict[int, Field], dict[int, tuple[str, _Read | None]]]
"""A message; its fields by number; by tag, names and readers of those that are not repeated."""
_TABLES: Final[dict[int, _Table]] = {}  # by id of the message
_TABLES_KEPT: Final = 256


def _table(message: Message) -> _Table:
    readers = {
        one.number << 3 | _WIRE_TYPE.get(one.kind, _VARINT): (one.name, _reader(one))
        for one in message.fields
        if not one.repeated
    }
    if len(_TABLES) >= _TABLES_KEPT:
        _TABLES.clear()
    fields = {one.number: one for one in message.fields}
    found = _TABLES[id(message)] = message, fields, readers
    return found


def _extend(values: dict[str, Value], field: Field, wire_type: int, raw: int | bytes) -> bool:
    """Add to a repeated field; return False if the wire type is not the table's.

    Numbers can be packed or single; length-delimited values are always single.
    """
    expected, read = _WIRE_TYPE.get(field.kind, _VARINT), _reader(field)
    if wire_type == expected:
        more = [raw]
    elif wire_type == _LENGTH and isinstance(raw, bytes):
        more = _unpack(expected, raw)
    else:
        return False
    held = values.get(field.name, [])
    assert isinstance(held, list)
    values[field.name] = held + [one if read is None else read(one) for one in more]
    return True


def _unpack(wire_type: int, packed: bytes) -> list[int | bytes]:
    out: list[int | bytes] = []
    offset = 0
    while offset < len(packed):
        raw, offset = _read_raw(packed, offset, wire_type)
        out.append(raw)
    return out


def _read_raw(data: bytes, offset: int, wire_type: int) -> tuple[int | bytes, int]:
    """Read a value by its wire type; return it and the offset after it."""
    if wire_type == _VARINT:
        return read_varint(data, offset)
    if wire_type == _LENGTH:
        length, offset = read_varint(data, offset)
    elif wire_type in (_FIXED_32, _FIXED_64):
        length = 4 if wire_type == _FIXED_32 else 8
    else:
        raise ValueError(f"wire type {wire_type} at byte {offset}")
    end = offset + length
    if end > len(data):
        raise ValueError(f"field of {length} bytes at byte {offset} goes beyond the end")
    return data[offset:end], end


def _reader(field: Field) -> _Read | None:
    """Return the function from a raw value to the field's; None: they are the same."""
    if isinstance(field.of, Message):
        return partial(_nested, field.of)
    return _READERS.get(field.kind)


def _nested(message: Message, raw: int | bytes) -> Value:
    assert isinstance(raw, bytes)
    return decode(message, raw)


def _signed(raw: int | bytes) -> int:
    assert isinstance(raw, int)
    return raw - (1 << 64) if raw >= 1 << 63 else raw


def _real(raw: int | bytes) -> float:
    assert isinstance(raw, bytes)
    return float(_DOUBLE.unpack(raw)[0])


def _unsigned(raw: int | bytes) -> int:
    assert isinstance(raw, bytes)
    return int(_UINT32.unpack(raw)[0])


def _text(raw: int | bytes) -> str:
    assert isinstance(raw, bytes)
    return raw.decode(errors="replace")


_READERS: Final[dict[Kind, _Read]] = {
    Kind.BOOL: bool,
    Kind.INT32: _signed,
    Kind.INT64: _signed,
    Kind.DOUBLE: _real,
    Kind.FIXED32: _unsigned,
    Kind.STRING: _text,
}  # the others are what they are on the wire
