"""Modbus in packet captures: ADUs read from them, and recorded lines written as pcapng.

On TCP a line is a server's address. The application is assumed to be the client, so requests are
sent and responses received. Senders are named by address and port. Captures that we wrote contain
the names of both, and serial lines as well.

Written TCP traffic becomes segments to and from port 502, one ADU each, with correct sequence
numbers and check sums. The beginning of a connection is not in a recording and is not invented. A
line or a sender whose name is not an address gets a private address; the names are stored as well.
Serial traffic becomes events of link type 250, whose contents Wireshark must be told: decode
`rtacser.data` as Modbus RTU (tshark -d rtacser.data,mbrtu).

Source: RFC 791, 8200, 9293; LINKTYPE_RTAC_SERIAL, tcpdump.org, events as Wireshark names them;
draft-ietf-opsawg-pcapng.
"""

import struct
from collections import deque
from collections.abc import Iterator
from enum import Flag, auto
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import BinaryIO, Final, NamedTuple, final

from motorhil.traces.files import MEMORY_MAX
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.modbus import Adu, Malformed, RecordedAdu, adus
from motorhil.traces.formats.pcap import Capture, Packet, PcapngWriter
from motorhil.traces.formats.tcp import Way, pieces
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.protobuf import Value, decode, encode
from motorhil.traces.schema import MODBUS_ADU, Direction, Schema

_ETHERNET: Final = 1
RTAC_SERIAL: Final = 250
RTAC_HEAD: Final = struct.Struct(">IIBBH")  # s, us, event, control lines, unused
RTAC_EVENTS: Final = {Direction.TRANSMITTED: 3, Direction.RECEIVED: 4}  # DATA_TX_END, DATA_RX_END
PORT: Final = 502
_FIRST_PORT: Final = 49_152
_PSH_ACK: Final = 0x18
_NOT_TO_BE_CUT: Final = 0x4000
_TCP: Final = 6
_HEAD: Final = 7
_LENGTH_MAX: Final = 254
_PREFIX: Final = "/modbus/"
_BATCH: Final = 8192
_EVENTS: Final = {1: Direction.TRANSMITTED, 2: Direction.RECEIVED} | {
    event: direction for direction, event in RTAC_EVENTS.items()
}
_Address = IPv4Address | IPv6Address


@final
class AduFeature(Flag):
    """A feature of a recorded ADU that a capture cannot store."""

    BIT_TIMES = auto()  # times of the first and the last bit
    SPOILED = auto()


class _End(NamedTuple):
    address: _Address
    port: int

    def __str__(self) -> str:
        return f"{self.address}:{self.port}"


@final
class _Line:
    """A TCP line: its interface, its server, and the traffic between it and each client."""

    def __init__(self, interface: int, server: _End) -> None:
        self.interface = interface
        self.server = server
        self.clients: dict[str, _End] = {}
        self.sent: dict[
            tuple[_End, bool], int
        ] = {}  # bytes, by client and direction (True: to the server)
        self.asked: dict[int, _End] = {}  # the last user of each transaction identifier
        self.last: _End | None = None


