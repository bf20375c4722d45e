"""Passive decoder of the Modbus traffic on one line, into sentences and facts.

Source: MODBUS Application Protocol Specification V1.1b3, sections 6 (function codes) and 7
(exception codes). Addresses are those of the PDU, from 0.

Recorded Modbus traffic: ADUs of TCP streams and serial lines, paired.

This passive decoder is independent of the other ones. Malformed data is reported and skipped.

Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, section 3.1.3; MODBUS over Serial
Line V1.02, section 2.5.1.

ADUs of the Modbus lines in our recordings.

Source: MODBUS over Serial Line V1.02, section 2.5.1.2 for the check sum; the Messaging on TCP/IP
guide V1.0b, section 3.1.3 for the header.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple, final

from motorhil.traces.decoding.events import DecodedEvent, Fact, Kind
from motorhil.traces.formats.pcap import Piece, Way
from motorhil.traces.mcap.reader import Trace
from motorhil.traces.protobuf import Value, decode
from motorhil.traces.schema import MODBUS_ADU, Direction

PORT: Final = 502
_HEAD: Final = 7
_LENGTH_MAX: Final = 254


@final
@dataclass(frozen=True, slots=True)
class Adu:
    """One application data unit.

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
@dataclass(frozen=True, slots=True)
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


@final
@dataclass(frozen=True, slots=True)
class Exchange:
    """A request and its response.

    Attributes:
        request: the request.
        response: the response; None: none was seen.
        reused: True if the transaction identifier was reused before a response.
    """

    request: Adu
    response: Adu | None
    reused: bool = False

    @property
    def delay_s(self) -> float | None:
        """Time from request to response [s]; None: no response."""
        if self.response is None:
            return None
        return (self.response.time_ns - self.request.time_ns) / 1e9


@final
@dataclass(frozen=True, slots=True)
class Pairing:
    """Requests with their responses, in the order of the requests, and unsolicited responses."""

    exchanges: tuple[Exchange, ...]
    strays: tuple[Adu, ...]

    @property
    def answered(self) -> int:
        """The number of requests with a response."""
        return sum(exchange.response is not None for exchange in self.exchanges)

    @property
    def reused(self) -> int:
        """The number of unanswered requests whose transaction identifier was reused."""
        return sum(exchange.reused for exchange in self.exchanges)


def paired(found: Iterable[Adu | Malformed]) -> Pairing:
    """Pair each request with the next response of its connection and transaction identifier.

    Responses can come in any order. On a serial line, which has no transactions, the response is
    the next ADU from the unit addressed.
    """
    pending: dict[tuple[Way | None, int], int] = {}
    exchanges: list[Exchange] = []
    strays: list[Adu] = []
    for adu in found:
        if isinstance(adu, Malformed):
            continue
        way = adu.way if adu.to_server or adu.way is None else adu.way.back
        key = (way, adu.transaction)
        if adu.to_server:
            before = pending.get(key)
            if before is not None:
                exchanges[before] = Exchange(exchanges[before].request, None, reused=True)
            pending[key] = len(exchanges)
            exchanges.append(Exchange(adu, None))
            continue
        place = pending.get(key)
        if place is None or not _can_answer(exchanges[place].request, adu):
            strays.append(adu)
            continue
        del pending[key]
        exchanges[place] = Exchange(exchanges[place].request, adu)
    return Pairing(tuple(exchanges), tuple(strays))


def _can_answer(request: Adu, response: Adu) -> bool:
    if not request.pdu or not response.pdu:
        return False
    return request.unit == response.unit and request.pdu[0] & 0x7F == response.pdu[0] & 0x7F


EXCEPTIONS: Final = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target device failed to respond",
}
_READS: Final = {1: "coil", 2: "discrete input", 3: "register", 4: "input register"}
_OTHERS: Final = {
    7: "read exception status",
    8: "diagnostics",
    11: "get communication event counter",
    12: "get communication event log",
    17: "report server ID",
    20: "read file record",
    21: "write file record",
    24: "read FIFO queue",
    43: "encapsulated interface",
}


