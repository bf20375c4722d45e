"""Exchange logs of all units on a recorded Modbus line.

A request that writes is a command, any other a poll. Frames consist of unit and PDU, without check
sum or header. The log of a serial line can therefore be replayed behind a gateway, and the other
way round.

Source: MODBUS Application Protocol Specification V1.1b3, section 6.
"""

from collections.abc import Iterable
from typing import Final, NamedTuple, final

from motorhil.traces.decoding.modbus import ModbusDecoder
from motorhil.traces.exchange.steps import START, ExchangeLog, Key, Role, Sent, Step, Turn
from motorhil.traces.formats.modbus import Adu

WRITES: Final = (0x05, 0x06, 0x0F, 0x10, 0x15, 0x16, 0x17)
_BITS_EACH: Final = {0x01: 1, 0x02: 1, 0x03: 16, 0x04: 16, 0x17: 16}
"""Functions that read, with the bits per coil or register."""
_GATEWAYS: Final = (b"\x0a", b"\x0b")
"""Exceptions of a gateway itself (path unavailable, no response)."""


@final
class LineAdu(NamedTuple):
    """An ADU: when its end was detected, when its first bit began and its last ended.

    On TCP it has a transaction, which can be 0; and unit 0 can be the server itself.
    """

    complete_ns: int
    start_ns: int
    end_ns: int
    adu: Adu
    is_tcp: bool = False


def request_key(pdu: bytes) -> Key:
    """Return the key of a request: its complete PDU."""
    return ("modbus", pdu[0], bytes(pdu))


def role_of(pdu: bytes) -> Role:
    """Return COMMAND for a request that writes, else POLL."""
    return Role.COMMAND if pdu[0] in WRITES else Role.POLL


def modbus_logs(line: str, adus: Iterable[LineAdu], begin_ns: int) -> dict[int, ExchangeLog]:
    """Return the exchange logs of all units that have answered on this line, by unit."""
    decoder = ModbusDecoder()
    units: dict[int, _Unit] = {}
    to_all: list[
        tuple[int, Adu, str]
    ] = []  # broadcasts, which units that have not been addressed yet received too
    for complete_ns, start_ns, end_ns, adu, is_tcp in adus:
        text = decoder.decode(adu).text
        if not adu.to_server:
            unit = units.get(adu.unit)
            if unit is not None:
                unit.answered(start_ns, end_ns, adu, text)
            continue
        if adu.unit not in units:
            unit = units[adu.unit] = _Unit(line, adu.unit, begin_ns)
            for when_ns, one, words in to_all:
                unit.asked(when_ns, one, words, is_tcp)
        for number in list(units) if adu.unit == 0 else [adu.unit]:
            units[number].asked(complete_ns, adu, text, is_tcp)
        if adu.unit == 0:
            to_all.append((complete_ns, adu, text))
    return {number: one.clear_up() for number, one in sorted(units.items()) if one.has_answered}


@final
class _Unit:
    """A unit whose exchange log is being built.

    A gateway sends it one request after another, and pauses after a missing answer. The response
    time of a delayed request is therefore not in the recording, and is assumed to be the usual one.
    """

    def __init__(self, line: str, number: int, begin_ns: int) -> None:
        self.log = ExchangeLog(line, number)
        self.log.steps.append(Step(Role.COMMAND, START, begin_ns, "the recording begins"))
        self.has_answered = False
        # transaction, step, time of the request, True if the unit was asked at once
        self._pending: list[tuple[int, Step, int, bool]] = []
        self._is_held_up = False
        self._delays_ns: list[int] = []
        self._unclear: list[Step] = []

    def asked(self, complete_ns: int, adu: Adu, text: str, is_tcp: bool = False) -> None:
        step = Step(role_of(adu.pdu), request_key(adu.pdu), complete_ns, text)
        step.turns.append(Turn(bytes([adu.unit]) + adu.pdu))
        self.log.steps.append(step)
        if not (adu.transaction or is_tcp):  # a serial line: an unanswered request stays unanswered
            self._pending.clear()
        at_once = not self._pending and not self._is_held_up
        self._pending.append((adu.transaction, step, complete_ns, at_once))

    def answered(self, start_ns: int, end_ns: int, adu: Adu, text: str) -> None:
        place = self._place_of(adu)
        if place is None:
            return
        _, step, asked_ns, at_once = self._pending.pop(place)
        if adu.is_exception and adu.pdu[1:] in _GATEWAYS:
            self._is_held_up = True
            return
        self._is_held_up = self._is_held_up and bool(self._pending)
        frame = bytes([adu.unit]) + adu.pdu
        step.turns[0].answers.append(Sent(end_ns - asked_ns, frame, end_ns - start_ns))
        step.answer_text = text
        self.has_answered = True
        if at_once:
            self._delays_ns.append(end_ns - asked_ns)
        else:
            self._unclear.append(step)

    def _place_of(self, adu: Adu) -> int | None:
        """Return the place of the request that a response answers: the last matching one.

        A reused transaction leaves the earlier request unanswered for good. Transactions of other
        connections are distinguished by function and length, where these differ.
        """
        places = [n for n, one in enumerate(self._pending) if one[0] == adu.transaction]
        fitting = [n for n in places if _fits(self._pending[n][1].key[2], adu.pdu)]
        found = fitting or places
        return found[-1] if found else None

    def clear_up(self) -> ExchangeLog:
        """Return the log, with the usual delay for answers whose delay is unknown."""
        usual_ns = sorted(self._delays_ns)[len(self._delays_ns) // 2] if self._delays_ns else 0
        for step in self._unclear:
            turn = step.turns[0]
            turn.answers = [
                sent._replace(delay_ns=min(sent.delay_ns, usual_ns)) for sent in turn.answers
            ]
        return self.log


def _fits(asked: bytes, told: bytes) -> bool:
    """Return True if a response PDU can answer this request, by function and data size."""
    if not told or told[0] & 0x7F != asked[0]:
        return False
    if told[0] & 0x80 or asked[0] not in _BITS_EACH or len(asked) < 5 or len(told) < 2:
        return True
    return told[1] == (int.from_bytes(asked[3:5], "big") * _BITS_EACH[asked[0]] + 7) // 8
