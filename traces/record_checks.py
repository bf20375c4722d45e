"""Checks that bytes are a complete record of an MCAP file.

Any record may be damaged, but only chunks and attachments have a check sum. Other records are
checked by their structure: their strings, maps and lists must fill them exactly, which a single
wrong length prevents. Another record must begin where they end.
"""

import re
import struct
import zlib
from collections.abc import Iterator
from mmap import mmap
from typing import Final, NamedTuple, final

from traces import records
from traces.compression import CompressionError, decompress

_HEAD_SIZE: Final = records.RECORD_HEAD.size
_CHUNK_FIXED: Final = records.CHUNK_HEAD.size
_LEAST_CHUNK: Final = _CHUNK_FIXED + 4 + 8
_COMPRESSION_MAX: Final = 16  # bytes of its name
_SIZE_MAX: Final = 1 << 32  # uncompressed chunk size; more than that is damage
# Possible start of a record: a known opcode, and a length below 4 GiB.
_BEGINNING: Final = re.compile(rb"(?s)(?=[\x01-\x0f].{4}\x00{4})")
# Fields of records: a number of bytes; "s" a string or bytes with a 4-byte length; "m" a map of
# strings with such a length; "b" bytes with an 8-byte length.
_SHAPES: Final[dict[int, tuple[int | str, ...]]] = {
    records.HEADER: ("s", "s"),
    records.FOOTER: (20,),
    records.SCHEMA: (2, "s", "s", "s"),
    records.CHANNEL: (4, "s", "s", "m"),
    records.MESSAGE_INDEX: (2, "s"),
    records.CHUNK_INDEX: (32, "s", 8, "s", 16),
    records.ATTACHMENT: (16, "s", "s", "b", 4),
    records.ATTACHMENT_INDEX: (40, "s", "s"),
    records.STATISTICS: (42, "s"),
    records.METADATA: ("s", "m"),
    records.METADATA_INDEX: (16, "s"),
    records.SUMMARY_OFFSET: (17,),
    records.DATA_END: (4,),
}


class Record(NamedTuple):
    """A complete record: opcode, offset, end and content."""

    opcode: int
    offset: int
    end: int
    content: bytes


@final
class Chunk(NamedTuple):
    """A chunk's fields; `content` are its uncompressed records, verified by the CRC."""

    first_ns: int
    last_ns: int
    crc: int
    compression: str
    data: bytes
    content: bytes


def record_at(file: mmap | bytes, offset: int) -> Record | None:
    """Return the record at `offset` if it is structurally complete; chunks are not opened."""
    head = file[offset : offset + _HEAD_SIZE]
    if len(head) < _HEAD_SIZE:
        return None
    opcode, length = records.RECORD_HEAD.unpack(head)
    end = offset + _HEAD_SIZE + length
    if end > len(file) or opcode == 0:
        return None
    content = file[offset + _HEAD_SIZE : end]
    if opcode == records.CHUNK:
        is_whole = length >= _LEAST_CHUNK
    elif opcode == records.MESSAGE:
        is_whole = length >= 22
    else:
        shape = _SHAPES.get(opcode)
        is_whole = shape is not None and _fits(content, shape)
    if opcode == records.ATTACHMENT and is_whole:
        (crc,) = records.UINT32.unpack_from(content, length - 4)
        is_whole = crc in (0, zlib.crc32(content[:-4]))
    return Record(opcode, offset, end, content) if is_whole else None


def chunk_in(content: bytes) -> Chunk | None:
    """Parse the content of a chunk record; None if it is damaged.

    The length of its data follows from the end of the content, not from its length field.
    """
    fields = chunk_head(content)
    if fields is None or fields[2] > _SIZE_MAX:
        return None
    first, last, size, crc, compression, at = fields
    data = content[at:]
    try:
        inside = decompress(compression, data, size)
    except CompressionError:
        return None
    if crc and zlib.crc32(inside) != crc:
        return None
    return Chunk(first, last, crc, compression, data, inside)


def chunk_head(content: bytes) -> tuple[int, int, int, int, str, int] | None:
    """Return earliest and latest log time, size, CRC, compression and offset of the data.

    None: the content is too short for these fields.
    """
    if len(content) < _LEAST_CHUNK:
        return None
    first, last, size, crc = records.CHUNK_HEAD.unpack_from(content)
    (length,) = records.UINT32.unpack_from(content, _CHUNK_FIXED)
    if length > _COMPRESSION_MAX or _LEAST_CHUNK + length > len(content):
        return None
    at = _CHUNK_FIXED + 4
    compression = content[at : at + length].decode("ascii", "replace")
    return first, last, size, crc, compression, at + length + 8


def messages_in(content: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Yield (opcode, offset, end, log time [ns]) of each record in a chunk.

    The time is 0 for records other than messages.

    Raises:
        ValueError: a record exceeds the chunk, or the rest is not a record.
    """
    offset, size = 0, len(content)
    head = records.RECORD_HEAD.unpack_from
    while offset < size:
        if offset + _HEAD_SIZE > size:
            raise ValueError("the head of a record goes beyond the chunk")
        opcode, length = head(content, offset)
        end = offset + _HEAD_SIZE + length
        if end > size or (opcode == records.MESSAGE and length < 22):
            raise ValueError("a record goes beyond the chunk")
        time_ns = 0
        if opcode == records.MESSAGE:
            (time_ns,) = records.UINT64.unpack_from(content, offset + _HEAD_SIZE + 6)
        yield opcode, offset, end, time_ns
        offset = end


def next_record(file: mmap | bytes, offset: int) -> int | None:
    """Return the first offset >= `offset` of a record with a valid successor; None if none."""
    for found in _BEGINNING.finditer(file, offset):
        if is_followed(file, found.start()):
            return found.start()
    return None


def is_followed(file: mmap | bytes, offset: int) -> bool:
    """Return True if a complete record begins here, followed by another or by the file's end."""
    record = record_at(file, offset)
    if record is None:
        return False
    if record.opcode == records.FOOTER:
        return file[record.end : record.end + len(records.MAGIC)] == records.MAGIC
    if record.opcode == records.CHUNK and chunk_in(record.content) is not None:
        return True
    return record.end == len(file) or record_at(file, record.end) is not None


def _fits(content: bytes, shape: tuple[int | str, ...]) -> bool:
    """Return True if fields of these kinds fill the content exactly."""
    at = 0
    try:
        for part in shape:
            if isinstance(part, int):
                at += part
            elif part == "b":
                at += 8 + records.UINT64.unpack_from(content, at)[0]
            else:
                if part == "m":
                    records.read_string_map(content, at)
                at += 4 + records.UINT32.unpack_from(content, at)[0]
    except (struct.error, ValueError):
        return False
    return at == len(content)
