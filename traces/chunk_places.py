"""Chunks and channels of a complete recording, read from its summary.

Source: mcap.dev/spec, summary section and footer.
"""

import os
import struct
import zlib
from dataclasses import dataclass
from typing import BinaryIO, Final, NamedTuple, final

from traces import records

_FOOT: Final = records.RECORD_HEAD.size + records.FOOTER_BODY.size + len(records.MAGIC)
_PLACE: Final = struct.Struct("<QQQQ")
_SIZES: Final = struct.Struct("<QQ")
_UNLIKELY: Final = 1 << 28  # bytes: a summary beyond this is not worth reading


@final
@dataclass(frozen=True, slots=True)
class Chunk:
    """Place and header of a chunk, or of uncompressed messages outside any chunk.

    `size` is the uncompressed size of the records; `crc` is None until its head has been read.
    """

    offset: int
    first_ns: int
    last_ns: int
    size: int
    crc: int | None
    compression: str
    data_offset: int
    data_size: int
    whole: bool


class ChunkPlace(NamedTuple):
    """A chunk, and the offset after its message indexes."""

    chunk: Chunk
    end: int


class Summary(NamedTuple):
    """Chunks by their offsets; schemas and channels, as (opcode, content)."""

    places: dict[int, ChunkPlace]
    names: list[tuple[int, bytes]]


def read_summary(file: BinaryIO) -> Summary:
    """Read the summary; return an empty one if there is none with a correct CRC."""
    nothing = Summary({}, [])
    size = file.seek(0, os.SEEK_END)
    if size < _FOOT:
        return nothing
    file.seek(size - _FOOT)
    foot = file.read(_FOOT)
    head = records.RECORD_HEAD.pack(records.FOOTER, records.FOOTER_BODY.size)
    if not foot.startswith(head) or not foot.endswith(records.MAGIC):
        return nothing
    start, _, crc = records.FOOTER_BODY.unpack_from(foot, len(head))
    length = size - _FOOT - start
    if not start or not crc or not 0 < length < _UNLIKELY:
        return nothing
    file.seek(start)
    summary = file.read(length)
    if zlib.crc32(foot[: len(head) + 16], zlib.crc32(summary)) != crc:
        return nothing
    found, at = Summary({}, []), 0
    try:
        while at < len(summary):
            opcode, length = records.RECORD_HEAD.unpack_from(summary, at)
            at += records.RECORD_HEAD.size
            content = summary[at : at + length]
            if opcode == records.CHUNK_INDEX:
                place = _place(content, start)
                found.places[place.chunk.offset] = place
            elif opcode in (records.SCHEMA, records.CHANNEL):
                found.names.append((opcode, content))
            at += length
    except (struct.error, ValueError):
        return nothing
    return found


def _place(content: bytes, limit: int) -> ChunkPlace:
    """Parse a chunk index. Raises struct.error or ValueError if it is damaged."""
    first_ns, last_ns, offset, length = _PLACE.unpack_from(content)
    (offsets,) = records.UINT32.unpack_from(content, _PLACE.size)
    at = _PLACE.size + 4 + offsets
    (indexes,) = records.UINT64.unpack_from(content, at)
    compression, at = records.read_string(content, at + 8)
    stored, size = _SIZES.unpack_from(content, at)
    data_offset = (
        offset + records.RECORD_HEAD.size + records.CHUNK_HEAD.size + 12 + len(compression.encode())
    )
    end = offset + length + indexes
    if data_offset + stored != offset + length or end > limit:
        raise ValueError("a chunk index that fits no chunk")
    chunk = Chunk(
        offset, first_ns, last_ns, size, None, compression, data_offset, stored, whole=True
    )
    return ChunkPlace(chunk, end)
