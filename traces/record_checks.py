"""Whether bytes are a whole record of an MCAP file, looked at as if each might be damaged.

Only chunks and attachments carry a check sum. Of the others it can be asked whether their strings,
maps and lists fill them exactly, which one wrong length never leaves so; and whether another record
begins where they end.
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
_SIZE_MAX: Final = 1 << 32  # of a chunk, uncompressed: more than that is damage
# What may begin a record: a known opcode, and a length below 4 GiB.
_BEGINNING: Final = re.compile(rb"(?s)(?=[\x01-\x0f].{4}\x00{4})")
# Fields of records: a number of bytes, or "s" a string or bytes with their length (4 bytes) before
# them, "m" a map of strings so, "b" bytes with a length of 8 bytes.
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
    """A record that was found whole: where, what, and what is in it."""

    opcode: int
    offset: int
    end: int
    content: bytes


@final
class Chunk(NamedTuple):
    """A chunk's fields; `content` are the records in it, uncompressed and as its CRC says."""

    first_ns: int
    last_ns: int
    crc: int
    compression: str
    data: bytes
    content: bytes


def record_at(file: mmap | bytes, offset: int) -> Record | None:
    """The record that begins here, if it is whole by its own measure; chunks are not opened."""
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
    """What a chunk record with this content holds; None: it is damaged.

    How long its data are is taken from where the content ends, not from its own word.
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
    """(earliest and latest log time, size, CRC, compression, offset of the data).

    None: that does not fit in.
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
    """(opcode, offset, end, log time [ns], 0 if it is no message) of each whole record in a chunk.

    Raises:
        ValueError: a record goes beyond the end; or what is left is no record.
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
    """Where a record begins at `offset` or later that another one follows; None: nowhere."""
    for found in _BEGINNING.finditer(file, offset):
        if is_followed(file, found.start()):
            return found.start()
    return None


def is_followed(file: mmap | bytes, offset: int) -> bool:
    """Whether a whole record begins here, and where it ends another one, or the file ends so."""
    record = record_at(file, offset)
    if record is None:
        return False
    if record.opcode == records.FOOTER:
        return file[record.end : record.end + len(records.MAGIC)] == records.MAGIC
    if record.opcode == records.CHUNK and chunk_in(record.content) is not None:
        return True
    return record.end == len(file) or record_at(file, record.end) is not None


def _fits(content: bytes, shape: tuple[int | str, ...]) -> bool:
    """Whether fields of these kinds fill the content exactly."""
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
