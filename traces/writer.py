"""Writes a recording: an MCAP file that stays readable wherever it is cut.

Everything a reader needs stands in the file before it is needed, whole and uncompressed: schemas,
channels, metadata, attachments. Messages go into chunks (zstd, CRC); a chunk ends with each second
of log time, or at 1 MiB, and is handed to the operating system at once, in one piece. So whatever
ends the program, the file is readable up to its last second. The summary at the end makes it a
complete MCAP file for every other reader.

Behind each chunk is a message index. It is two thirds of the file, and our own reader never looks
at it; but without it @mcap/core (and so Foxglove) refuses the file, and mcap for Python before 1.6
finds no message in it. Whoever wants a third of the size instead asks for a compact recording.

The writer reads no clock: log times are what it is told.
"""

import io
import os
import zlib
from bisect import bisect_left
from collections.abc import Mapping
from operator import itemgetter
from typing import BinaryIO, Final, Self, final

import zstandard

from traces import records
from traces.chunk import ChunkBuffer, Entry
from traces.errors import TraceError
from traces.new_file import create, let_go, reason
from traces.schema import Direction, Schema
from traces.summary import Summary, framed_chunk

CHUNK_NS: Final = 1_000_000_000
CHUNK_BYTES: Final = 1 << 20
_SLICE: Final = 4096  # messages packed at once; bounds how far a chunk may outgrow CHUNK_BYTES
_COMPRESSION: Final = "zstd"
_LEVEL: Final = 1  # level 3 made the demo's frames no smaller and took half as long again
_LIBRARY: Final = "motorhil"
_time_of: Final = itemgetter(1)


