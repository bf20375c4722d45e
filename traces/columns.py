"""CAN frames of a recording as numpy arrays, millions per second.

Messages with the same beginning (see `FrameDecoder`) differ only in time and data, which are at
fixed offsets. One of them is decoded, and the others are read as columns. Each message is compared
with its expected beginning, and decoded singly if it differs.
"""

import os
import struct
from collections.abc import Collection, Iterator
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from motorhil.frozen import frozen
from motorhil.traces.can_frame import FDF
from motorhil.traces.mcap.reader import Cut, Trace, TraceMessage, read_trace
from motorhil.traces.mcap.records import MESSAGE
from motorhil.traces.schema import CAN_FRAME, FrameDecoder, can_frame_prefix

_PREFIX: Final = "/can/"
_CHANNEL_AT: Final = 9  # offset in a message record
_TIME_AT: Final = 15
_PAYLOAD_AT: Final = 31
_ID_AT: Final = 32  # in payloads of our writer
_ID_TAG: Final = 0x0D
_WORDS: Final = 8  # maximum 8-byte words of a prefix, and of the data of a CAN FD frame
_PADDING: Final = bytes(2 * 8 * _WORDS + 8)  # keeps every word within the buffer
_PAYLOAD_MAX: Final = 0xFFFF
_NOT_ALIKE: Final = b"\xff"  # no payload of our writer begins with it
_REMEMBERED: Final = 1 << 16
_ROUNDS: Final = 8  # senders and lengths per identifier; the rest is decoded one by one
_LENGTH: Final = struct.Struct("<Q")
_FRAME_HEAD: Final = struct.Struct("<IBB")
_U64 = NDArray[np.uint64]
_Indices = NDArray[np.intp]


@final
@frozen
class CanArrays:
    """n frames, in the order in which they were written.

    Attributes:
        time_ns: log times [ns], (n,) uint64.
        can_id: identifiers with Linux's flags EFF, RTR and ERR, (n,) uint32.
        flags: BRS 1, ESI 2, FDF 4, (n,) uint8; 0 for a classic frame.
        length: bytes of data, or the DLC of a remote frame, (n,) uint8.
        data: (n, 8) uint8, or (n, 64) if there are CAN FD frames; zero beyond the length.
        bus: index in `buses`, (n,) uint16.
        sender: index in `senders`, (n,) uint32.
        direction: `motorhil.traces.schema.Direction`, (n,) uint8.
        buses, senders: their names.
        unreadable: number of messages on these buses that are not CAN frames; they are omitted.
        cut: where the recording ends prematurely; None: it is complete.
    """

    time_ns: _U64
    can_id: NDArray[np.uint32]
    flags: NDArray[np.uint8]
    length: NDArray[np.uint8]
    data: NDArray[np.uint8]
    bus: NDArray[np.uint16]
    sender: NDArray[np.uint32]
    direction: NDArray[np.uint8]
    buses: tuple[str, ...]
    senders: tuple[str, ...]
    unreadable: int
    cut: Cut | None

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time_ns)


def read_can_arrays(
    path: str | os.PathLike[str],
    bus: str | Collection[str] | None = None,
    from_ns: int | None = None,
    to_ns: int | None = None,
) -> CanArrays:
    """Read the CAN frames of a recording, from our writer or another.

    Args:
        path: an MCAP file.
        bus: the bus or buses to read; None: all.
        from_ns: log time, inclusive; None: from the beginning.
        to_ns: log time, exclusive; None: to the end.

    Raises:
        TraceError: the file cannot be read, or is damaged.
    """
    buses = None if bus is None else {bus} if isinstance(bus, str) else set(bus)
    with read_trace(path) as trace:
        reader = _Reader(trace, buses)
        for records, messages in trace.contents(from_ns, to_ns):
            reader.take(records, messages)
        return reader.arrays(from_ns, to_ns)


_ROW: Final = np.dtype(
    [
        ("time_ns", "<u8"),
        ("can_id", "<u4"),
        ("sender", "<u4"),
        ("bus", "<u2"),
        ("flags", "u1"),
        ("length", "u1"),
        ("direction", "u1"),
    ]
)
_Rows = NDArray[np.void]


