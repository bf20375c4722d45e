"""Writer for Vector BLF files: stamps of 1 ns, zlib containers.

python-can's writer is not used, because it keeps stamps in floats (0.24 us today). Times count from
the full millisecond of the earliest frame. The content of an error frame is where python-can puts
it: Linux's class in the identifier, and its data.

Source: as `traces.blf`; the flags of error frames, Wireshark, wiretap/blf.h.
"""

import struct
import zlib
from collections.abc import Iterator, Sequence
from typing import BinaryIO, Final, final

from traces import traffic
from traces.schema import Direction
from traces.traffic import Fields, Frame

_HEAD: Final = struct.Struct("<4sI8BQQII8H8H72x")
_OBJECT: Final = struct.Struct("<4sHHIIIHHQ")  # with a head of version 1
_CONTAINER: Final = struct.Struct("<4sHHIIH6xI4x")
_MESSAGE: Final = struct.Struct("<HBBI8s")
_FD_MESSAGE: Final = struct.Struct("<HBBIIBBB5x64s")
_ERROR: Final = struct.Struct("<HHIBBBxIIH2x8s")
_MESSAGE_KIND: Final = 1
_CONTAINER_KIND: Final = 10
_ERROR_KIND: Final = 73
_FD_KIND: Final = 100
_CONTENT_MAX: Final = 128 << 10  # bytes per container, as with Vector and python-can
_NANOSECONDS: Final = 2
_ZLIB: Final = 2
_EXTENDED: Final = 0x8000_0000
_REMOTE: Final = 0x80
_SENT: Final = 0x01
_CORE_TOLD: Final = 2  # the core's error code and direction are valid
_CORE_SENT: Final = 0x1000
_CORE_NOT_ACKNOWLEDGE: Final = 0x2000
_CORE_OTHER, _CORE_UNACKNOWLEDGED = 3 << 6, 7 << 6
_LINUX_UNACKNOWLEDGED: Final = 0x20
_MS: Final = 1_000_000
_CLASSIC_SIZE: Final = 16
_MESSAGE_OBJECT: Final = struct.Struct("<24sQ8s8s")
_MESSAGE_HEAD: Final = _OBJECT.pack(
    *(b"LOBJ", 32, 1, _OBJECT.size + _MESSAGE.size, _MESSAGE_KIND, _NANOSECONDS, 0, 0, 0)
)[:24]
_REMEMBERED: Final = 1 << 16


def write_blf(file: BinaryIO, buses: Sequence[str], first_ns: int, frames: Iterator[Frame]) -> None:
    """Write a BLF file; `first_ns` is the earliest log time. The file must be seekable."""
    writer = _Writer(file, first_ns)
    numbers = traffic.bus_numbers(buses)
    for frame in frames:
        writer.add(frame, numbers[frame.bus])
    writer.close()


@final
class _Writer:
    def __init__(self, file: BinaryIO, first_ns: int) -> None:
        self._file = file
        self._start_ns = self._last_ns = first_ns // _MS * _MS
        self._content = bytearray()
        self._known: dict[
            tuple[int, Direction, bytes], bytes
        ] = {}  # the beginning of each kind of message
        self._objects = 0
        self._size = _HEAD.size
        self._plain_size = _HEAD.size  # uncompressed size
        file.write(bytes(_HEAD.size))

    def add(self, frame: Frame, channel: int) -> None:
        time_ns, _, data, direction, _ = frame
        since_ns = time_ns - self._start_ns
        key = channel, direction, data[:8]
        begins = self._known.get(key) if len(data) == _CLASSIC_SIZE else None
        if begins is not None:  # same as an earlier message except for time and data
            self._content += _MESSAGE_OBJECT.pack(_MESSAGE_HEAD, since_ns, begins, data[8:])
        else:
            kind, body = _object(traffic.fields(data), direction, channel)
            size = _OBJECT.size + len(body)  # always a multiple of 4, so no padding
            self._content += _OBJECT.pack(b"LOBJ", 32, 1, size, kind, _NANOSECONDS, 0, 0, since_ns)
            self._content += body
            if kind == _MESSAGE_KIND and len(self._known) < _REMEMBERED:
                self._known[key] = body[:8]
        self._objects += 1
        self._last_ns = time_ns
        if len(self._content) >= _CONTENT_MAX:
            self._put(self._content[:_CONTENT_MAX])
            del self._content[:_CONTENT_MAX]

    def close(self) -> None:
        if self._content:
            self._put(self._content)
        self._file.seek(0)
        program = (0, 0, 0, 0, 2, 6, 8, 1)  # application unknown; version of the format
        sizes = (self._size, self._plain_size, self._objects, 0)
        times = (*_system_time(self._start_ns), *_system_time(self._last_ns))
        self._file.write(_HEAD.pack(b"LOGG", _HEAD.size, *program, *sizes, *times))
        self._file.seek(0, 2)

    def _put(self, content: bytearray) -> None:
        data = zlib.compress(content)
        size = _CONTAINER.size + len(data)
        head = _CONTAINER.pack(b"LOBJ", 16, 1, size, _CONTAINER_KIND, _ZLIB, len(content))
        padding = bytes(size % 4)  # the format's own rule: size modulo 4
        self._file.write(head + data + padding)
        self._size += size + len(padding)
        self._plain_size += _CONTAINER.size + len(content)


def _object(told: Fields, direction: Direction, channel: int) -> tuple[int, bytes]:
    """Return the kind and the content of the object for a frame."""
    sent = direction is Direction.TRANSMITTED
    if told.can_id & traffic.ERR:
        return _ERROR_KIND, _error(told, direction, channel)
    can_id = told.identifier | (_EXTENDED if told.can_id & traffic.EFF else 0)
    flags = (_REMOTE if told.can_id & traffic.RTR else 0) | (_SENT if sent else 0)
    if not told.fd:
        return _MESSAGE_KIND, _MESSAGE.pack(channel, flags, told.length, can_id, told.data)
    dlc = next(n for n in range(16) if traffic.FD_LENGTHS[n] >= told.length)
    bits = 1 | (2 if told.flags & traffic.BRS else 0) | (4 if told.flags & traffic.ESI else 0)
    body = _FD_MESSAGE.pack(channel, flags, dlc, can_id, 0, 0, bits, told.length, told.data)
    return _FD_KIND, body


def _error(told: Fields, direction: Direction, channel: int) -> bytes:
    flags = core = 0
    if direction:
        flags, core = _CORE_TOLD, _CORE_OTHER | _CORE_NOT_ACKNOWLEDGE
        if told.identifier & _LINUX_UNACKNOWLEDGED:
            core = _CORE_UNACKNOWLEDGED
        if direction is Direction.TRANSMITTED:
            core |= _CORE_SENT
    return _ERROR.pack(*(channel, 0, flags, 0, 0, told.length, 0, told.identifier, core, told.data))


def _system_time(time_ns: int) -> tuple[int, ...]:
    """Return year, month, day of week, day, h, min, s, ms."""
    year, month, day = traffic.date_of(time_ns)
    days, of_day_ms = divmod(time_ns // _MS, 86_400_000)
    seconds, ms = divmod(of_day_ms, 1000)
    weekday = (days + 4) % 7  # 1970 began with a Thursday
    return year, month, weekday, day, seconds // 3600, seconds // 60 % 60, seconds % 60, ms
