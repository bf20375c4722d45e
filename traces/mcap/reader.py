"""Reader for recordings, complete and cut ones, of our writer and others.

Opening reads only the heads of records. So every file is read in the same way, even if it ends in
the middle of a chunk. The summary of a complete file, if its CRC is correct, lets the reader skip
chunks and their indexes. Messages are returned in the order in which they were written.

Source: mcap.dev/spec.
"""

import os
import struct
import zlib
from collections.abc import Collection, Iterator
from typing import BinaryIO, Final, NamedTuple, Self, final

from motorhil.frozen import frozen
from motorhil.traces.errors import TraceError
from motorhil.traces.files import MEMORY_MAX, NOT_MCAP, open_content, refuse_pipe, stranger
from motorhil.traces.mcap import records
from motorhil.traces.mcap.records import (
    Attachment,
    Channel,
    CompressionError,
    attachment_in,
    channel_in,
    decompress,
    salvage,
    schema_in,
)
from motorhil.traces.schema import Schema

TraceMessage = tuple[Channel, int, bytes]
"""(channel, log time [ns], payload)."""

_FOOT: Final = records.RECORD_HEAD.size + records.FOOTER_BODY.size + len(records.MAGIC)
_PLACE: Final = struct.Struct("<QQQQ")
_SIZES: Final = struct.Struct("<QQ")
_UNLIKELY: Final = 1 << 28  # bytes: a summary beyond this is not worth reading
_NAMES: Final = {
    records.HEADER: "header",
    records.FOOTER: "footer",
    records.SCHEMA: "schema",
    records.CHANNEL: "channel",
    records.MESSAGE: "message",
    records.CHUNK: "chunk",
    records.ATTACHMENT: "attachment",
    records.METADATA: "metadata",
    records.DATA_END: "data end",
}
_STRUCTURE: Final = (
    records.HEADER,
    records.SCHEMA,
    records.CHANNEL,
    records.ATTACHMENT,
    records.METADATA,
)


@final
@frozen
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


@final
@frozen
class Cut:
    """A premature end of a file: the bytes from `offset` on are not a complete record.

    Attributes:
        offset: the offset of the first byte.
        size: the number of bytes.
        reason: the reason in words.
        messages_missing: False if only the parts after all messages are lost.
    """

    offset: int
    size: int
    reason: str
    messages_missing: bool

    def __str__(self) -> str:
        rest = "" if self.messages_missing else "; no message is missing"
        return f"cut at byte {self.offset}: {self.reason}, {self.size} bytes are left of it{rest}"


def read_trace(path: str | os.PathLike[str], memory_max: int = MEMORY_MAX) -> "Trace":
    """Open a recording; `memory_max` bounds the bytes of an uncompressed chunk.

    Raises:
        TraceError: the file cannot be read, is not an MCAP file, or is damaged before its first
            chunk.
    """
    name = os.fspath(path)
    refuse_pipe(name)
    file = open_content(name, memory_max=memory_max)
    try:
        return Trace(name, file, memory_max)
    except BaseException:
        file.close()
        raise


