"""Recovery of recordings that were cut or damaged.

The file is read record by record. Where no record begins, or a chunk does not match its check sum,
the next record with a valid successor is searched. The bytes between are lost, and are reported
with their offset and, if known, their time. Complete chunks are copied unchanged. The first
messages of a chunk whose end is missing are salvaged. Schemas and channels in the summary have
priority, because a check sum covers them.

Any record may be damaged, but only chunks and attachments have a check sum. Other records are
checked by their structure: their strings, maps and lists must fill them exactly, which a single
wrong length prevents. Another record must begin where they end. Records are copied unchanged,
except for text that is not valid UTF-8, because other readers refuse the whole file for it.
"""

import os
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from mmap import ACCESS_READ, mmap
from typing import BinaryIO, Final, NamedTuple, final

import zstandard

from motorhil.frozen import frozen
from motorhil.traces.errors import TraceError
from motorhil.traces.files import (
    MEMORY_MAX,
    NOT_MCAP,
    refuse_pipe,
    stranger,
    unreadable,
    whole_file,
)
from motorhil.traces.mcap import records
from motorhil.traces.mcap.records import CompressionError, decompress, salvage
from motorhil.traces.mcap.writer import Summary

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
_LEVEL: Final = 1  # of compression
_NO_SCHEMA: Final = 0
_LOOSE_MAX: Final = 1 << 20
_NAMES: Final = {
    records.HEADER: "a header",
    records.SCHEMA: "a schema",
    records.CHANNEL: "a channel",
    records.CHUNK: "a chunk",
    records.MESSAGE_INDEX: "an index of messages",
    records.ATTACHMENT: "an attachment",
    records.METADATA: "metadata",
    records.DATA_END: "the end of the data",
}
_STRUCTURE: Final = (records.SCHEMA, records.CHANNEL, records.METADATA, records.ATTACHMENT)
_FOOTER_SIZE: Final = _HEAD_SIZE + records.FOOTER_BODY.size


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


def chunk_in(content: bytes, memory_max: int) -> Chunk | None:
    """Parse the content of a chunk record; None if it is damaged.

    The length of its data follows from the end of the content, not from its length field.
    """
    fields = chunk_head(content)
    if fields is None or fields[2] > _SIZE_MAX:
        return None
    first, last, size, crc, compression, at = fields
    data = content[at:]
    try:
        inside = decompress(compression, data, size, memory_max)
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
        ValueError: a record exceeds the chunk or is damaged, or the rest is not a record.
    """
    for opcode, offset, end in _records_in(content):
        time_ns = 0
        if opcode == records.MESSAGE:
            (time_ns,) = records.UINT64.unpack_from(content, offset + _HEAD_SIZE + 6)
        elif not _is_sound(opcode, content[offset + _HEAD_SIZE : end]):
            raise ValueError(f"the fields of {_NAMES[opcode]} go beyond it")
        yield opcode, offset, end, time_ns


def _is_sound(opcode: int, content: bytes) -> bool:
    """Return False for a description of messages whose fields do not fill it."""
    shape = _SHAPES[opcode] if opcode in (records.SCHEMA, records.CHANNEL) else None
    return shape is None or _fits(content, shape)


def _records_in(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, offset, end) of each record in a chunk.

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
        yield opcode, offset, end
        offset = end


def next_record(file: mmap | bytes, offset: int, memory_max: int) -> int | None:
    """Return the first offset >= `offset` of a record with a valid successor; None if none."""
    for found in _BEGINNING.finditer(file, offset):
        if is_followed(file, found.start(), memory_max):
            return found.start()
    return None


def is_followed(file: mmap | bytes, offset: int, memory_max: int) -> bool:
    """Return True if a complete record begins here, followed by another or by the file's end."""
    record = record_at(file, offset)
    if record is None:
        return False
    if record.opcode == records.FOOTER:
        return file[record.end : record.end + len(records.MAGIC)] == records.MAGIC
    if record.opcode == records.CHUNK and chunk_in(record.content, memory_max) is not None:
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


