"""Reader for packet captures: pcap and pcapng.

pcap files can have microseconds or nanoseconds, in either byte order. Unreadable parts are reported
with their offset, and everything else is read. A capture that ends in the middle of a packet yields
all packets before it.

Source: IETF draft-ietf-opsawg-pcap, draft-ietf-opsawg-pcapng.

pcapng: interface names, directions and senders of packets; writer.

Our files are marked in their head (shb_userappl). In these a packet's comment is its sender.

Source: draft-ietf-opsawg-pcapng.

Byte streams of TCP connections, reassembled from captured packets.

Retransmissions are removed, and packets that arrived out of order are sorted. Missing bytes (not
captured, or the capture began in the middle of a connection) are reported as a gap, and the stream
continues after it.

Source: RFC 791, RFC 8200, RFC 9293; the link types of the IANA registry.
"""

import os
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, final

from motorhil.traces.errors import TraceError
from motorhil.traces.schema import Direction

_PCAP: Final = {  # by the first bytes of the file: (byte order, ns per unit of the fraction)
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
_SECTION: Final = 0x0A0D0D0A
_INTERFACE: Final = 1
_SIMPLE_PACKET: Final = 3
_ENHANCED_PACKET: Final = 6
_ORDERS: Final = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}
_TIME_RESOLUTION: Final = 9
_TIME_OFFSET: Final = 14
_PACKET_MAX: Final = 1 << 24
_NS: Final = 1_000_000_000


@final
@dataclass(frozen=True, slots=True)
class Packet:
    """One captured packet.

    Attributes:
        number: from 1, as other programs count.
        time_ns: time since 1970.
        link_type: number in IANA's registry of link types.
        data: the captured bytes.
        missing: number of bytes that were not captured.
    """

    number: int
    time_ns: int
    link_type: int
    data: bytes
    missing: int


@final
@dataclass(frozen=True, slots=True)
class _Interface:
    link_type: int
    units_s: int  # time stamp units per second
    offset_ns: int


