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

Messages on their way into a chunk, packed in bulk into one buffer.

Most messages are CAN frames. For one sender, identifier and length, their record is constant except
for time and data. Each such combination therefore has a `struct` of its own, which packs straight
into the buffer: one call, and no bytes object per frame.

Summary section of an MCAP file, collected while the rest is written.

Creation of a recording file, without destroying other files.
"""

import fcntl
import io
import os
import stat
import struct
import sys
import zlib
from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from operator import itemgetter
from typing import BinaryIO, Final, Self, final

import zstandard

from motorhil.traces.errors import TraceError
from motorhil.traces.mcap import records
from motorhil.traces.mcap.records import MAGIC, MESSAGE, MESSAGE_HEAD
from motorhil.traces.schema import Direction, Schema, can_frame_prefix

Entry = tuple[int, int, bytes]
"""(source, log time [ns], data).

A source >= 0 is a sender on a channel, and the data is a Linux can_frame or canfd_frame. A source <
0 is a negated channel, and the data is the message itself.
"""

_HEAD_SIZE: Final = MESSAGE_HEAD.size
_CONSTANT: Final = struct.Struct("<BQHI")  # the message head before the times
_REMEMBERED: Final = 1 << 16  # prefixes; random identifiers on a bus must not fill the memory

_source_of: Final = itemgetter(0)


@final
class _Template:
    """Packing of frames of one sender that begin alike.

    Attributes:
        size: size of the record.
        frame_size: size of the frame.
        places: the message index of its channel.
    """

    __slots__ = ("frame_size", "head", "middle", "pack_into", "places", "size")

    def __init__(
        self,
        pack_into: Callable[..., None],
        head: bytes,
        middle: bytes,
        size: int,
        frame_size: int,
        places: list[int],
    ) -> None:
        self.pack_into = pack_into
        self.head = head
        self.middle = middle
        self.size = size
        self.frame_size = frame_size
        self.places = places


@final
class ChunkBuffer:
    """The messages of one chunk before compression; reused for the next chunk.

    Attributes:
        used: filled bytes.
        first_ns, last_ns: earliest and latest log time.
    """

    def __init__(self, size: int, indexed: bool) -> None:
        """Create an empty buffer; if `indexed`, it records the offset of each message."""
        self.used: int = 0
        self.first_ns: int = 0
        self.last_ns: int = 0
        self._counts: dict[int, int] = {}  # by channel, if there is no index
        self._buffer: bytearray = bytearray(size)
        self._sources: list[tuple[int, bytes, int]] = []
        self._known: list[dict[bytes, _Template]] = []  # by source, then by a frame's first 8 bytes
        self._known_count = 0
        self._wholes: dict[int, Callable[..., None]] = {}  # by length
        self._widest: int = 0
        self._indexed: bool = indexed
        self._index: dict[int, list[int]] = {}  # by channel: time, offset, time, offset, ...

    def add_source(self, channel: int, sender: str, direction: int) -> int:
        """Register a sender on a CAN channel, and return its number."""
        self._sources.append((channel, sender.encode(), direction))
        self._known.append({})
        return len(self._sources) - 1

    def content(self) -> memoryview:
        """Return a view of the records; release it before adding anything."""
        return memoryview(self._buffer)[: self.used]

    def index(self) -> list[tuple[int, bytes]]:
        """Return (channel, packed (log time, offset) of its messages) for MCAP."""
        out: list[tuple[int, bytes]] = []
        for channel, places in self._index.items():
            if places:
                packed = array("Q", places)
                if sys.byteorder == "big":
                    packed.byteswap()
                out.append((channel, packed.tobytes()))
        return out

    def counts(self) -> dict[int, int]:
        """Return the number of messages per channel."""
        if not self._indexed:
            return self._counts
        return {channel: len(places) // 2 for channel, places in self._index.items()}

    def clear(self) -> None:
        """Remove all messages; registered sources stay."""
        self.used = 0
        self._counts.clear()
        for places in self._index.values():
            places.clear()  # keep the list: templates refer to it

    def extend(self, entries: list[Entry]) -> None:
        """Append these messages, all or, if it raises, none.

        Raises:
            ValueError: data of a CAN source is not a CAN frame.
            struct.error: a time is negative.
        """
        if not entries:
            return
        marks = {channel: len(places) for channel, places in self._index.items()}
        try:
            self._pack(entries)
        except BaseException:
            for channel, places in self._index.items():
                del places[marks.get(channel, 0) :]
            raise
        if not self._indexed:
            for source, count in Counter(map(_source_of, entries)).items():
                channel = self._sources[source][0] if source >= 0 else -source
                self._counts[channel] = self._counts.get(channel, 0) + count

    def _pack(self, entries: list[Entry]) -> None:
        """Pack the records, and then update the used size."""
        known = self._known
        wholes = self._wholes
        used = self.used
        first = self.first_ns if used else entries[0][1]
        last = self.last_ns if used else entries[0][1]
        self._reserve(used + len(entries) * self._widest)
        buffer = self._buffer
        indexed = self._indexed
        for source, time_ns, data in entries:
            if time_ns > last:
                last = time_ns
            elif time_ns < first:
                first = time_ns
            if source < 0:
                length = len(data)
                size = _HEAD_SIZE + length
                self._reserve(used + size + len(entries) * self._widest)
                try:
                    pack_whole = wholes[length]
                except KeyError:
                    pack_whole = self._learn_length(length)
                pack_whole(buffer, used, MESSAGE, size - 9, -source, 0, time_ns, time_ns, data)
                if indexed:
                    places = self._places(-source)
                    places.append(time_ns)
                    places.append(used)
                used += size
                continue
            template = known[source].get(data[:8])
            if template is None or len(data) != template.frame_size:
                template = self._learn(source, data)
                self._reserve(used + len(entries) * self._widest)
            template.pack_into(
                buffer, used, template.head, time_ns, time_ns, template.middle, data[8:]
            )
            if indexed:
                places = template.places
                places.append(time_ns)
                places.append(used)
            used += template.size
        self.used, self.first_ns, self.last_ns = used, first, last

    def _learn(self, source: int, data: bytes) -> _Template:
        """Create the template for frames that begin like this one."""
        channel, sender, direction = self._sources[source]
        middle, length = can_frame_prefix(data[:8], len(data), sender, direction)
        # 15 bytes: the record's head before the times; sequence 0, as in mcap's own writer.
        layout = struct.Struct(f"<15sQQ{len(middle)}s{length}s")
        head = _CONSTANT.pack(MESSAGE, layout.size - 9, channel, 0)
        places = self._places(channel)
        template = _Template(layout.pack_into, head, middle, layout.size, len(data), places)
        if self._known_count >= _REMEMBERED:
            for known in self._known:
                known.clear()
            self._known_count = 0
        self._known_count += 1
        self._known[source][data[:8]] = template
        self._widest = max(self._widest, layout.size)
        return template

    def _learn_length(self, length: int) -> Callable[..., None]:
        """Create the packer of messages of this length, including the head."""
        if len(self._wholes) >= _REMEMBERED:
            self._wholes.clear()
        pack_whole = struct.Struct(f"{MESSAGE_HEAD.format}{length}s").pack_into
        self._wholes[length] = pack_whole
        return pack_whole

    def _places(self, channel: int) -> list[int]:
        """Return the message index of a channel."""
        places = self._index.get(channel)
        if places is None:
            places = self._index[channel] = []
        return places

    def _reserve(self, size: int) -> None:
        """Enlarge the buffer to at least `size` bytes."""
        if size > len(self._buffer):
            self._buffer.extend(bytes(size - len(self._buffer)))


def framed_chunk(  # its parameters are the record's fields
    offset: int,
    first_ns: int,
    last_ns: int,
    size: int,
    crc: int,
    compression: str,
    data: bytes,
    places: Sequence[tuple[int, bytes]],
) -> tuple[bytes, bytes, bytes]:
    """Return a chunk to be written at `offset`, its chunk index and its message indexes.

    Args:
        offset: in the file.
        first_ns: earliest log time in it [ns].
        last_ns: latest log time in it [ns].
        size: of the uncompressed records [bytes].
        crc: of the uncompressed records.
        compression: of `data`.
        data: as written.
        places: packed (log time, offset) of each channel's messages; empty: no index.
    """
    record = records.chunk(first_ns, last_ns, size, crc, compression, data)
    offsets: dict[int, int] = {}
    parts: list[bytes] = []
    end = len(record)
    for channel, packed in places:
        offsets[channel] = offset + end
        parts.append(records.message_index(channel, packed))
        end += len(parts[-1])
    index = records.chunk_index(
        *(first_ns, last_ns, offset, len(record), offsets, end - len(record)),
        *(compression, len(data), size),
    )
    return record, index, b"".join(parts)


@final
class Summary:
    """Records for the summary, in the order in which their subjects were written.

    Attributes:
        schemas, channels, chunk_indexes, attachment_indexes, metadata_indexes: records.
        counts: messages by channel.
        first_ns, last_ns: earliest and latest log time; first_ns is None without messages.
    """

    def __init__(self) -> None:
        self.schemas: list[bytes] = []
        self.channels: list[bytes] = []
        self.counts: dict[int, int] = {}
        self.chunk_indexes: list[bytes] = []
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

    def ending(self, offset: int, crc: int) -> bytes:
        """Return everything after the last chunk: data end, summary, offsets, footer, magic.

        Args:
            offset: of the end of the data.
            crc: of everything before it.
        """
        data_end = records.record(records.DATA_END, records.UINT32.pack(crc))
        start = offset + len(data_end)
        statistics = records.statistics(
            list(self.counts.items()),
            len(self.schemas),
            len(self.attachment_indexes),
            len(self.metadata_indexes),
            len(self.chunk_indexes),
            self.first_ns or 0,
            self.last_ns,
        )
        summary = b""
        offsets = b""
        for opcode, group in (
            (records.SCHEMA, self.schemas),
            (records.CHANNEL, self.channels),
            (records.STATISTICS, [statistics]),
            (records.CHUNK_INDEX, self.chunk_indexes),
            (records.ATTACHMENT_INDEX, self.attachment_indexes),
            (records.METADATA_INDEX, self.metadata_indexes),
        ):
            if group:
                data = b"".join(group)
                offsets += records.summary_offset(opcode, start + len(summary), len(data))
                summary += data
        offset_start = start + len(summary)
        footer = records.RECORD_HEAD.pack(records.FOOTER, records.FOOTER_BODY.size)
        footer += records.UINT64.pack(start) + records.UINT64.pack(offset_start)
        crc = zlib.crc32(summary + offsets + footer)
        ending = summary + offsets + footer + records.UINT32.pack(crc)
        return data_end + ending + records.MAGIC


def create(path: str) -> io.RawIOBase:
    """Create an empty, unbuffered file; each write goes straight to the operating system.

    The file is locked (flock) while it is open.

    Raises:
        TraceError: the file cannot be written, is not a recording, or is being written by another
            program.
    """
    try:
        return io.FileIO(path, "w", opener=_open)
    except OSError as error:
        folder = os.path.dirname(path) or "."
        remedy = "name a file in a folder you may write to"
        if not os.path.isdir(folder):
            remedy = f"make the folder first: mkdir -p {folder}"
        raise TraceError(path, f"cannot be written: {reason(error)}", remedy=remedy) from error


def let_go(file: io.RawIOBase) -> None:
    """Close the file; processes forked meanwhile do not keep its lock."""
    if not file.closed:
        with suppress(OSError):  # not every target supports locks
            fcntl.flock(file.fileno(), fcntl.LOCK_UN)
    file.close()


def reason(error: OSError) -> str:
    """Return the operating system's description of an error."""
    return (error.strerror or str(error)).lower()


