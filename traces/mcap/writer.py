"""Writer for recordings: MCAP files that stay readable wherever they are cut.

Everything a reader needs precedes its use, complete and uncompressed: schemas, channels, metadata,
attachments. Messages are stored in chunks (zstd, CRC). A chunk ends with each second of log time,
or at 1 MiB, and is passed to the operating system at once, in one piece. However the program ends,
the file is readable up to its last second. The summary at the end makes it a complete MCAP file for
every other reader.

A message index follows each chunk. It is two thirds of the file, and our own reader does not use
it. Without it, @mcap/core (and so Foxglove) refuses the file, and mcap for Python before 1.6 finds
no message in it. A compact recording omits it and has a third of the size.

The writer reads no clock: the caller passes all log times.
"""

import io
import os
import zlib
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from operator import itemgetter
from typing import BinaryIO, Final, Self, final

import zstandard

from motorhil.traces.errors import TraceError
from motorhil.traces.files import create, let_go, reason
from motorhil.traces.mcap import records
from motorhil.traces.mcap.chunk import ChunkBuffer, Entry
from motorhil.traces.schema import Direction, Schema

CHUNK_NS: Final = 1_000_000_000
CHUNK_BYTES: Final = 1 << 20
_SLICE: Final = 4096  # messages packed at once; limits the excess of a chunk over CHUNK_BYTES
_BATCH: Final = 256  # chunk indexes compressed together; more of them did not shrink further
_COMPRESSION: Final = "zstd"
_LEVEL: Final = 1  # level 3 did not shrink the demo's frames, and took 1.5 times as long
_LIBRARY: Final = "motorhil"
_time_of: Final = itemgetter(1)


@final
class ChunkIndexes:
    """The chunk indexes of a recording, compressed: one a second, for days.

    Attributes:
        count: number of records.
    """

    def __init__(self) -> None:
        self.count: int = 0
        self._batches: list[bytes] = []
        self._open: list[bytes] = []

    def append(self, index: bytes) -> None:
        """Add a record."""
        self.count += 1
        self._open.append(index)
        if len(self._open) == _BATCH:
            self._batches.append(zlib.compress(b"".join(self._open)))
            self._open.clear()

    def __iter__(self) -> Iterator[bytes]:
        """Yield the records in order, a batch of them at once."""
        yield from map(zlib.decompress, self._batches)
        yield b"".join(self._open)


@final
class Summary:
    """Records for the summary, in the order in which their subjects were written.

    Attributes:
        schemas, channels, attachment_indexes, metadata_indexes: records.
        chunk_indexes: records, compressed.
        counts: messages by channel.
        first_ns, last_ns: earliest and latest log time; first_ns is None without messages.
    """

    def __init__(self) -> None:
        self.schemas: list[bytes] = []
        self.channels: list[bytes] = []
        self.counts: dict[int, int] = {}
        self.chunk_indexes: ChunkIndexes = ChunkIndexes()
        self.attachment_indexes: list[bytes] = []
        self.metadata_indexes: list[bytes] = []
        self.first_ns: int | None = None
        self.last_ns: int = 0

    def add_chunk(
        self, index: bytes, first_ns: int, last_ns: int, counts: Mapping[int, int]
    ) -> None:
        """Add a chunk: its index, times, and messages by channel."""
        self.chunk_indexes.append(index)
        for channel, count in counts.items():
            self.counts[channel] = self.counts.get(channel, 0) + count
        self.first_ns = first_ns if self.first_ns is None else min(first_ns, self.first_ns)
        self.last_ns = max(last_ns, self.last_ns)

    def ending(self, offset: int, crc: int) -> Iterator[bytes]:
        """Yield everything after the last chunk: data end, summary, offsets, footer, magic.

        Args:
            offset: of the end of the data.
            crc: of everything before it.
        """
        data_end = records.record(records.DATA_END, records.UINT32.pack(crc))
        yield data_end
        start = at = offset + len(data_end)
        statistics = records.statistics(
            list(self.counts.items()),
            len(self.schemas),
            len(self.attachment_indexes),
            len(self.metadata_indexes),
            self.chunk_indexes.count,
            self.first_ns or 0,
            self.last_ns,
        )
        crc = 0
        offsets = b""
        for opcode, group in (
            (records.SCHEMA, self.schemas),
            (records.CHANNEL, self.channels),
            (records.STATISTICS, [statistics]),
            (records.CHUNK_INDEX, self.chunk_indexes),
            (records.ATTACHMENT_INDEX, self.attachment_indexes),
            (records.METADATA_INDEX, self.metadata_indexes),
        ):
            begun = at
            for data in group:
                yield data
                crc = zlib.crc32(data, crc)
                at += len(data)
            if at > begun:
                offsets += records.summary_offset(opcode, begun, at - begun)
        footer = records.RECORD_HEAD.pack(records.FOOTER, records.FOOTER_BODY.size)
        footer += records.UINT64.pack(start) + records.UINT64.pack(at)
        crc = zlib.crc32(offsets + footer, crc)
        yield offsets + footer + records.UINT32.pack(crc) + records.MAGIC