@final
class Capture:
    """A capture file, read as a whole.

    Attributes:
        problems: unreadable parts in words, with their offsets; complete after all packets have
            been read.

    Raises:
        TraceError: the file cannot be opened, or is not a capture.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path: Final = os.fspath(path)
        self.problems: list[str] = []
        try:
            self._data = Path(path).read_bytes()
        except OSError as error:
            raise TraceError(self.path, str(error.strerror)) from error
        start = self._data[:4]
        if start not in _PCAP and start != b"\x0a\x0d\x0d\x0a":
            begins = start.hex(" ").upper() or "nothing"
            remedy = "give a capture of tcpdump, tshark or Wireshark"
            raise TraceError(
                self.path, f"is neither pcap nor pcapng (begins with {begins})", remedy=remedy
            )

    def packets(self) -> Iterator[Packet]:
        """Return all packets, in file order."""
        self.problems.clear()
        kind = _PCAP.get(self._data[:4])
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
            yield Packet(number, time_ns, link_type, data[begin:at], missing)

    # ---- pcapng ----

    def _blocks(self) -> Iterator[Packet]:
        data, order = self._data, "<"
        interfaces: list[_Interface] = []
        at, number = 0, 0
        while at < len(data):
            if at + 12 > len(data):
                self._problem(at, "ends within the head of a block")
                return
            if data[at : at + 4] == b"\x0a\x0d\x0d\x0a":
                found = _ORDERS.get(data[at + 8 : at + 12])
                if found is None:
                    self._problem(at, "a section with an unknown byte order")
                    return
                order, interfaces = found, []
            kind, size = struct.unpack_from(order + "II", data, at)
            if size < 12 or size % 4 or size > _PACKET_MAX + 64:
                self._problem(at, f"a block of {size} bytes: the file is damaged here")
                return
            if at + size > len(data):
                self._problem(at, f"ends {at + size - len(data)} bytes before the end of a block")
                return
            body = data[at + 8 : at + size - 4]
            if kind == _INTERFACE:
                interfaces.append(_interface(body, order))
            elif kind in (_ENHANCED_PACKET, _SIMPLE_PACKET):
                packet = self._packet(kind, body, order, interfaces, number + 1, at)
                if packet is not None:
                    number += 1
                    yield packet
            at += size

    def _packet(
        self,
        kind: int,
        body: bytes,
        order: str,
        interfaces: list[_Interface],
        number: int,
        at: int,
    ) -> Packet | None:
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
        if which >= len(interfaces) or begin + size > len(body):
            self._problem(at, f"a packet of interface {which}, {size} bytes: not in this file")
            return None
        interface = interfaces[which]
        if kind == _ENHANCED_PACKET:
            time_ns = time_ns * _NS // interface.units_s + interface.offset_ns
        data = body[begin : begin + size]
        return Packet(number, time_ns, interface.link_type, data, max(0, original - size))


def _interface(body: bytes, order: str) -> _Interface:
    link_type = struct.unpack_from(order + "H", body)[0] if len(body) >= 2 else 0
    units_s, offset_ns, at = 1_000_000, 0, 8
    while at + 4 <= len(body):
        code, length = struct.unpack_from(order + "HH", body, at)
        value = body[at + 4 : at + 4 + length]
        if code == 0:
            break
        if code == _TIME_RESOLUTION and value:
            units_s = 2 ** (value[0] & 0x7F) if value[0] & 0x80 else int(10 ** value[0])
        if code == _TIME_OFFSET and len(value) == 8:
            offset_ns = struct.unpack(order + "q", value)[0] * _NS
        at += 4 + (length + 3 & ~3)
    return _Interface(link_type, units_s, offset_ns)


MAGIC: Final = b"\x0a\x0d\x0d\x0a"
_LITTLE: Final = b"\x4d\x3c\x2b\x1a"
_PROGRAM: Final = b"motorhil"
_COMMENT: Final = 1  # option opt_comment
_NAME: Final = 2  # option if_name
_FLAGS: Final = 2  # option epb_flags
_PROGRAM_NAME: Final = 4  # option shb_userappl
_RESOLUTION: Final = 9  # option if_tsresol
_WAYS: Final = (Direction.UNKNOWN, Direction.RECEIVED, Direction.TRANSMITTED)
_PACKET: Final = struct.Struct("<IIIII")


class Origin(NamedTuple):
    """Origin of a packet: interface, direction; True if the file is ours, sender."""

    interface: str
    direction: Direction
    ours: bool = False
    sender: str | None = None


def origins(data: bytes) -> Iterator[Origin]:
    """Yield the origin of each packet of a pcapng file, while its blocks are complete."""
    if data[:4] != MAGIC:
        return
    at, order, ours = 0, "<", False
    names: list[str] = []
    while at + 12 <= len(data):
        if data[at : at + 4] == MAGIC:
            order = "<" if data[at + 8 : at + 12] == _LITTLE else ">"
            names = []
        kind, size = struct.unpack_from(order + "II", data, at)
        if size < 12 or size % 4 or at + size > len(data):
            return
        body = data[at + 8 : at + size - 4]
        if data[at : at + 4] == MAGIC:
            ours = _option(body[16:], _PROGRAM_NAME, order) == _PROGRAM
        elif kind == 1:
            name = _option(body[8:], _NAME, order)
            told = f"can{len(names)}" if name is None else name.decode("utf-8", errors="replace")
            names.append(told)
        elif kind == 3 and names:
            yield Origin(names[0], Direction.UNKNOWN, ours)
        elif kind == 6 and len(body) >= 20:
            which, captured = struct.unpack_from(order + "I8xI", body)
            if which < len(names) and 20 + captured <= len(body):
                options = body[20 + (captured + 3 & ~3) :]
                yield _origin(names[which], ours, options, order)
        at += size


def _origin(name: str, ours: bool, options: bytes, order: str) -> Origin:
    flags = _option(options, _FLAGS, order)
    way = struct.unpack(order + "I", flags)[0] & 3 if flags and len(flags) == 4 else 0
    comment = _option(options, _COMMENT, order) if ours else None
    sender = None if comment is None else comment.decode("utf-8", errors="replace")
    return Origin(name, _WAYS[way] if way < 3 else Direction.UNKNOWN, ours, sender)


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
        self._block(0x0A0D0D0A, head + _packed(_PROGRAM_NAME, _PROGRAM) + _packed(0, b""))

    def interface(self, link_type: int, name: str) -> int:
        """Write a new interface, and return its number."""
        options = _packed(_NAME, name.encode()) + _packed(_RESOLUTION, b"\x09") + _packed(0, b"")
        self._block(1, struct.pack("<HHI", link_type, 0, 0) + options)
        self._interfaces += 1
        return self._interfaces - 1

    def packet(
        self, which: int, time_ns: int, data: bytes, direction: Direction, sender: str | None
    ) -> None:
        """Write a packet of an interface; `sender` None: unknown."""
        end = self._ends.get((direction, sender))
        if end is None:
            end = self._ends[direction, sender] = _options(direction, sender)
        size = len(data)
        head = _PACKET.pack(which, time_ns >> 32, time_ns & 0xFFFF_FFFF, size, size)
        self._block(6, head + data + bytes(-size % 4) + end)

    def _block(self, kind: int, body: bytes) -> None:
        size = struct.pack("<I", len(body) + 12)
        self._file.write(struct.pack("<I", kind) + size + body + size)


def _options(direction: Direction, sender: str | None) -> bytes:
    out = b"" if sender is None else _packed(_COMMENT, sender.encode())
    if direction:
        out += _packed(_FLAGS, struct.pack("<I", direction))
    return out + _packed(0, b"") if out else out


def _packed(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4)


_ETHERNET: Final = 1
_NULL: Final = 0
_LOOP: Final = 108
_RAW: Final = (101, 12, 14)
_LINUX_COOKED: Final = 113
_LINUX_COOKED_2: Final = 276
_IPV4: Final = 0x0800
_IPV6: Final = 0x86DD
_VLAN: Final = (0x8100, 0x88A8)
_TCP: Final = 6
_EXTENSIONS: Final = (0, 43, 60)  # hop-by-hop, routing, destination options
_SYN: Final = 0x02
_SPAN: Final = 1 << 32
_HELD_MAX: Final = 64
"""The number of segments that wait for a missing one before it counts as lost."""


@final
@dataclass(frozen=True, slots=True)
class Way:
    """One direction of a connection: addresses as text, and ports."""

    source: str
    source_port: int
    target: str
    target_port: int

    @property
    def back(self) -> "Way":
        """The other direction."""
        return Way(self.target, self.target_port, self.source, self.source_port)

    def __str__(self) -> str:
        return f"{self.source}:{self.source_port} > {self.target}:{self.target_port}"


@final
@dataclass(frozen=True, slots=True)
class Piece:
    """Consecutive bytes of a stream.

    Attributes:
        way: the direction.
        time_ns: time of the packet that completed them.
        data: the bytes.
        packet: number of that packet.
        gap: number of bytes missing before them; -1: the connection begins here.
    """

    way: Way
    time_ns: int
    data: bytes
    packet: int
    gap: int


@final
class _Stream:
    """Reassembly of one direction."""

    def __init__(self) -> None:
        self.next: int | None = None  # the expected sequence number
        self.held: dict[int, tuple[int, bytes, int]] = {}  # by sequence number


def pieces(packets: Iterable[Packet]) -> Iterator[Piece]:
    """Yield the payload of all TCP connections in these packets, each direction in order."""
    streams: dict[Way, _Stream] = {}
    for packet in packets:
        found = _segment(packet)
        if found is None:
            continue
        way, sequence, flags, data = found
        stream = streams.setdefault(way, _Stream())
        if flags & _SYN:
            stream.next = (sequence + 1) % _SPAN
            stream.held.clear()
            yield Piece(way, packet.time_ns, b"", packet.number, -1)
            sequence = (sequence + 1) % _SPAN
        if data:
            if stream.next is None:
                stream.next = sequence
            yield from _take(stream, way, sequence, (packet.time_ns, data, packet.number))
    for way, stream in streams.items():
        while stream.held:
            yield from _skip(stream, way)


def _take(
    stream: _Stream, way: Way, sequence: int, arrived: tuple[int, bytes, int]
) -> Iterator[Piece]:
    assert stream.next is not None
    ahead = (sequence - stream.next) % _SPAN
    if ahead >= _SPAN // 2:  # starts before the expected byte: a retransmission, or partly new
        old = _SPAN - ahead
        time_ns, data, number = arrived
        if old >= len(data):
            return
        sequence, arrived = stream.next, (time_ns, data[old:], number)
    _hold(stream, sequence, arrived)
    yield from _in_order(stream, way, 0)
    if len(stream.held) > _HELD_MAX:
        yield from _skip(stream, way)


def _hold(stream: _Stream, sequence: int, arrived: tuple[int, bytes, int]) -> None:
    """Hold a segment; of several with the same start the longest."""
    known = stream.held.get(sequence)
    if known is None or len(known[1]) < len(arrived[1]):
        stream.held[sequence] = arrived


def _in_order(stream: _Stream, way: Way, gap: int) -> Iterator[Piece]:
    while stream.next in stream.held:
        time_ns, data, number = stream.held.pop(stream.next)
        stream.next = (stream.next + len(data)) % _SPAN
        _drop_old(stream)
        yield Piece(way, time_ns, data, number, gap)
        gap = 0


def _skip(stream: _Stream, way: Way) -> Iterator[Piece]:
    """Skip the missing bytes, and continue with the nearest segment held."""
    awaited = stream.next
    assert awaited is not None
    first = min(stream.held, key=lambda sequence: (sequence - awaited) % _SPAN)
    stream.next = first
    yield from _in_order(stream, way, (first - awaited) % _SPAN)


def _drop_old(stream: _Stream) -> None:
    """Trim or drop held segments that start before the expected byte."""
    assert stream.next is not None
    for sequence in list(stream.held):
        behind = (stream.next - sequence) % _SPAN
        if 0 < behind < _SPAN // 2:
            time_ns, data, number = stream.held.pop(sequence)
            if behind < len(data):
                _hold(stream, stream.next, (time_ns, data[behind:], number))


def _segment(packet: Packet) -> tuple[Way, int, int, bytes] | None:
    """Return direction, sequence number, flags and payload; None if not a complete TCP segment."""
    found = _network(packet)
    if found is None:
        return None
    kind, data = found
    addressed = _ipv4(data) if kind == _IPV4 else _ipv6(data) if kind == _IPV6 else None
    if addressed is None:
        return None
    source, target, tcp = addressed
    if len(tcp) < 20:
        return None
    offset = (tcp[12] >> 4) * 4
    if not 20 <= offset <= len(tcp):
        return None
    ports = int.from_bytes(tcp[0:2], "big"), int.from_bytes(tcp[2:4], "big")
    way = Way(str(ip_address(source)), ports[0], str(ip_address(target)), ports[1])
    return way, int.from_bytes(tcp[4:8], "big"), tcp[13], tcp[offset:]


def _network(packet: Packet) -> tuple[int, bytes] | None:
    """Return ethertype and payload."""
    data, link_type = packet.data, packet.link_type
    if link_type == _ETHERNET:
        at = 12
        while int.from_bytes(data[at : at + 2], "big") in _VLAN:
            at += 4
        return int.from_bytes(data[at : at + 2], "big"), data[at + 2 :]
    if link_type == _LINUX_COOKED:
        return int.from_bytes(data[14:16], "big"), data[16:]
    if link_type == _LINUX_COOKED_2:
        return int.from_bytes(data[0:2], "big"), data[20:]
    if link_type in (_NULL, _LOOP):
        data = data[4:]
    elif link_type not in _RAW:
        return None
    version = data[0] >> 4 if data else 0
    return {4: _IPV4, 6: _IPV6}.get(version, 0), data


def _ipv4(data: bytes) -> tuple[bytes, bytes, bytes] | None:
    if len(data) < 20 or data[9] != _TCP:
        return None
    head = (data[0] & 0x0F) * 4
    size = int.from_bytes(data[2:4], "big") or len(data)  # 0: segmentation offload
    is_fragment = int.from_bytes(data[6:8], "big") & 0x3FFF
    if is_fragment or head < 20:
        return None
    return data[12:16], data[16:20], data[head:size]


def _ipv6(data: bytes) -> tuple[bytes, bytes, bytes] | None:
    if len(data) < 40:
        return None
    kind, at = data[6], 40
    end = 40 + int.from_bytes(data[4:6], "big")
    while kind in _EXTENSIONS and at + 8 <= len(data):
        kind, at = data[at], at + 8 * (1 + data[at + 1])
    return (data[8:24], data[24:40], data[at:end]) if kind == _TCP else None
