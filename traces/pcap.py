"""Reader for packet captures: pcap and pcapng.

pcap files can have microseconds or nanoseconds, in either byte order. Unreadable parts are reported
with their offset, and everything else is read. A capture that ends in the middle of a packet yields
all packets before it.

Source: IETF draft-ietf-opsawg-pcap, draft-ietf-opsawg-pcapng.
"""

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from traces.errors import TraceError

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
