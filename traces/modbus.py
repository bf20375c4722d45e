"""Modbus as it was recorded: ADUs of TCP streams and serial lines, requests and their responses.

A reading of the protocol of its own, which only looks: what is malformed is told and passed over.

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

    Attributes: time_ns, way (which connection, which direction; None: a serial line), to_server
    (whether it is a request), transaction (0 on a serial line), unit, pdu, packet (the number of
    the packet that completed it; 0: none).
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
        """Whether it is an exception response."""
        return not self.to_server and len(self.pdu) >= 1 and self.pdu[0] & 0x80 != 0


@final
@dataclass(frozen=True, slots=True)
class Malformed:
    """Bytes that are no ADU.

    Attributes: time_ns, way (None: on a line of our recordings), packet, data, problem (in words).
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
    """The ADUs of TCP streams to and from servers at `port`, in the order of their completion.

    A header that cannot be (its protocol is not 0, its length not 2 to 254) is passed over with the
    rest of its segment: most senders begin a new ADU with a new segment. Memory grows with the
    number of connections.
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
                if rest:  # what was left over belongs to nothing: begin anew with this segment
                    lost = f"{len(rest)} bytes behind an ADU that are the beginning of none"
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
    """A request and what came of it.

    Attributes: request; response (None: none was seen); reused (whether its transaction identifier
    was used for another request before there was a response).
    """

    request: Adu
    response: Adu | None
    reused: bool = False

    @property
    def delay_s(self) -> float | None:
        """From request to response [s]; None: there is none."""
        if self.response is None:
            return None
        return (self.response.time_ns - self.request.time_ns) / 1e9


@final
@dataclass(frozen=True, slots=True)
class Pairing:
    """Requests with their responses, in the order of the requests; responses nobody asked for."""

    exchanges: tuple[Exchange, ...]
    strays: tuple[Adu, ...]

    @property
    def answered(self) -> int:
        """How many requests have a response."""
        return sum(exchange.response is not None for exchange in self.exchanges)

    @property
    def reused(self) -> int:
        """How many have none because their transaction identifier was used again."""
        return sum(exchange.reused for exchange in self.exchanges)


def paired(found: Iterable[Adu | Malformed]) -> Pairing:
    """Each request with its response: the next one of its connection and transaction identifier.

    Responses may come in any order; the unit is the gateway's to tell. On a serial line, where
    there are no transactions, the response is what comes next from the unit asked.
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
