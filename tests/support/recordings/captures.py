"""Hand-made captures, from the pcap and pcapng drafts and the RFCs of their contents."""

import struct

from motorhil.traces.formats.pcap import Packet
from motorhil.traces.formats.tcp import Way

SYN = 0x02
ACK = 0x10


def pcap(packets, order="<", magic=0xA1B2C3D4, link_type=1, snap=65535):
    """Return a pcap file; packets are (seconds, fraction, data) or (.., original length)."""
    out = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, snap, link_type)
    for seconds, fraction, data, *original in packets:
        length = original[0] if original else len(data)
        out += struct.pack(order + "IIII", seconds, fraction, len(data), length) + data
    return out


def block(kind, body, order="<"):
    """Return a pcapng block."""
    body += bytes(-len(body) % 4)
    size = struct.pack(order + "I", len(body) + 12)
    return struct.pack(order + "I", kind) + size + body + size


def section(order="<"):
    """Return a pcapng section header of unknown length."""
    return block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1), order)


def interface(link_type=1, options=b"", order="<"):
    """Return a pcapng interface description."""
    return block(1, struct.pack(order + "HHI", link_type, 0, 65535) + options, order)


def enhanced(time, data, which=0, order="<"):
    """Return a pcapng enhanced packet."""
    head = struct.pack(order + "IIIII", which, time >> 32, time & 0xFFFFFFFF, len(data), len(data))
    return block(6, head + data, order)


def ip4(tcp, source="10.0.0.1", target="10.0.0.2", kind=6, fragment=0):
    """Return an IPv4 packet with an unused check sum."""
    addresses = b"".join(bytes(map(int, text.split("."))) for text in (source, target))
    head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(tcp), 0, fragment, 64, kind, 0)
    return head + addresses + tcp


def ip6(tcp):
    """Return an IPv6 packet with a hop-by-hop header before TCP."""
    extension = b"\x06\x00" + bytes(6)
    head = struct.pack(">IHBB", 0x60000000, len(extension + tcp), 0, 64)
    return head + bytes(15) + b"\x01" + bytes(15) + b"\x02" + extension + tcp


def tcp(sequence, data, flags=ACK, source=40000, target=502, options=b""):
    """Return a TCP segment."""
    offset = (20 + len(options)) // 4 << 4
    head = struct.pack(">HHIIBBHHH", source, target, sequence % 2**32, 0, offset, flags, 0, 0, 0)
    return head + options + data


def ethernet(data, kind=0x0800, tags=b""):
    """Return an Ethernet frame."""
    return bytes(12) + tags + kind.to_bytes(2, "big") + data


def packet(number, data, link_type=1):
    """Return a packet captured at `number` milliseconds."""
    return Packet(number, number * 1_000_000, link_type, data, 0)


THERE = Way("10.0.0.1", 40000, "10.0.0.2", 502)