@final
class ModbusExport:
    """Writes ADUs in the given order.

    Attributes:
        lost: number of ADUs by feature that cannot be stored.
    """

    def __init__(self, file: BinaryIO, findings: Findings) -> None:
        self.lost: dict[AduFeature, int] = {}
        self._out = PcapngWriter(file)
        self._findings = findings
        self._lines: dict[str, _Line] = {}
        self._serial: dict[str, int] = {}
        self._used: set[tuple[_End, _End]] = set()  # server and client of each connection

    @property
    def lines(self) -> tuple[str, ...]:
        """The lines written so far."""
        return (*self._lines, *self._serial)

    def add(self, adus: Iterator[RecordedAdu]) -> None:
        """Write these ADUs; report those that cannot be written as problems."""
        for number, (time_ns, name, payload) in enumerate(adus, 1):
            try:
                self._add(time_ns, name, payload)
            except ValueError as error:
                self._findings.problem(number, f"{name}: {error}")

    def _add(self, time_ns: int, name: str, payload: bytes) -> None:
        values = decode(MODBUS_ADU, payload)
        data, sender = values.get("data", b""), str(values.get("sender", ""))
        assert isinstance(data, bytes)
        direction = next((way for way in RTAC_EVENTS if way == values.get("direction")), None)
        if direction is None:
            raise ValueError("an ADU without a direction")
        if values.get("tcp"):
            self._on_tcp(time_ns, name, data, direction, sender)
        else:
            self._on_serial(time_ns, name, data, direction, sender)
        if {values.get("start_ns", 0), values.get("end_ns", 0)} != {time_ns}:
            self._count(AduFeature.BIT_TIMES)
        if values.get("spoiled"):
            self._count(AduFeature.SPOILED)

    def _count(self, feature: AduFeature) -> None:
        self.lost[feature] = self.lost.get(feature, 0) + 1

    # ------------------------------------------------------------------------------- serial

    def _on_serial(
        self, time_ns: int, name: str, data: bytes, direction: Direction, sender: str
    ) -> None:
        if name not in self._serial:
            self._serial[name] = self._out.interface(RTAC_SERIAL, name)
        seconds, rest_ns = divmod(time_ns, 1_000_000_000)
        event = RTAC_EVENTS[direction]
        head = RTAC_HEAD.pack(seconds & 0xFFFF_FFFF, rest_ns // 1000, event, 0, 0)
        self._out.packet(self._serial[name], time_ns, head + data, direction, sender or None)

    # ---------------------------------------------------------------------------------- TCP

    def _on_tcp(
        self, time_ns: int, name: str, data: bytes, direction: Direction, sender: str
    ) -> None:
        _check(data)
        line = self._lines.get(name)
        if line is None:
            line = self._lines[name] = self._line(name)
        to_server = direction is Direction.TRANSMITTED
        transaction = int.from_bytes(data[:2], "big")
        if to_server:
            client = line.last = line.asked[transaction] = self._client(line, sender)
            ends = client, line.server
        else:
            client = line.asked.get(transaction) or line.last or self._client(line, "")
            ends = line.server, client
        sent = line.sent.get((client, to_server), 1)
        heard = line.sent.get((client, not to_server), 1)
        line.sent[client, to_server] = (sent + len(data)) & 0xFFFF_FFFF
        packet = _ethernet(*ends, sent, heard, data)
        told = None if sender == str(ends[0]) else sender
        self._out.packet(line.interface, time_ns, packet, direction, told)

    def _line(self, name: str) -> _Line:
        try:
            address = ip_address(name)
        except ValueError:
            address = _private(0, len(self._lines))
        return _Line(self._out.interface(_ETHERNET, name), _End(address, PORT))

    def _client(self, line: _Line, sender: str) -> _End:
        """Return the client end of a sender's connection; no two connections are the same."""
        found = line.clients.get(sender)
        if found is not None:
            return found
        server = line.server
        version = server.address.version
        end = _end_called(sender)
        if end is None or end.address.version != version or (server, end) in self._used:
            end = _generated(version, len(self._used))
            while (server, end) in self._used:
                end = end._replace(port=end.port + 1)
        self._used.add((server, end))
        line.clients[sender] = end
        return end


def _end_called(sender: str) -> _End | None:
    """Return the end in a sender's name "address:port"; None if there is none."""
    host, _, port = sender.rpartition(":")
    try:
        end = _End(ip_address(host), int(port))
    except ValueError:
        return None
    return end if 0 < end.port < 1 << 16 and end.port != PORT else None


def _generated(version: int, number: int) -> _End:
    address: _Address = _private(1, number)
    if version == 6:
        address = IPv6Address((0xFD << 120) + (1 << 64) + number + 1)
    return _End(address, _FIRST_PORT)


def _check(data: bytes) -> None:
    """Raise ValueError if a stream reader would misinterpret the ADU."""
    length = int.from_bytes(data[4:6], "big")
    if len(data) <= _HEAD or data[2:4] != b"\0\0" or not 2 <= length <= _LENGTH_MAX:
        raise ValueError(f"not Modbus/TCP: {data[:_HEAD].hex(' ').upper()}")
    if len(data) != 6 + length:
        raise ValueError(f"{len(data) - 6} bytes of an ADU of {length}")


def _private(kind: int, number: int) -> IPv4Address:
    """Return 10.kind.x.y: kind 0 for servers, kind 1 for clients."""
    return IPv4Address((10 << 24) + (kind << 16) + number % 65_000 + 1)


def _ethernet(source: _End, target: _End, sequence: int, heard: int, data: bytes) -> bytes:
    """Return a segment with its IP and Ethernet headers."""
    size = 20 + len(data)
    ends = source.address.packed + target.address.packed
    head = struct.pack(
        *(">HHIIBBHHH", source.port, target.port, sequence, heard, 5 << 4, _PSH_ACK, 0xFFFF, 0, 0)
    )
    pseudo = ends + struct.pack(">II", size, _TCP)
    check = _check_sum(pseudo + head + data)
    segment = head[:16] + check.to_bytes(2, "big") + head[18:] + data
    if source.address.version == 4:
        kind = 0x0800
        ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + size, 0, _NOT_TO_BE_CUT, 64, _TCP, 0) + ends
        ip = ip[:10] + _check_sum(ip).to_bytes(2, "big") + ip[12:]
    else:
        kind = 0x86DD
        ip = struct.pack(">IHBB", 6 << 28, size, _TCP, 64) + ends
    return _mac(target) + _mac(source) + kind.to_bytes(2, "big") + ip + segment