@final
class _Alike:
    """Known beginnings of messages, one row per kind, found by unique keys.

    A key combines a message's size, its channel and the identifier.
    """

    def __init__(self) -> None:
        self._kinds: dict[int, tuple[int, bytes, tuple[int, ...]]] = {}  # prefix length, prefix
        self.keys: _U64 = np.empty(0, np.uint64)
        self.size: _Indices = np.empty(0, np.intp)
        self.words: _U64 = np.empty((0, _WORDS), np.uint64)
        self.masks: _U64 = np.empty((0, _WORDS), np.uint64)
        self.rows: _Rows = np.empty(0, _ROW)
        self.used = 0  # words of the longest prefix

    def add(self, key: int, prefix: bytes, row: tuple[int, ...]) -> None:
        """Add a kind of message; its row is complete except for the time."""
        if len(self._kinds) >= _REMEMBERED:
            self._kinds.clear()
        self._kinds[key] = (len(prefix), prefix, row)

    def sort(self) -> None:
        """Sort the added kinds, so that `of` finds them."""
        keys = sorted(self._kinds)
        kinds = [self._kinds[key] for key in keys]
        width = 8 * _WORDS
        self.keys = np.array(keys, np.uint64)
        self.size = np.array([size for size, _, _ in kinds], np.intp)
        self.words = _words(b"".join(prefix.ljust(width, b"\0") for _, prefix, _ in kinds))
        self.masks = _words(b"".join((b"\xff" * size).ljust(width, b"\0") for size, _, _ in kinds))
        self.rows = np.array([row for _, _, row in kinds], _ROW)
        self.used = (int(self.size.max(initial=0)) + 7) // 8

    def of(self, keys: _U64) -> tuple[_Indices, NDArray[np.bool_]]:
        """Return the row of each key, and a mask of the keys that were found."""
        if not len(self.keys):
            return np.zeros(len(keys), np.intp), np.zeros(len(keys), bool)
        at = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return at, self.keys[at] == keys


def _words(data: bytes) -> _U64:
    return np.frombuffer(data, "<u8").reshape(-1, _WORDS)


def _places(records: bytes) -> tuple[_Indices, _Indices] | None:
    """Return offset and payload size of each message; None if there are other records."""
    unpack = _LENGTH.unpack_from
    places: list[int] = []
    append = places.append
    at, end = 0, len(records)
    last = end - 9
    while at <= last:
        append(at)
        at += 9 + unpack(records, at + 1)[0]
    if at != end:
        return None
    begin = np.array(places, np.intp)
    size = np.diff(begin, append=end) - _PAYLOAD_AT
    kinds = np.frombuffer(records, np.uint8)[begin]
    if (kinds != MESSAGE).any() or (size < 0).any():
        return None
    return begin, size


@final
class _Columns:
    """A chunk's messages as columns; `u64` is the 8-byte word at every byte offset."""

    def __init__(self, records: bytes, begin: _Indices, size: _Indices) -> None:
        self._bytes = records + _PADDING
        self.u64: _U64 = _at_every_byte(self._bytes, "<u8")
        self.channel = _at_every_byte(self._bytes, "<u2")[begin + _CHANNEL_AT].astype(np.intp)
        self.time_ns: _U64 = self.u64[begin + _TIME_AT]
        self.payload = begin + _PAYLOAD_AT
        self.size = size
        tag = np.frombuffer(self._bytes, np.uint8)[self.payload]
        self.has_key = (tag == _ID_TAG) & (size >= 5) & (size < _PAYLOAD_MAX)
        identifier = _at_every_byte(self._bytes, "<u4")[begin + _ID_AT].astype(np.uint64)
        high = (np.minimum(size, _PAYLOAD_MAX) << 16 | self.channel).astype(np.uint64)
        self.key: _U64 = high << np.uint64(32) | identifier
        self.bus: _Indices = np.zeros(len(begin), np.intp)

    def __len__(self) -> int:
        return len(self.size)

    def choose(self, bus: NDArray[np.int64]) -> None:
        """Assign each message its bus; remove those with bus -1."""
        self.bus = bus
        chosen = bus >= 0
        if not chosen.all():
            for name in ("time_ns", "payload", "size", "has_key", "key", "bus"):
                setattr(self, name, getattr(self, name)[chosen])

    def one(self, index: int) -> bytes:
        """Return one payload."""
        at = int(self.payload[index])
        return self._bytes[at : at + int(self.size[index])]

    def data(self, begin: _Indices, size: _Indices, words: int) -> NDArray[np.uint8]:
        """Return `size` bytes from each of `begin`, as an array (n, 8 * words)."""
        out = np.empty((len(begin), words), "<u8")
        for word in range(words):
            there = np.clip(size - 8 * word, 0, 8)
            out[:, word] = self.u64[begin + 8 * word] & _FIRST_BYTES[there]
        return out.view(np.uint8)


