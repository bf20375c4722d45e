"""Contents of structural records: schemas, channels, attachments."""

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

from traces import records
from traces.schema import Schema


@final
@dataclass(frozen=True, slots=True)
class Channel:
    """A topic and the encoding of its messages; `schema` is None if there is none."""

    number: int
    topic: str
    encoding: str
    schema: Schema | None
    metadata: dict[str, str]


@final
@dataclass(frozen=True, slots=True)
class Attachment:
    """A file inside the recording."""

    name: str
    media_type: str
    log_time_ns: int
    data: bytes


def schema_in(content: bytes) -> tuple[int, Schema]:
    """Parse a schema record into number and schema; ValueError or struct.error if damaged."""
    (number,) = records.UINT16.unpack_from(content)
    name, at = records.read_string(content, 2)
    encoding, at = records.read_string(content, at)
    (size,) = records.UINT32.unpack_from(content, at)
    return number, Schema(name, content[at + 4 : at + 4 + size], encoding)


def channel_in(content: bytes, schemas: Mapping[int, Schema]) -> Channel:
    """Parse a channel record; ValueError, KeyError or struct.error if damaged."""
    number, schema = struct.unpack_from("<HH", content)
    topic, at = records.read_string(content, 4)
    encoding, at = records.read_string(content, at)
    known = schemas[schema] if schema else None
    return Channel(number, topic, encoding, known, records.read_string_map(content, at))


def attachment_in(content: bytes) -> Attachment:
    """Parse an attachment record; ValueError or struct.error if damaged."""
    (time_ns,) = records.UINT64.unpack_from(content)
    name, at = records.read_string(content, 16)
    media_type, at = records.read_string(content, at)
    (size,) = records.UINT64.unpack_from(content, at)
    if size > len(content):
        raise ValueError(f"{size} bytes of data go beyond the record")
    data = content[at + 8 : at + 8 + size]
    (crc,) = records.UINT32.unpack_from(content, at + 8 + size)
    if crc not in (0, zlib.crc32(content[: at + 8 + size])):
        raise ValueError("its CRC is wrong")
    return Attachment(name, media_type, time_ns, data)
