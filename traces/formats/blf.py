"""Reader and writer for Vector BLF files: classic, CAN FD and error frames.

Time stamps have a resolution of 10 us or 1 ns. A time is the sum of the file's start, taken as UTC,
and the object's time. Without a start it is the object's time alone. Truncated or damaged parts are
reported, and everything intact is read.

The writer uses stamps of 1 ns, which count from the full millisecond of the earliest frame, and
zlib containers. The content of an error frame is where python-can puts it: Linux's class in the
identifier, and its data. python-can's own reader and writer keep stamps in floats (0.24 us today),
and its reader stops at the first damage.

Source: Vector, "Binary Logging Format" (also described by vector_blf, LGPL, by T. Lorenz);
python-can 4.6.1; the flags of error frames, Wireshark, wiretap/blf.h.
"""

import struct
import zlib
from collections.abc import Iterator, Sequence
from typing import BinaryIO, Final, final

from motorhil.traces import can_frame
from motorhil.traces.can_frame import Fields
from motorhil.traces.errors import TraceError
from motorhil.traces.files import MEMORY_MAX, open_content
from motorhil.traces.formats import frames as traffic
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.schema import Direction

MAGIC: Final = b"LOGG"
_OBJECT: Final = b"LOBJ"
_BASE: Final = struct.Struct("<4sHHII")  # signature, size and version of the head, size, type
_STAMP: Final = struct.Struct("<I4xQ")  # flags, time: at the same offset in versions 1 and 2
_START: Final = struct.Struct("<8H")  # SYSTEMTIME: year, month, day of week, day, h, m, s, ms
_START_AT: Final = 40
_MESSAGE: Final = struct.Struct("<HBBI8s")  # channel, flags, DLC, identifier, data
_FD_MESSAGE: Final = struct.Struct("<HBBIIBBB5x64s")
_FD_MESSAGE_64: Final = struct.Struct("<BBBBIIIIIIIHBBI")
_ERROR: Final = struct.Struct("<HHIBBBxIIH2x8s")
_CONTAINER_KIND: Final = 10
_HEAD_MAX: Final = 1 << 16
_INNER_MAX: Final = 1 << 22  # inside a container
_CONTAINERS: Final = 4  # uncompressed, in the memory at once
_EXTENDED: Final = 0x8000_0000
_REMOTE: Final = 0x80
_SENT: Final = 0x01
_CORE_TOLD: Final = 2  # in an error frame: the controller's own error code is valid
_CORE_SENT: Final = 0x1000
_HEAD: Final = struct.Struct("<4sI8BQQII8H8H72x")
_OBJECT_OUT: Final = struct.Struct("<4sHHIIIHHQ")  # with a head of version 1
_CONTAINER_OUT: Final = struct.Struct("<4sHHIIH6xI4x")
_MESSAGE_KIND: Final = 1
_ERROR_KIND: Final = 73
_FD_KIND: Final = 100
_CONTENT_MAX: Final = 128 << 10  # bytes per container, as with Vector and python-can
_NANOSECONDS: Final = 2
_ZLIB: Final = 2
_CORE_NOT_ACKNOWLEDGE: Final = 0x2000
_CORE_OTHER, _CORE_UNACKNOWLEDGED = 3 << 6, 7 << 6
_LINUX_UNACKNOWLEDGED: Final = 0x20
_MS: Final = 1_000_000
_CLASSIC_SIZE: Final = 16
_MESSAGE_OBJECT: Final = struct.Struct("<24sQ8s8s")
_MESSAGE_HEAD: Final = _OBJECT_OUT.pack(
    *(_OBJECT, 32, 1, _OBJECT_OUT.size + _MESSAGE.size, _MESSAGE_KIND, _NANOSECONDS, 0, 0, 0)
)[:24]
_REMEMBERED: Final = 1 << 16


def blf_frames(path: str, findings: Findings, memory_max: int = MEMORY_MAX) -> Iterator[Frame]:
    """Yield the frames of a BLF file, in file order.

    Raises:
        TraceError: the file cannot be read, or is not a BLF file.
    """
    with open_content(path, lambda text: findings.problem(0, text), memory_max) as file:
        data = file.read()
    if data[:4] != MAGIC:
        raise TraceError(path, "is not a BLF file")
    if len(data) < _START_AT + _START.size:
        findings.problem(0, f"ends at byte {len(data)}, within its head")
        return
    yield from _Objects(_start_ns(data, findings), findings, memory_max).frames(data)


def _start_ns(data: bytes, findings: Findings) -> int:
    told: tuple[int, ...] = _START.unpack_from(data, _START_AT)
    year, month, _, day, hours, minutes, seconds, ms = told
    if year < 1970 or not 1 <= month <= 12 or not 1 <= day <= 31:
        findings.note("no start time since 1970: times count from the beginning of the recording")
        return 0
    of_day_ms = ((hours * 60 + minutes) * 60 + seconds) * 1000 + ms
    return traffic.date_ns(year, month, day) + of_day_ms * 1_000_000


