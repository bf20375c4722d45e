"""Captures made by hand, from the drafts of pcap and pcapng and the RFCs of what is in them."""

import struct

from traces.pcap import Packet
from traces.tcp_streams import Way

SYN = 0x02
ACK = 0x10


def pcap(packets, order="<", magic=0xA1B2C3D4, link_type=1, snap=65535):
    """A pcap file; packets are (seconds, fraction, data) or (.., original length)."""
    out = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, snap, link_type)
    for seconds, fraction, data, *original in packets:
        length = original[0] if original else len(data)
        out += struct.pack(order + "IIII", seconds, fraction, len(data), length) + data
    return out


def block(kind, body, order="<"):
    """A pcapng block."""
    body += bytes(-len(body) % 4)
    size = struct.pack(order + "I", len(body) + 12)
    return struct.pack(order + "I", kind) + size + body + size


def section(order="<"):
    """A pcapng section header of no known length."""
    return block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1), order)


def interface(link_type=1, options=b"", order="<"):
    """A pcapng interface description."""
    return block(1, struct.pack(order + "HHI", link_type, 0, 65535) + options, order)


def enhanced(time, data, which=0, order="<"):
    """A pcapng enhanced packet."""
    head = struct.pack(order + "IIIII", which, time >> 32, time & 0xFFFFFFFF, len(data), len(data))
    return block(6, head + data, order)


def ip4(tcp, source="10.0.0.1", target="10.0.0.2", kind=6, fragment=0):
    """An IPv4 packet (its check sum is nobody's business here)."""
    addresses = b"".join(bytes(map(int, text.split("."))) for text in (source, target))
    head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(tcp), 0, fragment, 64, kind, 0)
    return head + addresses + tcp


def ip6(tcp):
    """An IPv6 packet with a hop-by-hop header in front of TCP."""
    extension = b"\x06\x00" + bytes(6)
    head = struct.pack(">IHBB", 0x60000000, len(extension + tcp), 0, 64)
    return head + bytes(15) + b"\x01" + bytes(15) + b"\x02" + extension + tcp


def tcp(sequence, data, flags=ACK, source=40000, target=502, options=b""):
    """A TCP segment."""
    offset = (20 + len(options)) // 4 << 4
    head = struct.pack(">HHIIBBHHH", source, target, sequence % 2**32, 0, offset, flags, 0, 0, 0)
    return head + options + data


def ethernet(data, kind=0x0800, tags=b""):
    """An Ethernet frame."""
    return bytes(12) + tags + kind.to_bytes(2, "big") + data


def packet(number, data, link_type=1):
    """A packet captured at that many milliseconds."""
    return Packet(number, number * 1_000_000, link_type, data, 0)


THERE = Way("10.0.0.1", 40000, "10.0.0.2", 502)
