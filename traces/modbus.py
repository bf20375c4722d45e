"""Recorded Modbus traffic: ADUs of TCP streams and serial lines, paired.

This passive decoder is independent of the other ones. Malformed data is reported and skipped.

Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, section 3.1.3; MODBUS over Serial
Line V1.02, section 2.5.1.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final, final

from traces.tcp_streams import Piece, Way

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