@final
class _Objects:
    def __init__(self, start_ns: int, findings: Findings, memory_max: int) -> None:
        self._start_ns = start_ns
        self._memory_max = memory_max
        self._findings = findings
        self._number = 0
        self._others = 0

    def frames(self, data: bytes) -> Iterator[Frame]:
        """Yield frames inside and outside containers; objects can span two containers."""
        at = min(struct.unpack_from("<I", data, 4)[0], _HEAD_MAX)
        rest = b""
        if at > len(data):
            self._findings.problem(0, f"ends at byte {len(data)}, within its head")
        while at + _BASE.size <= len(data):
            signature, head, _, size, kind = _BASE.unpack_from(data, at)
            if signature != _OBJECT or not _BASE.size <= size <= self._memory_max:
                found = data.find(_OBJECT, at + 1)
                lost = (found if found >= 0 else len(data)) - at
                self._findings.problem(self._number, f"{lost} bytes at byte {at} are not an object")
                if found < 0:
                    return
                at = found
                continue
            if at + size > len(data):
                missing = at + size - len(data)
                self._findings.problem(
                    self._number, f"ends {missing} bytes before the end of an object at byte {at}"
                )
            body = data[at : at + size]
            damage = len(self._findings.problems)
            if kind == _CONTAINER_KIND:
                rest += self._content(body, max(head, _BASE.size), at)
            else:
                rest += body
            used = 0
            for end, frame in self._in(rest):
                used = end
                if frame is not None:
                    yield frame
            rest = rest[used:]
            if (
                len(self._findings.problems) > damage
                and kind == _CONTAINER_KIND
                and at + size < len(data)
            ):
                rest = b""  # a damaged size must not swallow the following containers
            at += size + size % 4
        if data[at:].strip(b"\0"):
            left = len(data) - at
            self._findings.problem(
                self._number, f"ends within the head of an object ({left} bytes)"
            )
        if rest.strip(b"\0"):
            self._findings.problem(self._number, f"{len(rest)} bytes remain of its last object")
        if self._others:
            self._findings.note(f"{self._others} objects are not frames, and are omitted")

    def _content(self, body: bytes, head: int, at: int) -> bytes:
        """Return the content of a container, or as much as possible of a damaged one."""
        if len(body) < head + 16:
            return b""
        method = struct.unpack_from("<H", body, head)[0]
        stored = body[head + 16 :]
        if method == 0:
            return stored
        if method != 2:
            self._findings.problem(self._number, f"compression {method} at byte {at} is unknown")
            return b""
        most = self._memory_max // _CONTAINERS
        unpacker = zlib.decompressobj()
        out = bytearray()
        try:
            for begin in range(0, len(stored), 512):
                out += unpacker.decompress(stored[begin : begin + 512], most)
                if len(out) > most:
                    what = f"a container at byte {at} has more than {most} bytes"
                    what += f"; --max-memory allows more, {_CONTAINERS} times as many"
                    self._findings.problem(self._number, what)
                    break
        except zlib.error as error:
            self._findings.note("frames of a damaged container may be wrong")
            self._findings.problem(self._number, f"a container at byte {at} is damaged ({error})")
        return bytes(out)

    def _in(self, data: bytes) -> Iterator[tuple[int, Frame | None]]:
        """Yield the end and the frame of each complete object."""
        at = 0
        while True:
            found = data.find(_OBJECT, at)
            if found < 0 or found + _BASE.size > len(data):
                return
            if data[at:found].strip(b"\0"):
                lost = found - at
                self._findings.problem(
                    self._number, f"{lost} bytes in a container are not an object"
                )
            _, _, version, size, kind = _BASE.unpack_from(data, found)
            if not _BASE.size <= size <= _INNER_MAX:
                self._findings.problem(self._number, f"an object of {size} bytes")
                at = found + 4
                continue
            if found + size > len(data):
                return
            self._number += 1
            frame = None
            try:
                frame = self._frame(data[found : found + size], version, kind)
            except (struct.error, ValueError) as error:
                self._findings.problem(self._number, f"object {self._number}: {error}")
            at = found + size
            yield at, frame

    def _frame(self, body: bytes, version: int, kind: int) -> Frame | None:
        take = {1: _message, 86: _message, 100: _fd_message, 101: _fd_message_64, 73: _error}
        if kind not in take and kind != 2:
            self._others += 1
            return None
        if version not in (1, 2):
            raise ValueError(f"a head of version {version}")
        flags, ticks = _STAMP.unpack_from(body, _BASE.size)
        time_ns = traffic.log_time(self._start_ns + (ticks * 10_000 if flags == 1 else ticks))
        if kind == 2:
            self._findings.note("error frames do not state the cause; read as bus errors")
            (channel,) = struct.unpack_from("<H", body, 32)
            error = can_frame.classic(can_frame.ERR | 0x80, bytes(8))
            return Frame(time_ns, f"can{max(0, channel - 1)}", error)
        if kind == 73:
            self._findings.note(
                "error frames are kept as recorded, in Linux's or Vector's encoding"
            )
        channel, frame, direction = take[kind](body, 32)
        return Frame(time_ns, f"can{max(0, channel - 1)}", frame, direction)


