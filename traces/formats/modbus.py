"""Modbus ADUs: of TCP streams, and of recorded lines.

Malformed data is reported and skipped.

Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, section 3.1.3, for the header; MODBUS
over Serial Line V1.02, section 2.5.1.2, for the check sum.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple, final

from motorhil.frozen import frozen
from motorhil.traces.formats.tcp import Piece, Way
from motorhil.traces.mcap.reader import Trace
from motorhil.traces.protobuf import Value
from motorhil.traces.schema import MODBUS_ADU, Direction

PORT: Final = 502
_HEAD: Final = 7  # bytes of an MBAP header
_LENGTH_MAX: Final = 254
_TOPIC: Final = "/modbus/"


@final
@dataclass(slots=True)  # not frozen: making a frozen one takes four times as long
class Adu:
    """One application data unit. Nobody changes it.

    Attributes:
        time_ns: the time of its completion.
        way: connection and direction; None: a serial line.
        to_server: True for a request.
        transaction: transaction identifier; 0 on a serial line.
        unit: unit identifier.
        pdu: protocol data unit.
        packet: the number of the packet that completed it; 0: none.
    """

    time_ns: int
    way: Way | None
    to_server: bool
    transaction: int
    unit: int
    pdu: bytes
    packet: int = 0

    @property
    def is_exception(self) -> bool:
        """True for an exception response."""
        return not self.to_server and len(self.pdu) >= 1 and self.pdu[0] & 0x80 != 0


@final
@frozen
class Malformed:
    """Bytes that are not an ADU.

    Attributes:
        time_ns: the time of the bytes.
        way: connection and direction; None: a line of our recordings.
        packet: the number of the packet.
        data: the bytes.
        problem: the reason, in words.
    """

    time_ns: int
    way: Way | None
    packet: int
    data: bytes
    problem: str


@final
class _Direction:
    def __init__(self) -> None:
        self.rest = b""


def adus(stream: Iterable[Piece], port: int = PORT) -> Iterator[Adu | Malformed]:
    """Yield the ADUs of TCP streams to and from servers at `port`, in order of completion.

    An invalid header (protocol not 0, length not 2 to 254) is skipped with the rest of its segment:
    most senders begin a new ADU with a new segment. Memory grows with the number of connections.
    """
    directions: dict[Way, _Direction] = {}
    for piece in stream:
        way = piece.way
        if port not in (way.source_port, way.target_port):
            continue
        direction = directions.setdefault(way, _Direction())
        if piece.gap and direction.rest:
            cut = f"{len(direction.rest)} bytes of an ADU whose end was not captured"
            yield Malformed(piece.time_ns, way, piece.packet, direction.rest, cut)
            direction.rest = b""
        rest, direction.rest = direction.rest, b""
        data = rest + piece.data
        while len(data) >= _HEAD:
            protocol = int.from_bytes(data[2:4], "big")
            length = int.from_bytes(data[4:6], "big")
            if protocol or not 2 <= length <= _LENGTH_MAX:
                if rest:  # the leftover belongs to nothing: start again with this segment
                    lost = f"{len(rest)} bytes after an ADU that do not begin another"
                    yield Malformed(piece.time_ns, way, piece.packet, rest, lost)
                    data, rest = piece.data, b""
                    continue
                problem = f"protocol {protocol}, length {length}: 0, and 2 to {_LENGTH_MAX}"
                yield Malformed(piece.time_ns, way, piece.packet, data, problem)
                data = b""
                break
            end = 6 + length
            if len(data) < end:
                break
            to_server = way.target_port == port
            transaction = int.from_bytes(data[0:2], "big")
            yield Adu(
                piece.time_ns, way, to_server, transaction, data[6], data[7:end], piece.packet
            )
            data, rest = data[end:], b""
        direction.rest = data
    for way, direction in directions.items():
        if direction.rest:
            cut = f"{len(direction.rest)} bytes of an ADU that never ended"
            yield Malformed(0, way, 0, direction.rest, cut)


def can_answer(request: Adu, response: Adu) -> bool:
    """Return True if a response has the unit and function of the request."""
    if not request.pdu or not response.pdu:
        return False
    return request.unit == response.unit and request.pdu[0] & 0x7F == response.pdu[0] & 0x7F


def adu_of(time_ns: int, data: bytes, *, tcp: bool, to_server: bool) -> Adu | Malformed:
    """Return the ADU in these bytes, with MBAP header or check sum."""
    if tcp:
        if len(data) <= _HEAD or int.from_bytes(data[4:6], "big") != len(data) - 6:
            problem = "MBAP header missing, or its length wrong"
            return Malformed(time_ns, None, 0, data, problem)
        transaction = int.from_bytes(data[0:2], "big")
        return Adu(time_ns, None, to_server, transaction, data[6], data[_HEAD:])
    if len(data) < 4:
        problem = f"{len(data)} bytes; an ADU has at least 4"
        return Malformed(time_ns, None, 0, data, problem)
    if crc16(data[:-2]) != int.from_bytes(data[-2:], "little"):
        return Malformed(time_ns, None, 0, data, "wrong CRC")
    return Adu(time_ns, None, to_server, 0, data[0], data[1:-2])


def crc16(data: bytes) -> int:
    """Return the CRC of the serial line (MODBUS over Serial Line V1.02, 6.2.2)."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRCS[(crc ^ byte) & 0xFF]
    return crc


def _shifted(crc: int) -> int:
    for _ in range(8):
        crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return crc


_CRCS: Final = [_shifted(byte) for byte in range(256)]


class RecordedAdu(NamedTuple):
    """A recorded ADU: log time [ns], line, a motorhil.ModbusAdu."""

    time_ns: int
    line: str
    payload: bytes


def all_adus(trace: Trace) -> Iterator[RecordedAdu]:
    """Yield the ADUs of all lines in recorded order."""
    for channel, time_ns, payload in trace.messages():
        if channel.schema is not None and channel.schema.name == MODBUS_ADU.name:
            yield RecordedAdu(time_ns, channel.topic.removeprefix(_TOPIC), payload)


def recorded_adu(values: Mapping[str, Value], time_ns: int) -> Adu | Malformed:
    """Return the ADU in the fields of a motorhil.ModbusAdu."""
    data = values.get("data", b"")
    assert isinstance(data, bytes)
    if values.get("spoiled"):
        return Malformed(time_ns, None, 0, data, "corrupted on the line")
    to_server = values.get("direction") == Direction.TRANSMITTED
    return adu_of(time_ns, data, tcp=bool(values.get("tcp")), to_server=to_server)
