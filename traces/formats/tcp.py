"""Byte streams of TCP connections, reassembled from captured packets.

Retransmissions are removed, and packets that arrived out of order are sorted. Missing bytes (not
captured, or the capture began in the middle of a connection) are reported as a gap, and the stream
continues after it.

Source: RFC 791, RFC 8200, RFC 9293; the link types of the IANA registry.
"""

from collections.abc import Iterable, Iterator
from ipaddress import ip_address
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.traces.formats.pcap import Packet

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
@frozen
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
@frozen
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
