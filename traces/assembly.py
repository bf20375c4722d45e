"""Assembly of an MCAP file from existing records.

Records are copied unchanged, except for text that is not valid UTF-8, because other readers refuse
the whole file for it.
"""

import zlib
from array import array
from sys import byteorder
from typing import BinaryIO, Final, final

import zstandard

from traces import records
from traces.record_checks import Chunk, Record, messages_in
from traces.summary import Summary, framed_chunk

_LEVEL: Final = 1
_NO_SCHEMA: Final = 0


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
        self.messages = 0
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
        """Write message records as a chunk of their own, like `chunk`."""
        times = [time_ns for opcode, _, _, time_ns in messages_in(content) if opcode == 5]
        data = zstandard.ZstdCompressor(level=_LEVEL).compress(content)
        first, last = (min(times), max(times)) if times else (0, 0)
        return self.chunk(Chunk(first, last, zlib.crc32(content), "zstd", data, content))

    def end(self) -> None:
        """Complete the file."""
        for opcode, number in self._spare:
            if opcode == records.CHANNEL:
                self._name(number)
        self._put(self._summary.ending(self._offset, self._crc))

    def _put_chunk(self, chunk: Chunk, places: dict[int, list[int]]) -> None:
        times = [time for of_channel in places.values() for time in of_channel[::2]]
        first, last = (min(times), max(times)) if times else (chunk.first_ns, chunk.last_ns)
        self._order |= dict.fromkeys(places)
        packed = [(number, _packed(places[number])) for number in self._order if number in places]
        record, index, message_indexes = framed_chunk(
            *(self._offset, first, last, len(chunk.content), zlib.crc32(chunk.content)),
            *(chunk.compression, chunk.data, packed if self._indexed else ()),
        )
        self._put(record + message_indexes)
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


def _packed(places: list[int]) -> bytes:
    """Return times and offsets in the layout of a message index."""
    out = array("Q", places)
    if byteorder == "big":
        out.byteswap()
    return out.tobytes()


def take(assembly: Assembly, record: Record) -> None:
    """Add a schema, channel, metadata or attachment record to the assembly."""
    if record.opcode == records.SCHEMA:
        assembly.schema(record.content)
    elif record.opcode == records.CHANNEL:
        assembly.channel(record.content)
    elif record.opcode == records.METADATA:
        assembly.metadata(record.content)
    elif record.opcode == records.ATTACHMENT:
        assembly.attachment(record.content)