@final
class ModbusDecoder:
    """Decoder of one line, or of all connections of one channel; ADUs in recorded order."""

    def __init__(self, unit_names: Mapping[int, str] | None = None) -> None:
        """Create a decoder with the names of units."""
        self._names = dict(unit_names or {})
        self._pending: dict[tuple[Way | None, int], Adu] = {}

    def call(self, unit: int, name: str) -> None:
        """Set the name of a unit that has none yet."""
        self._names.setdefault(unit, name)

    def forget_requests(self) -> None:
        """Abandon all pending requests, because ADUs are missing from here on."""
        self._pending.clear()

    def decode(self, adu: Adu) -> DecodedEvent:
        """Decode an ADU: a request, or a response together with its request."""
        way = adu.way if adu.to_server or adu.way is None else adu.way.back
        key = (way, adu.transaction)
        if adu.to_server:
            self._pending[key] = adu
            broadcast = adu.unit == 0 and adu.way is None  # a broadcast is not answered
            facts = _written(adu.pdu, adu.pdu) if broadcast else ()
            text = f"Modbus to {self._name(adu.unit)}: {_request_text(adu.pdu)}"
            return DecodedEvent(Kind.MODBUS_REQUEST, adu.unit, text, facts)
        asked = self._pending.get(key)
        found = paired([asked, adu]).exchanges if asked is not None else ()
        name = self._name(adu.unit)
        if not found or found[0].response is None:
            text = f"Modbus {name}: response without a request: {_hex(adu.pdu)}"
            return DecodedEvent(Kind.MODBUS_RESPONSE, adu.unit, text)
        del self._pending[key]
        request, delay_s = found[0].request, found[0].delay_s or 0.0
        late = f" (after {delay_s * 1e3:.3f} ms)"
        if adu.is_exception:
            code = adu.pdu[1] if len(adu.pdu) > 1 else 0
            words = EXCEPTIONS.get(code, "a non-standard code")
            asked_for = _request_text(request.pdu)
            text = f"Modbus {name}: refuses {asked_for}: exception {code}, {words}{late}"
            facts = (Fact(f"{asked_for} refused", code, f"exception {code}, {words}"),)
            return DecodedEvent(Kind.MODBUS_RESPONSE, adu.unit, text, facts)
        facts = _read(request.pdu, adu.pdu) + _written(request.pdu, adu.pdu)
        text = f"Modbus {name}: {_response_text(request.pdu, adu.pdu, facts)}{late}"
        return DecodedEvent(Kind.MODBUS_RESPONSE, adu.unit, text, facts)

    def _name(self, unit: int) -> str:
        name = self._names.get(unit)
        return f"unit {unit}" if name is None else f"{name} (unit {unit})"


def adu_of(time_ns: int, data: bytes, *, tcp: bool, to_server: bool) -> tuple[Adu | None, str]:
    """Return a recorded ADU, or None and the reason why its bytes are not one."""
    if tcp:
        if len(data) < 8 or int.from_bytes(data[4:6], "big") != len(data) - 6:
            return None, "MBAP header missing, or its length wrong"
        transaction = int.from_bytes(data[0:2], "big")
        return Adu(time_ns, None, to_server, transaction, data[6], data[7:]), ""
    if len(data) < 4:
        return None, f"{len(data)} bytes; an ADU has at least 4"
    if crc16(data[:-2]) != int.from_bytes(data[-2:], "little"):
        return None, "wrong CRC"
    return Adu(time_ns, None, to_server, 0, data[0], data[1:-2]), ""