@final
class Assembly:
    """A file that is being assembled; every chunk gets a new index.

    Attributes:
        messages: number of messages so far.
        first_ns, last_ns: their earliest and latest log time; None: no messages.
    """

    def __init__(self, file: BinaryIO, indexed: bool) -> None:
        """Begin the file.

        Args:
            file: open for writing, empty; its OSError is passed on to the caller.
            indexed: True to write a message index after each chunk.
        """
        self.messages: int = 0
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self._file = file
        self._indexed = indexed
        self._offset = 0
        self._crc = 0
        self._summary = Summary()
        self._schemas: set[int] = set()
        self._channels: set[int] = set()
        self._spare: dict[tuple[int, int], bytes] = {}
        self._order: dict[int, None] = {}  # channels in order of appearance, as our writer has them
        self._put(records.MAGIC)

    def expect(self, record: Record) -> None:
        """Register a reliable schema or channel, used instead of any with the same number."""
        number = int.from_bytes(record.content[:2], "little")
        self._spare[record.opcode, number] = record.content

    def take(self, record: Record) -> None:
        """Write a schema, channel, metadata or attachment record."""
        write = {
            records.SCHEMA: self.schema,
            records.CHANNEL: self.channel,
            records.METADATA: self.metadata,
            records.ATTACHMENT: self.attachment,
        }
        write[record.opcode](record.content)

    def header(self, content: bytes) -> None:
        """Write the header; call it first, and once."""
        profile, at = records.read_string(content, 0)
        library, _ = records.read_string(content, at)
        self._put(records.header(profile, library))

    def schema(self, content: bytes) -> None:
        """Write a schema, unless its number is taken."""
        number = int.from_bytes(content[:2], "little")
        if number not in self._schemas and number != _NO_SCHEMA:
            content = self._spare.get((records.SCHEMA, number), content)
            name, at = records.read_string(content, 2)
            encoding, at = records.read_string(content, at)
            data = records.schema(number, name, encoding, content[at + 4 :])
            self._schemas.add(number)
            self._put(data)
            self._summary.schemas.append(data)

    def channel(self, content: bytes) -> None:
        """Write a channel, unless its number is taken or its schema is missing."""
        number = int.from_bytes(content[:2], "little")
        content = self._spare.get((records.CHANNEL, number), content)
        schema = int.from_bytes(content[2:4], "little")
        if schema not in self._schemas and (records.SCHEMA, schema) in self._spare:
            self.schema(self._spare[records.SCHEMA, schema])
        if number not in self._channels and (schema == _NO_SCHEMA or schema in self._schemas):
            topic, at = records.read_string(content, 4)
            encoding, at = records.read_string(content, at)
            values = records.read_string_map(content, at)
            data = records.channel(number, schema, topic, encoding, values)
            self._channels.add(number)
            self._put(data)
            self._summary.channels.append(data)
            self._summary.counts[number] = 0

    def metadata(self, content: bytes) -> None:
        """Write a named table of strings."""
        name, at = records.read_string(content, 0)
        data = records.metadata(name, records.read_string_map(content, at))
        self._summary.metadata_indexes.append(records.metadata_index(self._offset, len(data), name))
        self._put(data)

    def attachment(self, content: bytes) -> None:
        """Write an attachment."""
        (time_ns,) = records.UINT64.unpack_from(content)
        name, at = records.read_string(content, 16)
        media_type, at = records.read_string(content, at)
        (size,) = records.UINT64.unpack_from(content, at)
        data = records.record(records.ATTACHMENT, content)
        self._summary.attachment_indexes.append(
            records.attachment_index(self._offset, len(data), time_ns, size, name, media_type)
        )
        self._put(data)

    def chunk(self, chunk: Chunk) -> list[int]:
        """Write a chunk unchanged; return unknown channels, which became nameless.

        Raises:
            ValueError: the last record in it is incomplete.
        """
        places: dict[int, list[int]] = {}
        for opcode, offset, end, time_ns in messages_in(chunk.content):
            body = chunk.content[offset + 9 : end] if opcode != records.MESSAGE else b""
            if opcode == records.SCHEMA:
                self.schema(body)
            elif opcode == records.CHANNEL:
                self.channel(body)
            elif opcode == records.MESSAGE:
                number = int.from_bytes(chunk.content[offset + 9 : offset + 11], "little")
                places.setdefault(number, []).extend((time_ns, offset))
        nameless = [number for number in places if number not in self._channels]
        nameless = [number for number in nameless if not self._name(number)]
        for number in nameless:
            topic = records.string(f"/channel/{number}")
            head = number.to_bytes(2, "little") + bytes(2)
            self.channel(head + topic + records.string("") + bytes(4))
        self._put_chunk(chunk, places)
        return nameless

    def _name(self, number: int) -> bool:
        """Write a channel that is only known from `expect`; return True if it is known."""
        if (records.CHANNEL, number) in self._spare:
            self.channel(self._spare[records.CHANNEL, number])
        return number in self._channels

    def content(self, content: bytes) -> list[int]:
        """Write message records as a chunk of their own, like `chunk`, after their descriptions."""
        times: list[int] = []
        messages: list[bytes] = []
        for opcode, offset, end, time_ns in messages_in(content):
            if opcode == records.MESSAGE:
                times.append(time_ns)
                messages.append(content[offset:end])
            elif opcode == records.SCHEMA:
                self.schema(content[offset + _HEAD_SIZE : end])
            elif opcode == records.CHANNEL:
                self.channel(content[offset + _HEAD_SIZE : end])
        if not messages:
            return []
        content = b"".join(messages)
        data = zstandard.ZstdCompressor(level=_LEVEL).compress(content)
        return self.chunk(Chunk(min(times), max(times), zlib.crc32(content), "zstd", data, content))

    def end(self) -> None:
        """Complete the file."""
        for opcode, number in self._spare:
            if opcode == records.CHANNEL:
                self._name(number)
        for data in self._summary.ending(self._offset, self._crc):
            self._put(data)

    def _put_chunk(self, chunk: Chunk, places: dict[int, list[int]]) -> None:
        times = [time for of_channel in places.values() for time in of_channel[::2]]
        first, last = (min(times), max(times)) if times else (chunk.first_ns, chunk.last_ns)
        self._order |= dict.fromkeys(places)
        ordered = {number: places[number] for number in self._order if number in places}
        record, index = records.indexed_chunk(
            *(self._offset, (first, last), chunk.content, chunk.compression, chunk.data),
            ordered if self._indexed else {},
        )
        self._put(record)
        counts = {number: len(of_channel) // 2 for number, of_channel in places.items()}
        if times:
            self._summary.add_chunk(index, first, last, counts)
            self.messages += len(times)
            self.first_ns = first if self.first_ns is None else min(first, self.first_ns)
            self.last_ns = last if self.last_ns is None else max(last, self.last_ns)

    def _put(self, data: bytes) -> None:
        self._file.write(data)
        self._offset += len(data)
        self._crc = zlib.crc32(data, self._crc)


@final
@frozen
class Loss:
    """Bytes that are not a complete record.

    Attributes:
        offset, size: place in the file [bytes].
        what: description in words.
        first_ns, last_ns: log times of the messages in it; None: unknown.
        messages: True if it can have contained messages.
    """

    offset: int
    size: int
    what: str
    first_ns: int | None = None
    last_ns: int | None = None
    messages: bool = True

    def __str__(self) -> str:
        told = f"{self.size} bytes at byte {self.offset} are lost: {self.what}"
        if not self.size:
            told = f"cut at byte {self.offset}: {self.what}"
        if self.first_ns is not None and self.last_ns is not None:
            told += f", {self.first_ns / 1e9:.3f} s to {self.last_ns / 1e9:.3f} s"
        return told if self.messages else f"{told}; no message was in it"


@final
@dataclass(slots=True)
class Recovery:
    """The result of a recovery.

    Attributes:
        messages: number of messages in the new file.
        salvaged: number of those from a chunk whose end is missing.
        expected: number of messages according to the old file; None: not stated.
        first_ns, last_ns: their earliest and latest log time.
        losses: in file order.
        nameless: channels known only from their messages; now named `/channel/N`.
    """

    messages: int = 0
    salvaged: int = 0
    expected: int | None = None
    first_ns: int | None = None
    last_ns: int | None = None
    losses: list[Loss] = field(default_factory=list)
    nameless: list[int] = field(default_factory=list)

    @property
    def lost_bytes(self) -> int:
        """The number of bytes of all losses."""
        return sum(loss.size for loss in self.losses)

    @property
    def lost_ns(self) -> int:
        """The sum of the time between first and last message of each loss, if known."""
        return sum((loss.last_ns or 0) - (loss.first_ns or 0) for loss in self.losses)


def recover(
    source: str, target: str, overwrite: bool = False, memory_max: int = MEMORY_MAX
) -> Recovery:
    """Write a complete recording `target` with everything recoverable from `source`.

    Args:
        source: the damaged file.
        target: the file to write.
        overwrite: True to replace an existing target.
        memory_max: the most bytes that are made of a chunk; a larger one is lost.

    Raises:
        TraceError: the source cannot be read or is not an MCAP file; the target cannot be written,
            or exists and must not be overwritten.
    """
    with suppress(OSError):
        if os.path.samefile(source, target):
            raise TraceError(target, "is the source itself", remedy="name another file")
    if os.path.exists(target) and not overwrite:
        raise TraceError(target, "exists", remedy="name another file, or say --force")
    refuse_pipe(source)
    try:
        with open(source, "rb") as file:
            if not os.fstat(file.fileno()).st_size:
                raise TraceError(source, "is empty", remedy="there is nothing to recover")
            with mmap(file.fileno(), 0, access=ACCESS_READ) as data:
                if data[: len(records.MAGIC)] != records.MAGIC:
                    what, remedy = stranger(data[: 1 << 16]) or NOT_MCAP
                    raise TraceError(source, what, remedy=remedy)
                with whole_file(target, "free space there, or name another place") as out:
                    return recover_bytes(data, out, memory_max)
    except OSError as error:
        raise unreadable(source, error) from error


def recover_bytes(data: mmap | bytes, out: BinaryIO, memory_max: int = MEMORY_MAX) -> Recovery:
    """Recover a file's bytes (with their magic) into an open file, like `recover`."""
    return _Walk(data, out, memory_max).run()


@final
class _Walk:
    """One pass through a damaged file."""

    def __init__(self, data: mmap | bytes, out: BinaryIO, memory_max: int) -> None:
        self._data = data
        self._memory_max = memory_max
        self._size = len(data)
        self._summary = list(_summary_of(data))
        self._spans = [_chunk_span(r) for r in self._summary if r.opcode == records.CHUNK_INDEX]
        self._assembly = Assembly(out, _is_indexed(data))
        self._done = Recovery()
        self._loose: list[bytes] = []
        self._loose_size = 0
        self._has_chunks = False
        self._data_ended = False
        self._ended = False

    def run(self) -> Recovery:
        done, assembly = self._done, self._assembly
        head = record_at(self._data, len(records.MAGIC))
        is_header = head is not None and head.opcode == records.HEADER
        assembly.header(head.content if head is not None and is_header else bytes(8))
        for record in self._summary:
            if record.opcode in (records.SCHEMA, records.CHANNEL):
                assembly.expect(record)
            elif record.opcode == records.STATISTICS:
                (done.expected,) = records.UINT64.unpack_from(record.content)
        offset = len(records.MAGIC)
        while offset < self._size and not self._ended:
            offset = self._step(offset)
        self._end_loose()
        if not self._ended:
            lost = 0 if not done.losses else done.losses[-1].offset + done.losses[-1].size
            if lost < self._size:
                what = "the file ends without its ending"
                self._lose(self._size, self._size, what, not self._data_ended)
        assembly.end()
        done.messages = assembly.messages
        done.first_ns, done.last_ns = assembly.first_ns, assembly.last_ns
        return done

    def _step(self, offset: int) -> int:
        """Take the record at `offset`, or report it lost; return the offset to continue at."""
        found = self._chunk_at(offset)
        if found is not None:
            chunk, end = found
            self._end_loose()
            self._take_chunk(chunk, offset, end)
            return end
        record = record_at(self._data, offset)
        if record is None or record.opcode == records.CHUNK:
            return self._skip(offset)
        if record.opcode == records.MESSAGE:
            if (
                self._spans or self._has_chunks
            ):  # a writer of chunks writes no messages outside them
                return self._skip(offset)
            self._take_loose(record)
        elif record.opcode in _STRUCTURE:
            if not self._data_ended:
                self._end_loose()
                self._assembly.take(record)
        elif record.opcode == records.DATA_END:
            self._data_ended = True
        elif record.opcode == records.FOOTER:
            self._ended = True
            behind = record.end + len(records.MAGIC)
            if self._data[record.end : behind] != records.MAGIC:
                self._lose(record.end, self._size, "the closing magic is incomplete", False)
            elif behind < self._size:
                self._lose(behind, self._size, "bytes after the end", False)
        return record.end

    # --------------------------------------------------------------------------------- chunks

    def _chunk_at(self, offset: int) -> tuple[Chunk, int] | None:
        """Return a chunk that matches its check sum, and its end, whatever its head says.

        Thus a wrong opcode, or two contradictory lengths, cost nothing.
        """
        data = self._data
        start = offset + records.RECORD_HEAD.size
        head = data[offset : start + records.CHUNK_HEAD.size + 4]
        if len(head) < 9 + records.CHUNK_HEAD.size + 4:
            return None
        opcode, length = records.RECORD_HEAD.unpack_from(head)
        (name_size,) = records.UINT32.unpack_from(head, len(head) - 4)
        at = start + records.CHUNK_HEAD.size + 4 + min(name_size, self._size)
        stored = int.from_bytes(data[at : at + 8], "little")
        ends = {start + length, at + 8 + stored}
        for end in sorted(ends):  # a wrong end that is too large only includes bytes after the data
            chunk = chunk_in(data[start:end], self._memory_max) if end <= self._size else None
            if chunk is not None and (chunk.crc or (opcode == records.CHUNK and len(ends) == 1)):
                return chunk, end
        return None

    def _take_chunk(self, chunk: Chunk, offset: int, end: int) -> None:
        self._has_chunks = True
        try:
            self._done.nameless += self._assembly.chunk(chunk)
        except ValueError as error:
            whole = _whole_records(chunk.content)
            self._done.nameless += self._assembly.content(whole)
            self._lose(offset, end, f"a part of a chunk's content ({error})")

    def _take_loose(self, record: Record) -> None:
        """Collect messages outside chunks into new chunks."""
        data = records.record(record.opcode, record.content)
        self._loose.append(data)
        self._loose_size += len(data)
        if self._loose_size >= _LOOSE_MAX:
            self._end_loose()

    def _end_loose(self) -> None:
        if self._loose:
            self._done.nameless += self._assembly.content(b"".join(self._loose))
            self._loose, self._loose_size = [], 0

    # --------------------------------------------------------------------------------- losses

    def _skip(self, offset: int) -> int:
        """Report the bytes at `offset` as lost, or salvage them; return the next offset."""
        data = self._data
        head = data[offset : offset + records.RECORD_HEAD.size]
        stated, opcode = self._size + 1, 0
        if len(head) == records.RECORD_HEAD.size:
            opcode, length = records.RECORD_HEAD.unpack(head)
            stated = offset + len(head) + length
        if stated < self._size and record_at(data, stated) is not None:
            end = stated
        else:
            end = next_record(data, offset + 1, self._memory_max) or self._size
        is_cut = end == self._size < stated
        if is_cut and opcode == records.CHUNK and self._salvage(offset):
            return end
        name = _NAMES.get(opcode, "")
        what = "not a complete record"
        if is_cut and name:
            what = f"{name} whose end is missing"
        elif opcode == records.CHUNK:
            what = "a damaged chunk"
            fields = chunk_head(data[offset + len(head) : end])
            if fields is not None and self._memory_max < fields[2] <= _SIZE_MAX:
                what = f"a damaged chunk, or {fields[2]} bytes; --max-memory allows more"
        may_hold = not self._data_ended and not (is_cut and name and opcode != records.CHUNK)
        self._lose(offset, end, what, may_hold)
        return end

    def _salvage(self, offset: int) -> bool:
        """Salvage the first messages of a chunk whose end is missing; False for other data."""
        start = offset + records.RECORD_HEAD.size
        there = self._data[start:]
        if len(there) < records.CHUNK_HEAD.size + 4:
            return False
        first, last, _, _ = records.CHUNK_HEAD.unpack_from(there)
        try:
            compression, at = records.read_string(there, records.CHUNK_HEAD.size)
        except ValueError:
            return False
        content = _whole_records(salvage(compression, there[at + 8 :], self._memory_max))
        before = self._assembly.messages
        self._end_loose()
        if content:
            self._done.nameless += self._assembly.content(content)
        saved = self._assembly.messages - before
        self._done.salvaged += saved
        if saved:
            first = max(time_ns for _, _, _, time_ns in messages_in(content))
        what = f"the end of a chunk, of which {saved} messages were saved"
        self._done.losses.append(Loss(offset, self._size - offset, what, first, last))
        return True

    def _lose(self, offset: int, end: int, what: str, messages: bool = True) -> None:
        """Report these bytes as lost, with the times of the chunks in them."""
        spans = [span for place, span in self._spans if offset <= place < end]
        fields = chunk_head(self._data[offset + records.RECORD_HEAD.size : end])
        if not spans and messages and fields is not None and fields[0] <= fields[1]:
            spans = [(fields[0], fields[1])]
        first = min((first for first, _ in spans), default=None)
        last = max((last for _, last in spans), default=None)
        if self._spans and not spans:
            messages = False  # the summary lists every chunk, and none of them is here
        self._done.losses.append(Loss(offset, end - offset, what, first, last, messages))


def _whole_records(content: bytes) -> bytes:
    """Return the complete and sound records of a chunk."""
    whole: list[bytes] = []
    with suppress(ValueError):
        for opcode, offset, end in _records_in(content):
            if _is_sound(opcode, content[offset + _HEAD_SIZE : end]):
                whole.append(content[offset:end])
    return b"".join(whole)


def _summary_of(data: mmap | bytes) -> Iterator[Record]:
    """Yield the records of the summary, if there is one with a correct check sum."""
    start = len(data) - len(records.MAGIC) - _FOOTER_SIZE
    footer = record_at(data, start) if start > 0 else None
    if footer is None or footer.opcode != records.FOOTER:
        return
    offset, _, crc = records.FOOTER_BODY.unpack(footer.content)
    if not 0 < offset <= start or crc != zlib.crc32(data[offset : footer.end - 4]):
        return
    while offset < start:
        record = record_at(data, offset)
        if record is None:
            return
        yield record
        offset = record.end


def _chunk_span(index: Record) -> tuple[int, tuple[int, int]]:
    """Return a chunk's offset, and its earliest and latest log time, from a chunk index."""
    first, last, offset = (int.from_bytes(index.content[k : k + 8], "little") for k in (0, 8, 16))
    return offset, (first, last)


def _is_indexed(data: mmap | bytes) -> bool:
    """Return True if a message index follows the first chunk."""
    offset = len(records.MAGIC)
    record = record_at(data, offset)
    while record is not None and record.opcode != records.CHUNK:
        record = record_at(data, record.end)
    behind = record_at(data, record.end) if record is not None else None
    return behind is None or behind.opcode == records.MESSAGE_INDEX