_Told = tuple[int, bytes, Direction]  # channel, frame, direction


def _can_id(told: int) -> int:
    return told & can_frame.EFF_MASK | (can_frame.EFF if told & _EXTENDED else 0)


def _way(sent: int) -> Direction:
    return Direction.TRANSMITTED if sent else Direction.RECEIVED


def _message(body: bytes, at: int) -> _Told:
    channel, flags, dlc, can_id, data = _MESSAGE.unpack_from(body, at)
    can_id = _can_id(can_id)
    length = min(dlc, 8)
    if flags & _REMOTE:
        return channel, can_frame.remote(can_id, length), _way(flags & _SENT)
    return channel, can_frame.classic(can_id, data[:length]), _way(flags & _SENT)


def _fd_message(body: bytes, at: int) -> _Told:
    channel, flags, dlc, can_id, _, _, fd_flags, valid, data = _FD_MESSAGE.unpack_from(body, at)
    bits = (can_frame.BRS if fd_flags & 2 else 0) | (can_frame.ESI if fd_flags & 4 else 0)
    frame = _either(_can_id(can_id), flags & _REMOTE, fd_flags & 1, bits, dlc, data[:valid])
    return channel, frame, _way(flags & _SENT)


def _fd_message_64(body: bytes, at: int) -> _Told:
    told = _FD_MESSAGE_64.unpack_from(body, at)
    channel, dlc, valid, can_id, flags, sent, extra = (told[n] for n in (0, 1, 2, 4, 6, 12, 13))
    begin = at + _FD_MESSAGE_64.size
    # More bytes can be declared valid than exist; they are zero (CANoe; python-can, issue 1905).
    data = body[begin : min(begin + valid, extra or len(body))].ljust(valid, b"\0")
    bits = (can_frame.BRS if flags & 0x2000 else 0) | (can_frame.ESI if flags & 0x4000 else 0)
    frame = _either(_can_id(can_id), flags & 0x10, flags & 0x1000, bits, dlc, data)
    return channel, frame, _way(sent)


def _either(can_id: int, remote: int, fd: int, bits: int, dlc: int, data: bytes) -> bytes:
    if remote:
        return can_frame.remote(can_id, min(dlc, 8))
    return can_frame.flexible(can_id, bits, data) if fd else can_frame.classic(can_id, data)


def _error(body: bytes, at: int) -> _Told:
    told = _ERROR.unpack_from(body, at)
    channel, flags, can_id, core, data = told[0], told[2], told[7], told[8], told[9]
    frame = can_frame.classic(can_frame.ERR | can_id & can_frame.EFF_MASK, data)
    return channel, frame, _way(core & _CORE_SENT) if flags & _CORE_TOLD else Direction.UNKNOWN


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
            kind, body = _object(can_frame.fields(data), direction, channel)
            size = _OBJECT_OUT.size + len(body)  # always a multiple of 4, so no padding
            self._content += _OBJECT_OUT.pack(
                _OBJECT, 32, 1, size, kind, _NANOSECONDS, 0, 0, since_ns
            )
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
        self._file.write(_HEAD.pack(MAGIC, _HEAD.size, *program, *sizes, *times))
        self._file.seek(0, 2)

    def _put(self, content: bytearray) -> None:
        data = zlib.compress(content)
        size = _CONTAINER_OUT.size + len(data)
        head = _CONTAINER_OUT.pack(_OBJECT, 16, 1, size, _CONTAINER_KIND, _ZLIB, len(content))
        padding = bytes(size % 4)  # the format's own rule: size modulo 4
        self._file.write(head + data + padding)
        self._size += size + len(padding)
        self._plain_size += _CONTAINER_OUT.size + len(content)


def _object(told: Fields, direction: Direction, channel: int) -> tuple[int, bytes]:
    """Return the kind and the content of the object for a frame."""
    sent = direction is Direction.TRANSMITTED
    if told.can_id & can_frame.ERR:
        return _ERROR_KIND, _error_frame(told, direction, channel)
    can_id = told.identifier | (_EXTENDED if told.can_id & can_frame.EFF else 0)
    flags = (_REMOTE if told.can_id & can_frame.RTR else 0) | (_SENT if sent else 0)
    if not told.fd:
        return _MESSAGE_KIND, _MESSAGE.pack(channel, flags, told.length, can_id, told.data)
    dlc = can_frame.dlc(told.length)
    bits = 1 | (2 if told.flags & can_frame.BRS else 0) | (4 if told.flags & can_frame.ESI else 0)
    body = _FD_MESSAGE.pack(channel, flags, dlc, can_id, 0, 0, bits, told.length, told.data)
    return _FD_KIND, body


def _error_frame(told: Fields, direction: Direction, channel: int) -> bytes:
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