@final
class TraceWriter:
    """One recording being written; a context manager that closes it.

    Not for several threads at once. After an error (TraceError) nothing more is written, and
    `close` is quiet: what had been written stands, ended as a complete file if there is room.
    """

    def __init__(
        self,
        target: str | os.PathLike[str] | BinaryIO,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        compact: bool = False,
    ) -> None:
        """The file is begun; a recording of that name is written over.

        Args:
            target: a path, or a binary file open for writing, at its beginning.
            metadata: tables of strings by name ("run": seed, versions, ...).
            compact: without a message index.

        Raises:
            TraceError: it cannot be written, or something else of that name would be lost.
        """
        self.path: str
        self.error: TraceError | None = None
        self._file: io.RawIOBase | BinaryIO
        self._owned: bool = isinstance(target, str | os.PathLike)
        if isinstance(target, str | os.PathLike):
            self.path = os.fspath(target)
            self._file = create(self.path)
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
        """Bytes that are with the operating system; messages of an open chunk are not yet."""
        return self._offset

    # ------------------------------------------------------------- what is said about messages

    def channel(self, topic: str, schema: Schema, metadata: Mapping[str, str] | None = None) -> int:
        """The number of a new channel, 1 and up.

        Raises:
            TraceError: it cannot be written.
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
        """The number of a sender on a CAN channel, 0 and up, for `extend`."""
        self._check_channel(channel)
        return self._chunk.add_source(channel, sender, direction)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """A table of strings is in the file.

        Raises:
            TraceError: it cannot be written.
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
        """A whole file (a rig, an EDS) is in the file.

        Raises:
            TraceError: it cannot be written.
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
        """These messages are recorded, in this order; times best do not decrease.

        Args:
            entries: (source, log time [ns], data); see `traces.chunk.Entry`.

        Raises:
            TraceError: a chunk was due and cannot be written.
            ValueError: data of a CAN source is no CAN frame.
        """
        self._check_open()
        start = 0
        while start < len(entries):
            if entries[start][1] >= self._due_ns:
                self._close_chunk()
                self._due_ns = (entries[start][1] // CHUNK_NS + 1) * CHUNK_NS
            end = min(start + _SLICE, len(entries))
            if entries[end - 1][1] >= self._due_ns:
                # The first stays in this chunk in any case, so that this ends.
                end = bisect_left(entries, self._due_ns, start + 1, end, key=_time_of)
            self._chunk.extend(entries if end - start == len(entries) else entries[start:end])
            start = end
            if self._chunk.used >= CHUNK_BYTES:
                self._close_chunk()

    def write(self, channel: int, log_time_ns: int, payload: bytes) -> None:
        """One message, already encoded, is recorded.

        Raises:
            TraceError: a chunk was due and cannot be written.
        """
        self._check_channel(channel)
        self.extend([(-channel, log_time_ns, payload)])

    def can_frame(self, source: int, log_time_ns: int, frame: bytes) -> None:
        """One frame is recorded: a Linux can_frame or canfd_frame.

        Raises:
            TraceError: a chunk was due and cannot be written.
            ValueError: it is no CAN frame.
        """
        self.extend([(source, log_time_ns, frame)])

    def advance(self, now_ns: int) -> None:
        """It is `now_ns`: a chunk whose second is over is in the file.

        Raises:
            TraceError: it cannot be written.
        """
        if now_ns >= self._due_ns:
            self.flush()

    def flush(self) -> None:
        """All messages so far are with the operating system.

        Raises:
            TraceError: they cannot be written.
        """
        self._check_open()
        self._close_chunk()

    def close(self) -> None:
        """The file is complete and closed; closing again does nothing.

        Raises:
            TraceError: it cannot be written (told once).
        """
        if self._closed:
            return
        self._closed = True
        try:
            if self.error is None:
                self._close_chunk()
                self._put(self._summary.ending(self._offset, self._crc))
        finally:
            self._release()

    # ------------------------------------------------------------------------------ the file

    def _close_chunk(self) -> None:
        """What is buffered is in the file, as one chunk."""
        chunk = self._chunk
        if not chunk.used:
            return
        with chunk.content() as content:
            data = self._compressor.compress(content)
            crc = zlib.crc32(content)
        record, index, message_indexes = framed_chunk(
            *(self._offset, chunk.first_ns, chunk.last_ns, chunk.used, crc),
            *(_COMPRESSION, data, chunk.index()),
        )
        self._put(record + message_indexes)
        self._summary.add_chunk(index, chunk.first_ns, chunk.last_ns, chunk.counts())
        chunk.clear()

    def _short_ending(self) -> bytes:
        """The least that makes a file complete: no summary, so that readers go through it all."""
        data_end = records.record(records.DATA_END, records.UINT32.pack(self._crc))
        footer = records.record(records.FOOTER, records.FOOTER_BODY.pack(0, 0, 0))
        return data_end + footer + records.MAGIC

    def _put(self, data: bytes) -> None:
        """`data`, whole records, is with the operating system; or all of it is not."""
        done = 0
        try:
            with memoryview(data) as view:
                while done < len(view):
                    done += self._file.write(view[done:]) or 0
            self._file.flush()
        except OSError as error:
            self._fail(error)
        self._offset += len(data)
        self._crc = zlib.crc32(data, self._crc)

    def _fail(self, cause: OSError) -> None:
        """The file ends where its last whole record did, and is completed if there is room.

        Raises:
            TraceError: always.
        """
        reach = "nothing yet"
        if self._summary.chunk_indexes:
            reach = f"up to {self._summary.last_ns / 1e9:.3f} s"
        self.error = TraceError(
            self.path,
            f"cannot be written: {reason(cause)}; the recording holds {reach}",
            remedy="free space there, or record to another place",
        )
        whole = self._summary.ending(self._offset, self._crc)
        for ending in (whole, self._short_ending(), b""):
            try:
                self._file.seek(self._offset)
                self._file.truncate()
                if self._file.write(ending) == len(ending):
                    self._file.flush()
                    break
            except OSError:  # then it stays a cut file, which our reader takes as well
                continue
        self._release()
        raise self.error from cause

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
