"""Requests of a capture with their responses, for checks on real traffic."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import final

from motorhil.traces.formats.modbus import Adu, Malformed, can_answer
from motorhil.traces.formats.tcp import Way


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
        if place is None or not can_answer(exchanges[place].request, adu):
            strays.append(adu)
            continue
        del pending[key]
        exchanges[place] = Exchange(exchanges[place].request, adu)
    return Pairing(tuple(exchanges), tuple(strays))
