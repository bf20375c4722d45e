"""Messages on their way into a chunk, packed in bulk into one buffer.

Most messages are CAN frames. For one sender, identifier and length, their record is constant except
for time and data. Each such combination therefore has a `struct` of its own, which packs straight
into the buffer: one call, and no bytes object per frame.
"""

import struct
from collections import Counter
from collections.abc import Callable
from operator import itemgetter
from typing import Final, final

from motorhil.traces.mcap.records import MESSAGE, MESSAGE_HEAD
from motorhil.traces.schema import can_frame_prefix

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

    def index(self) -> dict[int, list[int]]:
        """Return time, offset, time, offset, ... of the messages, by channel."""
        return {channel: places for channel, places in self._index.items() if places}

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