def _open(path: str, flags: int) -> int:
    descriptor = os.open(path, flags & ~os.O_TRUNC, 0o666)
    try:
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            _check_ours(path, descriptor)
            os.ftruncate(descriptor, 0)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _check_ours(path: str, descriptor: int) -> None:
    with open(path, "rb") as file:
        if not MAGIC.startswith(file.read(len(MAGIC))):
            raise TraceError(
                path, "is not a recording, and would be overwritten", remedy="name another file"
            )
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise TraceError(
            path, "is being written by another program", remedy="name another file"
        ) from None
    except OSError:  # a file system without locks
        pass


CHUNK_NS: Final = 1_000_000_000
CHUNK_BYTES: Final = 1 << 20
_SLICE: Final = 4096  # messages packed at once; limits the excess of a chunk over CHUNK_BYTES
_COMPRESSION: Final = "zstd"
_LEVEL: Final = 1  # level 3 did not shrink the demo's frames, and took 1.5 times as long
_LIBRARY: Final = "motorhil"
_time_of: Final = itemgetter(1)


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
    ) -> None:
        """Begin the file; an existing recording of that name is overwritten.

        Args:
            target: a path, or a binary file open for writing, at its beginning.
            metadata: tables of strings by name ("run": seed, versions, ...).
            compact: True to omit the message index.

        Raises:
            TraceError: the file cannot be written, or exists and is not a recording.
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
                self._due_ns = (entries[start][1] // CHUNK_NS + 1) * CHUNK_NS
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
                self._put(self._summary.ending(self._offset, self._crc))
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
            crc = zlib.crc32(content)
        record, index, message_indexes = framed_chunk(
            *(self._offset, chunk.first_ns, chunk.last_ns, chunk.used, crc),
            *(_COMPRESSION, data, chunk.index()),
        )
        self._put(record + message_indexes)
        self._summary.add_chunk(index, chunk.first_ns, chunk.last_ns, chunk.counts())
        chunk.clear()

    def _short_ending(self) -> bytes:
        """Return the shortest valid ending: no summary, so that readers scan the whole file."""
        data_end = records.record(records.DATA_END, records.UINT32.pack(self._crc))
        footer = records.record(records.FOOTER, records.FOOTER_BODY.pack(0, 0, 0))
        return data_end + footer + records.MAGIC

    def _put(self, data: bytes) -> None:
        """Write complete records to the operating system, all or none."""
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
        """Cut the file after its last complete record, and complete it if there is space.

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
            except OSError:  # the file stays cut, which our reader accepts
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
