"""Modbus ADUs from packet captures, with the time of their last packet.

On TCP a line is a server's address. The application is assumed to be the client, so requests are
sent and responses received. Senders are named by address and port. Captures that we wrote
(`ModbusExport`) contain the names of both, and serial lines as well.
"""

from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Final, final

from traces.modbus import Adu, Malformed, adus
from traces.modbus_export import RTAC_EVENTS, RTAC_HEAD, RTAC_SERIAL
from traces.modbus_records import RecordedAdu
from traces.pcap import Capture, Packet
from traces.pcapng import Origin, origins
from traces.protobuf import Value, encode
from traces.schema import MODBUS_ADU, Direction, Schema
from traces.tcp_streams import Way, pieces
from traces.traffic import Findings
from traces.writer import TraceWriter

_PREFIX: Final = "/modbus/"
_BATCH: Final = 8192
_EVENTS: Final = {1: Direction.TRANSMITTED, 2: Direction.RECEIVED} | {
    event: direction for direction, event in RTAC_EVENTS.items()
}


def captured_adus(path: str, findings: Findings) -> Iterator[RecordedAdu]:
    """Yield the ADUs of a capture, in order of their completion.

    Raises:
        TraceError: the file cannot be read, or is not a capture.
    """
    for one in _Reader(path, findings).adus():
        findings.frames += 1
        yield one


@final
class _Reader:
    def __init__(self, path: str, findings: Findings) -> None:
        self._path = path
        self._findings = findings
        self._capture = Capture(path)
        self._origins = list(origins(Path(path).read_bytes()))
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
                yield packet

    def _origin(self, packet: int) -> Origin:
        known = 0 < packet <= len(self._origins)
        return self._origins[packet - 1] if known else Origin("serial0", Direction.UNKNOWN)

    def _from_tcp(self, adu: Adu, way: Way) -> RecordedAdu:
        data = adu.transaction.to_bytes(2, "big") + bytes(2)
        data += (len(adu.pdu) + 1).to_bytes(2, "big") + bytes((adu.unit,)) + adu.pdu
        line = way.target if adu.to_server else way.source
        sender = f"{way.source}:{way.source_port}"
        origin = self._origin(adu.packet)
        if origin.ours:
            line, sender = origin.interface, sender if origin.sender is None else origin.sender
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
            origin = self._origin(packet.number)
            sender = origin.sender or ""
            yield _recorded(packet.time_ns, origin.interface, direction, sender, data, tcp=False)


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
    target: str, adus_: Iterator[RecordedAdu], metadata: dict[str, dict[str, str]]
) -> tuple[str, ...]:
    """Record these ADUs in this order; return the lines.

    Raises:
        TraceError: the recording cannot be written.
    """
    channels: dict[str, int] = {}
    with TraceWriter(target, metadata) as writer:
        entries: list[tuple[int, int, bytes]] = []
        for time_ns, line, payload in adus_:
            if line not in channels:
                channels[line] = writer.channel(_PREFIX + line, Schema.of(MODBUS_ADU))
            entries.append((-channels[line], time_ns, payload))
            if len(entries) >= _BATCH:
                writer.extend(entries)
                entries = []
        writer.extend(entries)
    return tuple(channels)