@final
class TraceWriter:
    """A recording being written; a context manager that closes it.

    Not thread-safe. After an error (TraceError) nothing more is written, and `close` does not
    raise. The parts already written stay, completed as a valid file if there is space.
    """

    def __init__(
        self,
        target: str | os.PathLike[str] | BinaryIO,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        compact: bool = False,
        chunk_ns: int = CHUNK_NS,
    ) -> None:
        """Begin the file; an existing recording of that name is overwritten.

        Args:
            target: a path, or a binary file open for writing, at its beginning.
            metadata: tables of strings by name ("run": seed, versions, ...).
            compact: True to omit the message index.
            chunk_ns: longest time in one chunk, by log times [ns].

        Raises:
            TraceError: the file cannot be written, or exists and is not a recording.
        """
        self.path: str
        self.chunk_ns: int = chunk_ns
        self.error: TraceError | None = None
        self._file: io.RawIOBase | BinaryIO
        self._owned: bool = isinstance(target, str | os.PathLike)
        if isinstance(target, str | os.PathLike):
            self.path = os.fspath(target)
            self._file = create(self.path, records.MAGIC)
        else:
            self.path = str(getattr(target, "name", "recording"))
            self._file = target
        self._offset: int = 0
        self._crc: int = 0
        self._schemas: dict[Schema, int] = {}
        self._summary: Summary = Summary()
        self._due_ns: int = 0
        self._chunk: ChunkBuffer = ChunkBuffer(2 * CHUNK_BYTES, not compact)
        self._compressor: zstandard.ZstdCompressor = zstandard.ZstdCompressor(level=_LEVEL)
        self._closed: bool = False
        self._put(records.MAGIC + records.header("", _LIBRARY))
        for name, values in (metadata or {}).items():
            self.add_metadata(name, values)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def size(self) -> int:
        """Number of bytes passed to the operating system, without the open chunk."""
        return self._offset

    # ---------------------------------------------------------------- channels and metadata

    def channel(self, topic: str, schema: Schema, metadata: Mapping[str, str] | None = None) -> int:
        """Write a new channel, and return its number, from 1.

        Raises:
            TraceError: the file cannot be written.
        """
        self._check_open()
        if schema not in self._schemas:
            number = len(self._schemas) + 1
            data = records.schema(number, schema.name, schema.encoding, schema.data)
            self._put(data)
            self._schemas[schema] = number
            self._summary.schemas.append(data)
        number = len(self._summary.channels) + 1
        data = records.channel(
            number, self._schemas[schema], topic, schema.encoding, metadata or {}
        )
        self._put(data)
        self._summary.channels.append(data)
        self._summary.counts[number] = 0
        return number

    def source(self, channel: int, sender: str, direction: Direction = Direction.UNKNOWN) -> int:
        """Register a sender on a CAN channel for `extend`, and return its number, from 0."""
        self._check_channel(channel)
        return self._chunk.add_source(channel, sender, direction)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a table of strings.

        Raises:
            TraceError: the file cannot be written.
        """
        self._check_open()
        offset = self._offset
        data = records.metadata(name, values)
        self._put(data)
        self._summary.metadata_indexes.append(records.metadata_index(offset, len(data), name))

    def attach(
        self,
        name: str,
        data: bytes,
        media_type: str = "application/octet-stream",
        log_time_ns: int = 0,
    ) -> None:
        """Write an attachment, for example a rig or an EDS.

        Raises:
            TraceError: the file cannot be written.
        """
        self._check_open()
        offset = self._offset
        content = records.attachment_content(log_time_ns, name, media_type, data)
        record = records.record(
            records.ATTACHMENT, content + records.UINT32.pack(zlib.crc32(content))
        )
        self._put(record)
        self._summary.attachment_indexes.append(
            records.attachment_index(offset, len(record), log_time_ns, len(data), name, media_type)
        )

    # ----------------------------------------------------------------------------- messages

    def extend(self, entries: list[Entry]) -> None:
        """Record these messages in this order; their times should not decrease.

        Args:
            entries: (source, log time [ns], data); see `traces.mcap.writer.Entry`.

        Raises:
            TraceError: a chunk was due and cannot be written.
            ValueError: data of a CAN source is not a CAN frame.
        """
        self._check_open()
        start = 0
        while start < len(entries):
            if entries[start][1] >= self._due_ns:
                self._close_chunk()
                self._due_ns = (entries[start][1] // self.chunk_ns + 1) * self.chunk_ns
            end = min(start + _SLICE, len(entries))
            if entries[end - 1][1] >= self._due_ns:
                # The first message always stays in this chunk, so that the loop ends.
                end = bisect_left(entries, self._due_ns, start + 1, end, key=_time_of)
            self._chunk.extend(entries if end - start == len(entries) else entries[start:end])
            start = end
            if self._chunk.used >= CHUNK_BYTES:
                self._close_chunk()

    def write(self, channel: int, log_time_ns: int, payload: bytes) -> None:
        """Record one encoded message.

        Raises:
            TraceError: a chunk was due and cannot be written.
        """
        self._check_channel(channel)
        self.extend([(-channel, log_time_ns, payload)])

    def can_frame(self, source: int, log_time_ns: int, frame: bytes) -> None:
        """Record one frame: a Linux can_frame or canfd_frame.

        Raises:
            TraceError: a chunk was due and cannot be written.
            ValueError: the data is not a CAN frame.
        """
        self.extend([(source, log_time_ns, frame)])

    def advance(self, now_ns: int) -> None:
        """Advance the time to `now_ns`; write the chunk if its second is over.

        Raises:
            TraceError: the file cannot be written.
        """
        if now_ns >= self._due_ns:
            self.flush()

    def flush(self) -> None:
        """Pass all messages so far to the operating system.

        Raises:
            TraceError: the file cannot be written.
        """
        self._check_open()
        self._close_chunk()

    def close(self) -> None:
        """Complete and close the file; closing it again has no effect.

        Raises:
            TraceError: the file cannot be written (raised once).
        """
        if self._closed:
            return
        self._closed = True
        try:
            if self.error is None:
                self._close_chunk()
                self._write(self._summary.ending(self._offset, self._crc))
        finally:
            self._release()

    # ------------------------------------------------------------------------------ the file

    def _close_chunk(self) -> None:
        """Write the buffered messages as one chunk."""
        chunk = self._chunk
        if not chunk.used:
            return
        with chunk.content() as content:
            data = self._compressor.compress(content)
            times_ns = chunk.first_ns, chunk.last_ns
            record, index = records.indexed_chunk(
                self._offset, times_ns, content, _COMPRESSION, data, chunk.index()
            )
        self._put(record)
        self._summary.add_chunk(index, chunk.first_ns, chunk.last_ns, chunk.counts())
        chunk.clear()

    def _short_ending(self) -> bytes:
        """Return the shortest valid ending: no summary, so that readers scan the whole file."""
        data_end = records.record(records.DATA_END, records.UINT32.pack(self._crc))
        footer = records.record(records.FOOTER, records.FOOTER_BODY.pack(0, 0, 0))
        return data_end + footer + records.MAGIC

    def _put(self, data: bytes) -> None:
        """Write complete records to the operating system, all or none."""
        self._write((data,))
        self._crc = zlib.crc32(data, self._crc)

    def _write(self, parts: Iterable[bytes]) -> None:
        """Write these parts after what is complete, all or none."""
        size = 0
        try:
            for data in parts:
                size += len(data)
                done = 0
                with memoryview(data) as view:
                    while done < len(view):
                        done += self._file.write(view[done:]) or 0
            self._file.flush()
        except OSError as error:
            self._fail(error)
        self._offset += size

    def _fail(self, cause: OSError) -> None:
        """Cut the file after its last complete record, and complete it if there is space.

        Raises:
            TraceError: always.
        """
        whole = self._summary.ending(self._offset, self._crc)
        is_complete = False
        for ending in (whole, (self._short_ending(),)):
            try:
                self._cut()
                is_complete = all(self._file.write(data) == len(data) for data in ending)
                self._file.flush()
            except OSError:
                is_complete = False
            if is_complete:
                break
        else:
            with suppress(OSError):  # the file stays cut, which our reader accepts
                self._cut()
        reach = "nothing yet"
        remedy = "free space there, or record to another place"
        if self._summary.chunk_indexes.count:
            reach = f"up to {self._summary.last_ns / 1e9:.3f} s"
            if not is_complete:
                remedy += "; its end is missing: motorhil recover adds it"
        self.error = TraceError(
            self.path,
            f"cannot be written: {reason(cause)}; the recording holds {reach}",
            remedy=remedy,
        )
        self._release()
        raise self.error from cause

    def _cut(self) -> None:
        """End the file after its last complete record."""
        self._file.seek(self._offset)
        self._file.truncate()

    def _release(self) -> None:
        if isinstance(self._file, io.RawIOBase) and self._owned:
            let_go(self._file)

    def _check_open(self) -> None:
        if self.error is not None:
            raise self.error
        if self._closed:
            raise TraceError(self.path, "the recording is closed")

    def _check_channel(self, channel: int) -> None:
        if not 0 < channel <= len(self._summary.channels):
            raise ValueError(f"{self.path} has no channel {channel}")