_FIRST_BYTES: Final = np.array([(1 << 8 * count) - 1 for count in range(9)], np.uint64)


def _at_every_byte(data: bytes, kind: str) -> NDArray[Any]:
    """Return the number that begins at each byte offset."""
    size = np.dtype(kind).itemsize
    return np.ndarray((len(data) - size + 1,), kind, data, strides=(1,))


@final
class _Reader:
    def __init__(self, trace: Trace, buses: set[str] | None) -> None:
        self._trace = trace
        self._wanted = buses
        self._buses: dict[str, int] = {}
        self._senders: dict[str, int] = {}
        self._decode = FrameDecoder().decode
        self._rounds = [_Alike() for _ in range(_ROUNDS)]
        self._channels: dict[int, int | None] = {}  # bus of each channel; None: not requested
        self._rows: list[_Rows] = []
        self._data: list[NDArray[np.uint8]] = []
        self._unreadable = 0

    def arrays(self, from_ns: int | None, to_ns: int | None) -> CanArrays:
        """Return everything taken so far within this span."""
        rows = np.concatenate([np.empty(0, _ROW), *self._rows])
        width = max((data.shape[1] for data in self._data), default=8)
        data = np.zeros((len(rows), width), np.uint8)
        at = 0
        for part in self._data:
            data[at : at + len(part), : part.shape[1]] = part
            at += len(part)
        if from_ns is not None or to_ns is not None:
            times = rows["time_ns"]
            chosen = np.ones(len(rows), bool)
            if from_ns is not None:
                chosen &= times >= max(from_ns, 0)
            if to_ns is not None:
                chosen &= times < max(to_ns, 0)
            rows, data = rows[chosen], data[chosen]
        columns: dict[str, Any] = {name: rows[name].copy() for name in _ROW.names or ()}
        return CanArrays(
            **columns,
            data=data,
            buses=tuple(self._buses),
            senders=tuple(self._senders),
            unreadable=self._unreadable,
            cut=self._trace.cut,
        )

    def take(self, records: bytes, messages: Iterator[TraceMessage]) -> None:
        """Take one chunk."""
        found = _places(records)
        chunk = None if found is None else _Columns(records, *found)
        if chunk is None or not self._know(chunk):
            self._take_slowly(messages)
        else:
            self._take_alike(chunk)

    # -------------------------------------------------------------------------- in columns

    def _know(self, chunk: "_Columns") -> bool:
        """Keep only messages on requested buses; return False if a channel is unknown."""
        numbers = np.flatnonzero(np.bincount(chunk.channel))
        if any(int(number) not in self._trace.channels for number in numbers):
            return False
        buses = np.full(int(numbers.max(initial=0)) + 1, -1, np.int64)
        for number in numbers:
            bus = self._bus_of(int(number))
            buses[number] = -1 if bus is None else bus
        chunk.choose(buses[chunk.channel])
        return True

    def _take_alike(self, chunk: "_Columns") -> None:
        rows = np.zeros(len(chunk), _ROW)
        begin = chunk.payload.copy()  # start of the data
        pending = np.flatnonzero(chunk.has_key)
        for alike in self._rounds:
            if not len(pending):
                break
            at, known = alike.of(chunk.key[pending])
            if not known.all():
                self._learn(alike, chunk, pending[~known])
                at, known = alike.of(chunk.key[pending])
            start = chunk.payload[pending]
            for word in range(alike.used):
                part = chunk.u64[start + 8 * word] & alike.masks[at, word]
                known &= part == alike.words[at, word]
            done = pending[known]
            rows[done] = alike.rows[at[known]]
            begin[done] += alike.size[at[known]]
            pending = pending[~known]
        left = np.union1d(pending, np.flatnonzero(~chunk.has_key))
        rows["time_ns"], rows["bus"] = chunk.time_ns, chunk.bus
        size = chunk.payload + chunk.size - begin
        size[left] = 0
        contents: dict[int, bytes] = {}
        for index in left.tolist():
            told = self._row(int(chunk.time_ns[index]), int(chunk.bus[index]), chunk.one(index))
            if told is not None:
                rows[index], contents[index] = told
        data = chunk.data(begin, size, 8 if (rows["flags"] & FDF).any() else 1)
        for index, content in contents.items():
            data[index, : len(content)] = np.frombuffer(content, np.uint8)
        if len(contents) < len(left):
            good = np.ones(len(rows), bool)
            good[[index for index in left.tolist() if index not in contents]] = False
            rows, data = rows[good], data[good]
        self._rows.append(rows)
        self._data.append(data)

    def _learn(self, alike: _Alike, chunk: "_Columns", unknown: _Indices) -> None:
        """Learn the beginning of unknown messages from one message per key."""
        for key, first in zip(*np.unique(chunk.key[unknown], return_index=True), strict=True):
            payload = chunk.one(int(unknown[first]))
            try:
                frame, direction, sender = self._decode(payload)
            except ValueError:
                alike.add(int(key), _NOT_ALIKE, (0,) * 7)
                continue
            can_id, length, flags = _FRAME_HEAD.unpack_from(frame)
            prefix, size = can_frame_prefix(frame[:8], len(frame), sender.encode(), direction)
            if prefix + frame[8 : 8 + size] != payload or len(prefix) > 8 * _WORDS:
                alike.add(int(key), _NOT_ALIKE, (0,) * 7)
                continue
            number = self._senders.setdefault(sender, len(self._senders))
            alike.add(int(key), prefix, (0, can_id, number, 0, flags, length, int(direction)))
        alike.sort()

    # -------------------------------------------------------------------------- one by one

    def _take_slowly(self, messages: Iterator[TraceMessage]) -> None:
        """Take a chunk that was cut or contains more than messages."""
        rows: list[tuple[int, ...]] = []
        contents: list[bytes] = []
        for channel, time_ns, payload in messages:
            bus = self._bus_of(channel.number)
            row = None if bus is None else self._row(time_ns, bus, payload)
            if row is not None:
                rows.append(row[0])
                contents.append(row[1])
        self._keep(np.array(rows, _ROW), contents)

    def _keep(self, rows: _Rows, contents: list[bytes]) -> None:
        width = 64 if any(len(content) > 8 for content in contents) else 8
        joined = b"".join(content.ljust(width, b"\0") for content in contents)
        self._rows.append(rows)
        self._data.append(np.frombuffer(joined, np.uint8).reshape(-1, width))

    def _row(self, time_ns: int, bus: int, payload: bytes) -> tuple[tuple[int, ...], bytes] | None:
        """Return row and data of a message; None if it is not a frame."""
        try:
            frame, direction, sender = self._decode(payload)
        except ValueError:
            self._unreadable += 1
            return None
        can_id, length, flags = _FRAME_HEAD.unpack_from(frame)
        number = self._senders.setdefault(sender, len(self._senders))
        return (time_ns, can_id, number, bus, flags, length, int(direction)), frame[8:]

    def _bus_of(self, number: int) -> int | None:
        """Return the index of a channel's bus; None if not requested or without CAN frames."""
        if number not in self._channels:
            channel = self._trace.channels[number]
            bus = channel.topic.removeprefix(_PREFIX)
            is_can = channel.schema is not None and channel.schema.name == CAN_FRAME.name
            asked = is_can and (self._wanted is None or bus in self._wanted)
            self._channels[number] = (
                self._buses.setdefault(bus, len(self._buses)) if asked else None
            )
        return self._channels[number]