def crc16(data: bytes) -> int:
    """Return the CRC of the serial line (MODBUS over Serial Line V1.02, 6.2.2)."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return crc


def _request_text(pdu: bytes) -> str:
    """Return a request in words."""
    if not pdu:
        return "an empty request"
    function = pdu[0]
    if function in _READS and len(pdu) == 5:
        count = _u16(pdu, 3)
        return f"read {_places(_READS[function], _u16(pdu, 1), count)}"
    if function in (5, 6, 15, 16) and len(pdu) >= 5:
        facts = _written(pdu, pdu)
        if facts:
            return "write " + _told(facts)
    if function == 22 and len(pdu) == 7:
        mask, bits = _u16(pdu, 3), _u16(pdu, 5)
        return f"mask register {_u16(pdu, 1):04X}h, and {mask:04X}h, or {bits:04X}h"
    if function == 23 and len(pdu) >= 10:
        places = _places("register", _u16(pdu, 1), _u16(pdu, 3))
        return f"write {_told(_written(pdu, pdu))}, then read {places}"
    name = _OTHERS.get(function & 0x7F, "function")
    return f"{name} ({function:02X}h): {_hex(pdu[1:])}"


def _response_text(request: bytes, response: bytes, facts: tuple[Fact, ...]) -> str:
    read = [fact for fact in facts if not fact.told_to]
    if read:
        return _told(read)
    if facts:
        return f"takes {_told(facts)}"
    return (
        f"answers {_OTHERS.get(request[0], 'function')} ({request[0]:02X}h): {_hex(response[1:])}"
    )


def _read(request: bytes, response: bytes) -> tuple[Fact, ...]:
    """Return the values in a response to a read; none if its length is wrong."""
    function = request[0]
    if len(request) < 5 or len(response) < 2 or response[1] != len(response) - 2:
        return ()
    start, count, data = _u16(request, 1), _u16(request, 3), response[2:]
    if function in (3, 4, 23) and len(data) == 2 * count:
        name = "input register" if function == 4 else "register"
        values = [_u16(data, 2 * number) for number in range(count)]
        return tuple(_fact(name, start + n, value, False) for n, value in enumerate(values))
    if function in (1, 2) and len(data) == (count + 7) // 8:
        bits = [data[number // 8] >> number % 8 & 1 for number in range(count)]
        return tuple(_fact(_READS[function], start + n, bit, False) for n, bit in enumerate(bits))
    return ()


def _written(request: bytes, response: bytes) -> tuple[Fact, ...]:
    """Return the values a request has written, given a response of the same function."""
    if not request or not response or response[0] != request[0]:
        return ()
    function = request[0]
    if function == 5 and len(request) == 5:
        return (_fact("coil", _u16(request, 1), int(request[3] == 0xFF), True),)
    if function == 6 and len(request) == 5:
        return (_fact("register", _u16(request, 1), _u16(request, 3), True),)
    at = 6 if function in (15, 16) else 10 if function == 23 else 0
    if not at or len(request) < at or request[at - 1] != len(request) - at:
        return ()
    start, count, data = _u16(request, at - 5), _u16(request, at - 3), request[at:]
    if function == 15 and len(data) == (count + 7) // 8:
        bits = [data[number // 8] >> number % 8 & 1 for number in range(count)]
        return tuple(_fact("coil", start + n, bit, True) for n, bit in enumerate(bits))
    if function != 15 and len(data) == 2 * count:
        values = [_u16(data, 2 * number) for number in range(count)]
        return tuple(_fact("register", start + n, value, True) for n, value in enumerate(values))
    return ()


def _fact(name: str, address: int, value: int, told_to: bool) -> Fact:
    text = f"{value:04X}h" if "register" in name else ("on" if value else "off")
    return Fact(f"{name} {address:04X}h", value, text, told_to)


def _told(facts: "tuple[Fact, ...] | list[Fact]") -> str:
    """Return addresses and values; of consecutive addresses, the first is named."""
    if not facts:
        return "malformed data"
    values = " ".join(fact.text for fact in facts[:16])
    more = f" and {len(facts) - 16} more" if len(facts) > 16 else ""
    return f"{facts[0].subject} = {values}{more}"


def _places(name: str, start: int, count: int) -> str:
    if count == 1:
        return f"{name} {start:04X}h"
    return f"{count} {name}s from {start:04X}h"


def _u16(data: bytes, at: int) -> int:
    return int.from_bytes(data[at : at + 2], "big")


def _hex(data: bytes) -> str:
    return data.hex(" ").upper() or "nothing"


_TOPIC: Final = "/modbus/"
_SHORTEST: Final = 4
_POLYNOMIAL: Final = 0xA001


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


def lines_of(trace: Trace) -> list[str]:
    """Return the names of the lines in a recording, sorted."""
    topics = {channel.topic for channel in trace.channels.values()}
    return sorted(topic.removeprefix(_TOPIC) for topic in topics if topic.startswith(_TOPIC))


def recorded_adus(trace: Trace, line: str) -> Iterator[Adu | Malformed]:
    """Yield the contents of a line in order; times are those of last bits [ns of the rig]."""
    for _, _, payload in trace.messages(topics=[_TOPIC + line]):
        yield _recorded_text(decode(MODBUS_ADU, payload))


def adu_in(values: Mapping[str, Value]) -> Adu | None:
    """Return the ADU in a message's fields; None if its bytes are not an ADU."""
    told = _recorded_text(values)
    return told if isinstance(told, Adu) else None


def _recorded_text(values: Mapping[str, Value]) -> Adu | Malformed:
    data, end_ns = values.get("data", b""), values.get("end_ns", 0)
    assert isinstance(data, bytes)
    assert isinstance(end_ns, int)
    to_server = values.get("direction") == Direction.TRANSMITTED
    is_tcp = bool(values.get("tcp"))
    problem = _problem(data, spoiled=bool(values.get("spoiled")), tcp=is_tcp)
    if problem:
        return Malformed(end_ns, None, 0, data, problem)
    if is_tcp:
        transaction = int.from_bytes(data[:2], "big")
        return Adu(end_ns, None, to_server, transaction, data[6], data[_HEAD:])
    return Adu(end_ns, None, to_server, 0, data[0], data[1:-2])


def _problem(data: bytes, *, spoiled: bool, tcp: bool) -> str:
    """Return the reason why it is not an ADU; "" if it is one."""
    if spoiled:
        return "a pause in it, or a collision"
    if tcp:
        return "" if len(data) > _HEAD else "shorter than a header"
    if len(data) < _SHORTEST:
        return "shorter than any frame"
    return "" if _checked(data) else "a wrong check sum"


def _checked(data: bytes) -> bool:
    """Return True if the check sum is correct: the CRC over everything is then 0."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (_POLYNOMIAL if crc & 1 else 0)
    return crc == 0
