"""Records of an MCAP file: opcodes, encoding, parsing, and the compression of chunks.

A record is an opcode, the length of its content (8 bytes) and the content. All numbers are
little-endian. Strings and maps are preceded by their length in bytes (4 bytes). Chunks are
compressed by zstd; those of other writers also by lz4, or not at all.

Source: mcap.dev/spec.
"""

import struct
import sys
import zlib
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, final

import zstandard

from motorhil.frozen import frozen
from motorhil.traces.files import MEMORY_MAX
from motorhil.traces.schema import Schema

MAGIC: Final = b"\x89MCAP0\r\n"

HEADER: Final = 0x01
FOOTER: Final = 0x02
SCHEMA: Final = 0x03
CHANNEL: Final = 0x04
MESSAGE: Final = 0x05
CHUNK: Final = 0x06
MESSAGE_INDEX: Final = 0x07
CHUNK_INDEX: Final = 0x08
ATTACHMENT: Final = 0x09
ATTACHMENT_INDEX: Final = 0x0A
STATISTICS: Final = 0x0B
METADATA: Final = 0x0C
METADATA_INDEX: Final = 0x0D
SUMMARY_OFFSET: Final = 0x0E
DATA_END: Final = 0x0F

RECORD_HEAD: Final = struct.Struct("<BQ")
"""Opcode, length of the content."""

MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
"""Opcode, length of the content (22 and the payload), channel, sequence, log and publish time."""

CHUNK_HEAD: Final = struct.Struct("<QQQI")
"""Earliest and latest log time, uncompressed size and CRC; then compression, size, records."""

FOOTER_BODY: Final = struct.Struct("<QQI")
"""Start of the summary section, start of the summary offset section, CRC of the summary."""

UINT16: Final = struct.Struct("<H")
UINT32: Final = struct.Struct("<I")
UINT64: Final = struct.Struct("<Q")
_PIECE: Final = 4096  # bytes of a cut chunk to decompress at once


def is_recording(path: Path) -> bool:
    """Return True if the file is a recording; data in a pipe is not consumed."""
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def record(opcode: int, content: bytes) -> bytes:
    """Encode a record."""
    return RECORD_HEAD.pack(opcode, len(content)) + content


def string(text: str) -> bytes:
    """Encode a string with its length; bytes of file names that are not UTF-8 are escaped."""
    data = text.encode(errors="backslashreplace")
    return UINT32.pack(len(data)) + data


def string_map(values: Mapping[str, str]) -> bytes:
    """Encode a map of strings with its length."""
    data = b"".join(string(key) + string(value) for key, value in values.items())
    return UINT32.pack(len(data)) + data


def header(profile: str, library: str) -> bytes:
    """Encode the header, the first record after the magic."""
    return record(HEADER, string(profile) + string(library))


def schema(number: int, name: str, encoding: str, data: bytes) -> bytes:
    """Encode a schema and its number."""
    content = UINT16.pack(number) + string(name) + string(encoding)
    return record(SCHEMA, content + UINT32.pack(len(data)) + data)


def channel(
    number: int, schema_number: int, topic: str, encoding: str, metadata: Mapping[str, str]
) -> bytes:
    """Encode a channel and its number."""
    content = UINT16.pack(number) + UINT16.pack(schema_number) + string(topic) + string(encoding)
    return record(CHANNEL, content + string_map(metadata))


def chunk(first_ns: int, last_ns: int, size: int, crc: int, compression: str, data: bytes) -> bytes:
    """Encode a chunk; times, size and CRC are those of the uncompressed records."""
    content = CHUNK_HEAD.pack(first_ns, last_ns, size, crc) + string(compression)
    return record(CHUNK, content + UINT64.pack(len(data)) + data)


def message_index(channel: int, places: Sequence[int]) -> bytes:
    """Encode a channel's message index: log time, offset, ... in the preceding chunk."""
    packed = array("Q", places)
    if sys.byteorder == "big":
        packed.byteswap()
    data = packed.tobytes()
    return record(MESSAGE_INDEX, UINT16.pack(channel) + UINT32.pack(len(data)) + data)