@final
class Trace:
    """An open recording; a context manager that closes it.

    Attributes:
        path: the file.
        library: name of the writer.
        metadata: tables of strings by name.
        attachments: in the order in which they were written.
        channels: by number. Those of other writers can become known only while messages are read.
        cut: where the file ends prematurely; None: it is complete.
        salvaged: messages that `messages` found in the chunk that was cut.
    """

    def __init__(self, path: str, file: BinaryIO, memory_max: int = MEMORY_MAX) -> None:
        """Scan an open file; use `read_trace` instead."""
        self.path = path
        self.library: str = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: list[Attachment] = []
        self.channels: dict[int, Channel] = {}
        self.cut: Cut | None = None
        self.salvaged: int = 0
        self._file = file
        self._memory_max = memory_max
        self._schemas: dict[int, Schema] = {}
        self._chunks: list[Chunk] = []
        self._told = 0  # chunks already returned by `more_messages`
        self._scanned = 0  # end of the last complete record
        self._data_ended = False
        self._size = file.seek(0, os.SEEK_END)
        self._scan()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def span_ns(self) -> tuple[int, int] | None:
        """Return the earliest and latest log time from the heads of chunks; None without messages.

        The times of a chunk that was cut are those in its head.
        """
        if not self._chunks:
            return None
        return (
            min(chunk.first_ns for chunk in self._chunks),
            max(chunk.last_ns for chunk in self._chunks),
        )

    def messages(
        self,
        topics: Collection[str] | None = None,
        from_ns: int | None = None,
        to_ns: int | None = None,
    ) -> Iterator[TraceMessage]:
        """Yield messages in the order in which they were written.

        A cut chunk yields as many messages as possible; `salvaged` then counts them.

        Args:
            topics: the topics to read; None: all.
            from_ns: log time, inclusive; None: from the beginning.
            to_ns: log time, exclusive; None: to the end.

        Raises:
            TraceError: a chunk is damaged. The messages before it are good.
        """
        self.salvaged = 0
        all_ = topics is None and from_ns is None and to_ns is None
        for chunk in self._chunks:
            if _is_outside(chunk, from_ns, to_ns):
                continue
            if all_ and chunk.whole:
                yield from self._in_chunk(chunk)
                continue
            for message in self._in_chunk(chunk):
                if not chunk.whole:
                    self.salvaged += 1
                channel, time_ns, _ = message
                if (
                    (topics is None or channel.topic in topics)
                    and (from_ns is None or time_ns >= from_ns)
                    and (to_ns is None or time_ns < to_ns)
                ):
                    yield message

    def contents(
        self, from_ns: int | None = None, to_ns: int | None = None
    ) -> Iterator[tuple[bytes, Iterator[TraceMessage]]]:
        """Yield the uncompressed records and the messages of each chunk, for bulk readers.

        Chunks outside the span are omitted; the others yield all their messages.

        Raises:
            TraceError: a chunk is damaged. The messages before it are good.
        """
        for chunk in self._chunks:
            if not _is_outside(chunk, from_ns, to_ns):
                data = self._content(chunk)
                yield data, self._in_chunk(chunk, data)

    def grow(self) -> bool:
        """Return True if the file has grown since it was opened, after reading its new parts.

        Raises:
            TraceError: the file has become shorter, or its new part is damaged.
        """
        size = self._file.seek(0, os.SEEK_END)
        if size < self._size:
            raise TraceError(self.path, "has become shorter: it was overwritten")
        if size == self._size or self.cut is None:
            return False
        self._size = size
        if self._chunks and not self._chunks[-1].whole:
            self._chunks.pop()
        self._scan()
        return True

    def more_messages(self, from_ns: int | None = None) -> Iterator[TraceMessage]:
        """Yield the messages of complete chunks not yet returned that do not end before `from_ns`.

        Raises:
            TraceError: a chunk is damaged.
        """
        while self._told < len(self._chunks) and self._chunks[self._told].whole:
            chunk = self._chunks[self._told]
            self._told += 1
            if from_ns is None or chunk.last_ns >= from_ns:
                yield from self._in_chunk(chunk)

    # --------------------------------------------------------------------- from head to head

    def _scan(self) -> None:
        """Read everything except the messages; set `cut` to the end of complete records."""
        if not self._scanned:
            if self._read(0, len(records.MAGIC)) != records.MAGIC:
                what, remedy = stranger(self._read(0, 1 << 16)) or NOT_MCAP
                raise TraceError(self.path, what, remedy=remedy)
            self._scanned = len(records.MAGIC)
        self.cut = None
        offset = self._scanned
        opcode = 0
        summary = read_summary(self._file)
        for opcode, content in summary.names:  # channels inside chunks would otherwise be unknown
            self._take(opcode, content, self._size)
        while opcode != records.FOOTER:
            place = summary.places.get(offset)
            if place is not None:
                self._chunks.append(place.chunk)
                offset = self._scanned = place.end
                continue
            head = self._read(offset, records.RECORD_HEAD.size)
            name = "record" if not head else _NAMES.get(head[0], f"record of kind {head[0]:02X}h")
            if len(head) < records.RECORD_HEAD.size:
                reason = f"in the head of a {name}" if head else "before the footer"
                self.cut = Cut(offset, len(head), reason, not self._data_ended)
                return
            opcode, length = records.RECORD_HEAD.unpack(head)
            end = offset + len(head) + length
            if opcode == 0:
                left = self._size - offset
                self.cut = Cut(offset, left, "no record begins there", not self._data_ended)
                return
            if opcode == records.CHUNK:
                self._add_chunk(offset, end)
            if end > self._size:
                left = self._size - offset
                reason = f"in a {name} of {end - offset} bytes"
                self.cut = Cut(offset, left, reason, not self._data_ended)
                return
            if opcode == records.MESSAGE:
                self._add_loose(offset, end)
            elif opcode in _STRUCTURE:
                self._take(opcode, self._read(offset + 9, length), offset)
            self._data_ended = self._data_ended or opcode == records.DATA_END
            offset = end
            if opcode != records.FOOTER:  # after the footer the closing magic is checked again
                self._scanned = end
        if self._read(offset, len(records.MAGIC)) != records.MAGIC:
            self.cut = Cut(offset, self._size - offset, "in the closing magic", False)

    def _read(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes."""
        self._file.seek(offset)
        return self._file.read(size)

    def _add_chunk(self, offset: int, end: int) -> None:
        """Register a chunk, if its head is complete."""
        fixed = records.RECORD_HEAD.size + records.CHUNK_HEAD.size
        head = self._read(offset, fixed + 64)
        try:
            first, last, size, crc = records.CHUNK_HEAD.unpack_from(head, 9)
            compression, at = records.read_string(head, fixed)
            (stored,) = records.UINT64.unpack_from(head, at)
        except (struct.error, ValueError):  # cut in its head: none of it can be used
            return
        data_offset = offset + at + 8
        there = min(stored, max(0, self._size - data_offset))
        whole = end <= self._size
        self._chunks.append(
            Chunk(offset, first, last, size, crc, compression, data_offset, there, whole)
        )

    def _add_loose(self, offset: int, end: int) -> None:
        """Add a message outside any chunk to the sequence of such messages."""
        (time_ns,) = records.UINT64.unpack(self._read(offset + 15, 8))
        start, first, last = offset, time_ns, time_ns
        if len(self._chunks) > self._told:
            before = self._chunks[-1]
            if before.offset == before.data_offset and before.offset + before.data_size == offset:
                self._chunks.pop()
                start = before.offset
                first, last = min(before.first_ns, time_ns), max(before.last_ns, time_ns)
        size = end - start
        self._chunks.append(Chunk(start, first, last, size, 0, "", start, size, True))

    def _take(self, opcode: int, content: bytes, offset: int) -> None:
        """Take a record of the file's structure."""
        try:
            if opcode == records.HEADER:
                _, at = records.read_string(content, 0)
                self.library, _ = records.read_string(content, at)
            elif opcode == records.SCHEMA:
                number, schema = schema_in(content)
                self._schemas[number] = schema
            elif opcode == records.CHANNEL:
                channel = channel_in(content, self._schemas)
                self.channels[channel.number] = channel
            elif opcode == records.METADATA:
                name, at = records.read_string(content, 0)
                self.metadata[name] = records.read_string_map(content, at)
            else:
                self.attachments.append(attachment_in(content))
        except (struct.error, ValueError, KeyError) as error:
            raise TraceError(
                self.path, f"damaged {_NAMES[opcode]} record ({error})", offset=offset
            ) from error

    # ------------------------------------------------------------------------------- messages

    def _in_chunk(self, chunk: Chunk, data: bytes | None = None) -> Iterator[TraceMessage]:
        """Yield the messages of a chunk as written; `data` are its records, if already read."""
        data = self._content(chunk) if data is None else data
        end = len(data)
        unpack = records.MESSAGE_HEAD.unpack_from
        last_head = end - records.MESSAGE_HEAD.size
        offset = 0
        while offset + 9 <= end:
            if offset <= last_head:
                opcode, length, number, _, time_ns, _ = unpack(data, offset)
            else:
                opcode, length = records.RECORD_HEAD.unpack_from(data, offset)
            stop = offset + 9 + length
            if stop > end:
                break
            if opcode == records.MESSAGE and length >= 22:
                channel = self.channels.get(number)
                if channel is None:
                    raise TraceError(
                        self.path,
                        f"a message of unknown channel {number}",
                        offset=chunk.offset,
                    )
                yield channel, time_ns, data[offset + 31 : stop]
            elif opcode in (records.SCHEMA, records.CHANNEL):
                self._take(opcode, data[offset + 9 : stop], chunk.offset)
            offset = stop
        if offset != end and chunk.whole:
            raise TraceError(self.path, "a record goes beyond its chunk", offset=chunk.offset)

    def _content(self, chunk: Chunk) -> bytes:
        """Return a chunk's uncompressed records; of a cut chunk as many as possible."""
        data = self._read(chunk.data_offset, chunk.data_size)
        if not chunk.whole:
            return salvage(chunk.compression, data)
        try:
            content = decompress(chunk.compression, data, chunk.size, self._memory_max)
        except CompressionError as error:
            raise TraceError(self.path, f"damaged chunk ({error})", offset=chunk.offset) from error
        crc = chunk.crc
        if crc is None:
            head = self._read(chunk.offset + records.RECORD_HEAD.size, records.CHUNK_HEAD.size)
            crc = records.CHUNK_HEAD.unpack(head)[3]
        if crc and zlib.crc32(content) != crc:
            raise TraceError(
                self.path,
                f"damaged chunk (CRC {zlib.crc32(content):08X}h; expected {crc:08X}h)",
                offset=chunk.offset,
                remedy=f"all before {chunk.first_ns / 1e9:.3f} s is good",
            )
        return content


def _is_outside(chunk: Chunk, from_ns: int | None, to_ns: int | None) -> bool:
    """Return True if the chunk has no message in this span; never for a cut chunk."""
    return chunk.whole and (
        (from_ns is not None and chunk.last_ns < from_ns)
        or (to_ns is not None and chunk.first_ns >= to_ns)
    )


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