def _mac(end: _End) -> bytes:
    """Return a locally administered MAC address, derived from the IP address."""
    return b"\x02\x00" + end.address.packed[-4:]


def _check_sum(data: bytes) -> int:
    """Return the internet check sum (RFC 1071)."""
    data += bytes(len(data) % 2)
    words: tuple[int, ...] = struct.unpack(f">{len(data) // 2}H", data)
    total = sum(words)
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


def captured_adus(
    path: str, findings: Findings, memory_max: int = MEMORY_MAX
) -> Iterator[RecordedAdu]:
    """Yield the ADUs of a capture, in order of their completion.

    Raises:
        TraceError: the file cannot be read, or is not a capture.
    """
    for one in _Reader(path, findings, memory_max).adus():
        findings.frames += 1
        yield one


@final
class _Reader:
    def __init__(self, path: str, findings: Findings, memory_max: int) -> None:
        self._path = path
        self._findings = findings
        self._capture = Capture(path, memory_max)
        self._ours: dict[int, tuple[str, str | None]] = {}  # line and sender, by packet
        self._serial: deque[Packet] = deque()

    def adus(self) -> Iterator[RecordedAdu]:
        """Yield the ADUs in the order of the packets that completed them."""
        for adu in adus(pieces(self._packets())):
            yield from self._from_serial_lines(adu.packet)
            if isinstance(adu, Malformed):
                self._findings.problem(adu.packet, f"{adu.way}: {adu.problem}")
            elif adu.way is not None:
                yield self._from_tcp(adu, adu.way)
        yield from self._from_serial_lines(0)
        for problem in self._capture.problems:
            self._findings.problem(0, problem.removeprefix(f"{self._path}: "))

    def _packets(self) -> Iterator[Packet]:
        """Yield possible TCP packets; queue those of serial lines."""
        for packet in self._capture.packets():
            if packet.link_type == RTAC_SERIAL:
                self._serial.append(packet)
            else:
                if packet.ours and packet.interface is not None:
                    self._ours[packet.number] = packet.interface, packet.sender
                yield packet

    def _from_tcp(self, adu: Adu, way: Way) -> RecordedAdu:
        data = adu.transaction.to_bytes(2, "big") + bytes(2)
        data += (len(adu.pdu) + 1).to_bytes(2, "big") + bytes((adu.unit,)) + adu.pdu
        line = way.target if adu.to_server else way.source
        sender = f"{way.source}:{way.source_port}"
        if adu.packet in self._ours:
            line, own = self._ours[adu.packet]
            sender = sender if own is None else own
        direction = Direction.TRANSMITTED if adu.to_server else Direction.RECEIVED
        return _recorded(adu.time_ns, line, direction, sender, data, tcp=True)

    def _from_serial_lines(self, before: int) -> Iterator[RecordedAdu]:
        """Yield the queued serial ADUs before this packet; 0: all of them."""
        while self._serial and (self._serial[0].number < before or not before):
            packet = self._serial.popleft()
            if len(packet.data) < RTAC_HEAD.size:
                what = f"{len(packet.data)} bytes are not an event of a serial line"
                self._findings.problem(packet.number, what)
                continue
            event = RTAC_HEAD.unpack_from(packet.data)[2]
            direction = _EVENTS.get(event)
            data = packet.data[RTAC_HEAD.size :]
            if direction is None or not data:
                self._findings.note("events of a serial line without data are omitted")
                continue
            line = "serial0" if packet.interface is None else packet.interface
            sender = packet.sender or ""
            yield _recorded(packet.time_ns, line, direction, sender, data, tcp=False)


def _recorded(
    time_ns: int, line: str, direction: Direction, sender: str, data: bytes, *, tcp: bool
) -> RecordedAdu:
    values: dict[str, Value] = {"direction": int(direction)}
    if sender:
        values["sender"] = sender
    values |= {"start_ns": time_ns, "end_ns": time_ns}
    if tcp:
        values["tcp"] = True
    values["data"] = data
    return RecordedAdu(time_ns, line, encode(MODBUS_ADU, values))


def record_adus(
    target: str | BinaryIO, found: Iterator[RecordedAdu], metadata: dict[str, dict[str, str]]
) -> tuple[str, ...]:
    """Record these ADUs in this order; return the lines.

    Raises:
        TraceError: the recording cannot be written.
    """
    channels: dict[str, int] = {}
    with TraceWriter(target, metadata) as writer:
        entries: list[tuple[int, int, bytes]] = []
        for time_ns, line, payload in found:
            if line not in channels:
                channels[line] = writer.channel(_PREFIX + line, Schema.of(MODBUS_ADU))
            entries.append((-channels[line], time_ns, payload))
            if len(entries) >= _BATCH:
                writer.extend(entries)
                entries = []
        writer.extend(entries)
    return tuple(channels)
