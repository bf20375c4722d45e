"""Recovery of recordings that were cut or damaged.

The file is read record by record. Where no record begins, or a chunk does not match its check sum,
the next record with a valid successor is searched. The bytes between are lost, and are reported
with their offset and, if known, their time. Complete chunks are copied unchanged. The first
messages of a chunk whose end is missing are salvaged. Schemas and channels in the summary have
priority, because a check sum covers them.
"""

import os
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from mmap import ACCESS_READ, mmap
from typing import BinaryIO, Final, final

from traces import records
from traces.assembly import Assembly, take
from traces.compression import salvage
from traces.errors import TraceError
from traces.new_file import create, let_go, reason
from traces.record_checks import (
    Chunk,
    Record,
    chunk_head,
    chunk_in,
    messages_in,
    next_record,
    record_at,
)
from traces.regular_file import place_to_replace, refuse_pipe

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
_FOOTER_SIZE: Final = records.RECORD_HEAD.size + records.FOOTER_BODY.size


@final
@dataclass(frozen=True, slots=True)
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


def recover(source: str, target: str, overwrite: bool = False) -> Recovery:
    """Write a complete recording `target` with everything recoverable from `source`.

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
                    raise TraceError(source, "is not an MCAP file", remedy="give a recording")
                return _recover_into(target, data)
    except OSError as error:
        raise TraceError(source, f"cannot be read: {reason(error)}") from error


def _recover_into(target: str, data: mmap) -> Recovery:
    place = place_to_replace(target)
    part = f"{place}.part"
    out = create(part)
    try:
        done = recover_bytes(data, out)  # type: ignore[arg-type]  # FileIO is a BinaryIO in all but name
        os.replace(part, place)
    except OSError as error:
        what = f"cannot be written: {reason(error)}"
        raise TraceError(target, what, remedy="free space there, or name another place") from error
    finally:
        let_go(out)
        with suppress(OSError):
            os.remove(part)
    return done


def recover_bytes(data: mmap | bytes, out: BinaryIO) -> Recovery:
    """Recover a file's bytes (with their magic) into an open file, like `recover`."""
    return _Walk(data, out).run()


@final
class _Walk:
    """One pass through a damaged file."""

    def __init__(self, data: mmap | bytes, out: BinaryIO) -> None:
        self._data = data
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
                take(self._assembly, record)
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
            chunk = chunk_in(data[start:end]) if end <= self._size else None
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
            self._lose(offset, end, f"the end of a chunk's content ({error})")

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
            end = next_record(data, offset + 1) or self._size
        is_cut = end == self._size < stated
        if is_cut and opcode == records.CHUNK and self._salvage(offset):
            return end
        name = _NAMES.get(opcode, "")
        what = "not a complete record"
        if is_cut and name:
            what = f"{name} whose end is missing"
        elif opcode == records.CHUNK:
            what = "a damaged chunk"
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
        content = _whole_records(salvage(compression, there[at + 8 :]))
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
    """Return the content up to the end of its last complete record."""
    end = 0
    with suppress(ValueError):
        for _, _, end, _ in messages_in(content):  # noqa: B007  # the last one counts
            pass
    return content[:end]


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