def indexed_chunk(
    offset: int,
    times_ns: tuple[int, int],
    content: bytes | memoryview,
    compression: str,
    data: bytes,
    places: Mapping[int, Sequence[int]],
) -> tuple[bytes, bytes]:
    """Return a chunk with its message indexes, to be written at `offset`, and its chunk index.

    Args:
        offset: in the file.
        times_ns: earliest and latest log time in it [ns].
        content: the records.
        compression: of `data`.
        data: the compressed records.
        places: log time, offset, ... of each channel's messages; empty: no message index.
    """
    done = chunk(*times_ns, len(content), zlib.crc32(content), compression, data)
    offsets = b""
    indexes = b""
    for number, own in places.items():
        offsets += struct.pack("<HQ", number, offset + len(done) + len(indexes))
        indexes += message_index(number, own)
    index = struct.pack("<QQQQ", *times_ns, offset, len(done))
    index += UINT32.pack(len(offsets)) + offsets + UINT64.pack(len(indexes))
    index += string(compression) + struct.pack("<QQ", len(data), len(content))
    return done + indexes, record(CHUNK_INDEX, index)


def attachment_content(time_ns: int, name: str, media_type: str, data: bytes) -> bytes:
    """Encode an attachment without its final CRC; the time of creation is 0."""
    content = struct.pack("<QQ", time_ns, 0) + string(name) + string(media_type)
    return content + UINT64.pack(len(data)) + data


def attachment_index(
    offset: int, length: int, time_ns: int, data_size: int, name: str, media_type: str
) -> bytes:
    """Encode the index of an attachment."""
    content = struct.pack("<QQQQQ", offset, length, time_ns, 0, data_size)
    return record(ATTACHMENT_INDEX, content + string(name) + string(media_type))


def metadata(name: str, values: Mapping[str, str]) -> bytes:
    """Encode a named table of strings."""
    return record(METADATA, string(name) + string_map(values))


def metadata_index(offset: int, length: int, name: str) -> bytes:
    """Encode the index of a metadata record."""
    return record(METADATA_INDEX, struct.pack("<QQ", offset, length) + string(name))


def statistics(  # its parameters are the record's fields
    counts: Sequence[tuple[int, int]],
    schemas: int,
    attachments: int,
    metadata_records: int,
    chunks: int,
    first_ns: int,
    last_ns: int,
) -> bytes:
    """Encode the statistics; `counts` are (channel, messages) of every channel."""
    per_channel = b"".join(struct.pack("<HQ", *one) for one in counts)
    content = struct.pack(
        "<QHIIIIQQI",
        sum(count for _, count in counts),
        schemas,
        len(counts),
        attachments,
        metadata_records,
        chunks,
        first_ns,
        last_ns,
        len(per_channel),
    )
    return record(STATISTICS, content + per_channel)


def summary_offset(opcode: int, start: int, length: int) -> bytes:
    """Encode the offset of the summary's records of one kind."""
    return record(SUMMARY_OFFSET, struct.pack("<BQQ", opcode, start, length))


def read_string(data: bytes, offset: int) -> tuple[str, int]:
    """Return a string and the offset after it; ValueError if the data ends before it does."""
    (size,) = UINT32.unpack_from(data, offset)
    end = offset + 4 + int(size)
    if end > len(data):
        raise ValueError(f"a string of {size} bytes goes beyond the record")
    return data[offset + 4 : end].decode(errors="replace"), end


def read_string_map(data: bytes, offset: int) -> dict[str, str]:
    """Return a map of strings; ValueError if the data ends before it does."""
    (size,) = UINT32.unpack_from(data, offset)
    at = offset + 4
    end = at + size
    out: dict[str, str] = {}
    while at < end:
        key, at = read_string(data, at)
        out[key], at = read_string(data, at)
    return out


