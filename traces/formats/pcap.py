"""Packet captures: reader for pcap and pcapng, writer for pcapng.

pcap files can have microseconds or nanoseconds, in either byte order. Only pcapng has the names of
interfaces, and the directions of packets. Our own files are marked in their head (shb_userappl); in
these a packet's comment is its sender. Unreadable parts are reported with their offset, and
everything else is read. A capture that ends in the middle of a packet yields all packets before it.

Source: IETF draft-ietf-opsawg-pcap, draft-ietf-opsawg-pcapng.
"""

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, Final, NamedTuple, final

from motorhil.frozen import frozen
from motorhil.traces.errors import TraceError
from motorhil.traces.files import MEMORY_MAX, open_content
from motorhil.traces.formats.frames import log_time
from motorhil.traces.schema import Direction

MAGIC: Final = b"\x0a\x0d\x0d\x0a"
PCAP: Final = {  # by the first bytes of the file: (byte order, ns per unit of the fraction)
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
_SECTION: Final = 0x0A0D0D0A
_INTERFACE: Final = 1
_SIMPLE_PACKET: Final = 3
_ENHANCED_PACKET: Final = 6
_LITTLE: Final = b"\x4d\x3c\x2b\x1a"
_ORDERS: Final = {_LITTLE: "<", b"\x1a\x2b\x3c\x4d": ">"}
_PROGRAM: Final = b"motorhil"
# Options; their meaning depends on the block.
_COMMENT: Final = 1  # opt_comment
_NAME: Final = 2  # if_name
_FLAGS: Final = 2  # epb_flags
_PROGRAM_NAME: Final = 4  # shb_userappl
_TIME_RESOLUTION: Final = 9  # if_tsresol
_OPTION_MAX: Final = 0xFFFF
_TIME_OFFSET: Final = 14  # if_tsoffset
_WAYS: Final = (Direction.UNKNOWN, Direction.RECEIVED, Direction.TRANSMITTED, Direction.UNKNOWN)
_PACKET: Final = struct.Struct("<IIIII")
_PACKET_MAX: Final = 1 << 24
_NS: Final = 1_000_000_000


class Packet(NamedTuple):
    """One captured packet.

    Attributes:
        number: from 1, as other programs count.
        time_ns: time since 1970.
        link_type: number in IANA's registry of link types.
        data: the captured bytes.
        missing: number of bytes that were not captured.
        interface: its name in a pcapng file; None in a pcap file.
        direction: its direction, as far as the file has it.
        ours: True if we wrote the file.
        sender: its sender in a file that we wrote; None: unknown.
        order: "<" or ">", the byte order of the machine that captured.
    """

    number: int
    time_ns: int
    link_type: int
    data: bytes
    missing: int
    interface: str | None = None
    direction: Direction = Direction.UNKNOWN
    ours: bool = False
    sender: str | None = None
    order: str = ">"


@final
@frozen
class _Interface:
    name: str
    link_type: int
    units_s: int  # time stamp units per second
    offset_ns: int


@final
@dataclass(slots=True)
class _Section:
    """State that the blocks of a section need from those before them."""

    order: str
    ours: bool
    interfaces: list[_Interface]


@final
class Capture:
    """A capture file, read as a whole.

    Attributes:
        problems: unreadable parts in words, with their offsets; complete after all packets have
            been read.

    Raises:
        TraceError: the file cannot be opened, or is not a capture.
    """

    def __init__(self, path: str | os.PathLike[str], memory_max: int = MEMORY_MAX) -> None:
        self.path: Final = os.fspath(path)
        self.problems: list[str] = []
        with open_content(self.path, self.problems.append, memory_max) as file:
            self._data = file.read()
        start = self._data[:4]
        if start not in PCAP and start != MAGIC:
            begins = start.hex(" ").upper() or "nothing"
            remedy = "give a capture of tcpdump, tshark or Wireshark"
            raise TraceError(
                self.path, f"is neither pcap nor pcapng (begins with {begins})", remedy=remedy
            )

    def packets(self) -> Iterator[Packet]:
        """Return all packets, in file order."""
        self.problems.clear()
        kind = PCAP.get(self._data[:4])
        return self._blocks() if kind is None else self._records(*kind)

    def _problem(self, at: int, what: str) -> None:
        self.problems.append(f"{self.path}: byte {at}: {what}")

    # ---- pcap ----

    def _records(self, order: str, fraction_ns: int) -> Iterator[Packet]:
        data = self._data
        if len(data) < 24:
            self._problem(len(data), "ends within its header")
            return
        link_type = struct.unpack_from(order + "I", data, 20)[0] & 0xFFFF
        head = struct.Struct(order + "IIII")
        at, number = 24, 0
        while at < len(data):
            if at + head.size > len(data):
                self._problem(at, "ends within the head of a packet")
                return
            seconds, fraction, size, original = head.unpack_from(data, at)
            if size > _PACKET_MAX:
                self._problem(at, f"a packet of {size} bytes: the file is damaged here")
                return
            begin, at = at + head.size, at + head.size + size
            if at > len(data):
                self._problem(begin, f"ends {at - len(data)} bytes before the end of a packet")
                return
            number += 1
            time_ns = seconds * _NS + fraction * fraction_ns
            missing = max(0, original - size)
            yield Packet(number, time_ns, link_type, data[begin:at], missing, order=order)

    # ---- pcapng ----

    def _blocks(self) -> Iterator[Packet]:
        data = self._data
        section = _Section("<", False, [])
        at, number = 0, 0
        while at < len(data):
            if at + 12 > len(data):
                self._problem(at, "ends within the head of a block")
                return
            is_section = data[at : at + 4] == MAGIC
            if is_section:
                order = _ORDERS.get(data[at + 8 : at + 12])
                if order is None:
                    self._problem(at, "a section with an unknown byte order")
                    return
                section = _Section(order, False, [])
            kind, size = struct.unpack_from(section.order + "II", data, at)
            if size < 12 or size % 4 or size > _PACKET_MAX + 64:
                self._problem(at, f"a block of {size} bytes: the file is damaged here")
                return
            if at + size > len(data):
                self._problem(at, f"ends {at + size - len(data)} bytes before the end of a block")
                return
            body = data[at + 8 : at + size - 4]
            if is_section:
                section.ours = _option(body[16:], _PROGRAM_NAME, section.order) == _PROGRAM
            elif kind == _INTERFACE:
                number_of_it = len(section.interfaces)
                section.interfaces.append(_interface(body, section.order, number_of_it))
            elif kind in (_ENHANCED_PACKET, _SIMPLE_PACKET):
                packet = self._packet(kind, body, section, number + 1, at)
                if packet is not None:
                    number += 1
                    yield packet
            at += size

    def _packet(
        self, kind: int, body: bytes, section: _Section, number: int, at: int
    ) -> Packet | None:
        order = section.order
        if kind == _SIMPLE_PACKET:
            which, time_ns, begin = 0, 0, 4
            original = struct.unpack_from(order + "I", body)[0] if len(body) >= 4 else 0
            size = min(original, len(body) - 4)
        else:
            if len(body) < 20:
                self._problem(at, "a packet without a head")
                return None
            which, high, low, size, original = struct.unpack_from(order + "IIIII", body)
            begin, time_ns = 20, high << 32 | low
        if which >= len(section.interfaces) or begin + size > len(body):
            self._problem(at, f"a packet of interface {which}, {size} bytes: not in this file")
            return None
        interface = section.interfaces[which]
        way, sender = Direction.UNKNOWN, None
        if kind == _ENHANCED_PACKET:
            try:
                time_ns = log_time(time_ns * _NS // interface.units_s + interface.offset_ns)
            except ValueError as error:
                self._problem(at, str(error))
                return None
            options = body[20 + (size + 3 & ~3) :]
            flags = _option(options, _FLAGS, order)
            if flags is not None and len(flags) == 4:
                way = _WAYS[struct.unpack(order + "I", flags)[0] & 3]
            comment = _option(options, _COMMENT, order) if section.ours else None
            sender = None if comment is None else comment.decode("utf-8", errors="replace")
        data, missing = body[begin : begin + size], max(0, original - size)
        return Packet(
            *(number, time_ns, interface.link_type, data, missing),
            *(interface.name, way, section.ours, sender, order),
        )


def _interface(body: bytes, order: str, number: int) -> _Interface:
    link_type = struct.unpack_from(order + "H", body)[0] if len(body) >= 2 else 0
    name = _option(body[8:], _NAME, order)
    resolution = _option(body[8:], _TIME_RESOLUTION, order)
    offset = _option(body[8:], _TIME_OFFSET, order)
    units_s = 1_000_000
    if resolution:
        base, exponent = (2, resolution[0] & 0x7F) if resolution[0] & 0x80 else (10, resolution[0])
        units_s = int(base**exponent)
    offset_s = struct.unpack(order + "q", offset)[0] if offset and len(offset) == 8 else 0
    told = f"can{number}" if name is None else name.decode("utf-8", errors="replace")
    return _Interface(told, link_type, units_s, offset_s * _NS)


def _option(options: bytes, wanted: int, order: str) -> bytes | None:
    at = 0
    while at + 4 <= len(options):
        code, length = struct.unpack_from(order + "HH", options, at)
        if code == wanted:
            return options[at + 4 : at + 4 + length]
        if code == 0:
            break
        at += 4 + (length + 3 & ~3)
    return None


@final
class PcapngWriter:
    """Writer of packets with nanosecond stamps."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._interfaces = 0
        self._ends: dict[tuple[Direction, str | None], bytes] = {}
        head = struct.pack("<4sHHq", _LITTLE, 1, 0, -1)
        self._block(_SECTION, head + _packed(_PROGRAM_NAME, _PROGRAM) + _packed(0, b""))

    def interface(self, link_type: int, name: str) -> int:
        """Write a new interface, and return its number.

        Raises:
            TraceError: the name is too long for the format.
        """
        options = self._text(_NAME, name) + _packed(_TIME_RESOLUTION, b"\x09") + _packed(0, b"")
        self._block(_INTERFACE, struct.pack("<HHI", link_type, 0, 0) + options)
        self._interfaces += 1
        return self._interfaces - 1

    def packet(
        self, which: int, time_ns: int, data: bytes, direction: Direction, sender: str | None
    ) -> None:
        """Write a packet of an interface; `sender` None: unknown.

        Raises:
            TraceError: the sender's name is too long for the format.
        """
        end = self._ends.get((direction, sender))
        if end is None:
            out = b"" if sender is None else self._text(_COMMENT, sender)
            if direction:
                out += _packed(_FLAGS, struct.pack("<I", direction))
            end = self._ends[direction, sender] = out and out + _packed(0, b"")
        size = len(data)
        head = _PACKET.pack(which, time_ns >> 32, time_ns & 0xFFFF_FFFF, size, size)
        self._block(_ENHANCED_PACKET, head + data + bytes(-size % 4) + end)

    def _text(self, code: int, text: str) -> bytes:
        data = text.encode()
        if len(data) > _OPTION_MAX:
            raise TraceError(
                self._file.name,
                f"pcapng cannot hold the name '{text[:20]}...' of {len(data)} bytes; expected at "
                f"most {_OPTION_MAX}",
                remedy="write mcap",
            )
        return _packed(code, data)

    def _block(self, kind: int, body: bytes) -> None:
        size = struct.pack("<I", len(body) + 12)
        self._file.write(struct.pack("<I", kind) + size + body + size)


def _packed(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4)
