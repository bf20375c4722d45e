"""Summary section of an MCAP file, collected while the rest is written."""

import zlib
from collections.abc import Mapping, Sequence
from typing import final

from traces import records


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