@final
@frozen
class Channel:
    """A topic and the encoding of its messages; `schema` is None if there is none."""

    number: int
    topic: str
    encoding: str
    schema: Schema | None
    metadata: dict[str, str]


@final
@frozen
class Attachment:
    """A file inside the recording."""

    name: str
    media_type: str
    log_time_ns: int
    data: bytes


def schema_in(content: bytes) -> tuple[int, Schema]:
    """Parse a schema record into number and schema; ValueError or struct.error if damaged."""
    (number,) = UINT16.unpack_from(content)
    name, at = read_string(content, 2)
    encoding, at = read_string(content, at)
    (size,) = UINT32.unpack_from(content, at)
    return number, Schema(name, content[at + 4 : at + 4 + size], encoding)


def channel_in(content: bytes, schemas: Mapping[int, Schema]) -> Channel:
    """Parse a channel record; ValueError, KeyError or struct.error if damaged."""
    number, schema = struct.unpack_from("<HH", content)
    topic, at = read_string(content, 4)
    encoding, at = read_string(content, at)
    known = schemas[schema] if schema else None
    return Channel(number, topic, encoding, known, read_string_map(content, at))


def attachment_in(content: bytes) -> Attachment:
    """Parse an attachment record; ValueError or struct.error if damaged."""
    (time_ns,) = UINT64.unpack_from(content)
    name, at = read_string(content, 16)
    media_type, at = read_string(content, at)
    (size,) = UINT64.unpack_from(content, at)
    if size > len(content):
        raise ValueError(f"{size} bytes of data go beyond the record")
    data = content[at + 8 : at + 8 + size]
    (crc,) = UINT32.unpack_from(content, at + 8 + size)
    if crc not in (0, zlib.crc32(content[: at + 8 + size])):
        raise ValueError("its CRC is wrong")
    return Attachment(name, media_type, time_ns, data)


@final
class CompressionError(Exception):
    """Compressed data is damaged, or its compression is unknown."""


def decompress(compression: str, data: bytes, size: int, memory_max: int = MEMORY_MAX) -> bytes:
    """Return the `size` uncompressed bytes of `data`.

    No more than `size` bytes are made, whatever the compressed data would become.

    Raises:
        CompressionError: the data is damaged, larger than `size` or `memory_max`, or of an
            unknown compression.
    """
    if size > memory_max:
        raise CompressionError(
            f"{size} bytes; at most {memory_max} bytes are read at once; --max-memory allows more"
        )
    try:
        if compression == "zstd":
            declared = zstandard.get_frame_parameters(data).content_size
            if size < declared < zstandard.CONTENTSIZE_UNKNOWN:  # it would be made, all the same
                raise CompressionError(f"{declared} bytes; expected {size}")
            content = zstandard.ZstdDecompressor().decompress(data, max_output_size=size or 1)
        elif compression == "lz4":
            import lz4.frame  # type: ignore[import-untyped]  # it has no types

            content = bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, size + 1))
        elif compression:
            raise CompressionError(f"{compression!r} is not a known compression")
        else:
            content = data
    except (zstandard.ZstdError, RuntimeError, EOFError, OverflowError, MemoryError) as error:
        raise CompressionError(str(error) or "its size exceeds the memory") from error
    if len(content) != size:
        raise CompressionError(f"{len(content)} bytes; expected {size}")
    return content


def salvage(compression: str, data: bytes, memory_max: int = MEMORY_MAX) -> bytes:
    """Return as much as possible of data whose end is missing; zstd yields whole blocks."""
    if not compression:
        return data
    if compression != "zstd":
        return b""
    stream = zstandard.ZstdDecompressor().decompressobj()
    out: list[bytes] = []
    size = 0
    try:
        for start in range(0, len(data), _PIECE):
            out.append(stream.decompress(data[start : start + _PIECE]))
            size += len(out[-1])
            if size > memory_max:
                break
    except zstandard.ZstdError:  # the end is not only missing but overwritten
        pass
    return b"".join(out)
