"""The tapes of all units on a recorded Modbus line: what each was asked, and what it answered.

A request that writes is a command, any other a poll. Frames are unit and PDU, without check sum or
header, so that a tape of a serial line serves behind a gateway, and the other way round.

Source: MODBUS Application Protocol Specification V1.1b3, section 6.
"""

from collections.abc import Iterable
from typing import Final, NamedTuple, final

from traces.decode_modbus import ModbusDecoder
from traces.modbus import Adu
from traces.tape import START, Key, Role, Sent, Step, Tape, Turn

WRITES: Final = (0x05, 0x06, 0x0F, 0x10, 0x15, 0x16, 0x17)


@final
class LineAdu(NamedTuple):
    """An ADU: when the line knew it was complete, when its first bit began and its last ended."""

    complete_ns: int
    start_ns: int
    end_ns: int
    adu: Adu


def request_key(pdu: bytes) -> Key:
    """Of a request: all it says."""
    return ("modbus", pdu[0], bytes(pdu))


def role_of(pdu: bytes) -> Role:
    """Whether a request changes anything."""
    return Role.COMMAND if pdu[0] in WRITES else Role.POLL


def modbus_tapes(line: str, adus: Iterable[LineAdu], begin_ns: int) -> dict[int, Tape]:
    """The tapes of the units that have answered anything on this line, by unit."""
    decoder = ModbusDecoder()
    tapes: dict[int, Tape] = {}
    answering: dict[int, list[tuple[int, Step, int]]] = {}  # by unit: transaction, step, asked
    answered: list[int] = []
    for complete_ns, start_ns, end_ns, adu in adus:
        text = decoder.decode(adu).text
        if adu.to_server:
            whom = list(tapes) if adu.unit == 0 else [adu.unit]
            for unit in whom:
                tape = tapes.get(unit)
                if tape is None:
                    first = Step(Role.COMMAND, START, begin_ns, "the recording begins")
                    tape = tapes[unit] = Tape(line, unit, [first])
                step = Step(role_of(adu.pdu), request_key(adu.pdu), complete_ns, text)
                step.turns.append(Turn(bytes([adu.unit]) + adu.pdu))
                tape.steps.append(step)
                waiting = answering.setdefault(unit, [])
                waiting.append((adu.transaction, step, complete_ns))
                if adu.way is None and not adu.transaction:  # a serial line: one at a time
                    del waiting[:-1]
            continue
        waiting = answering.get(adu.unit, [])
        for place, (transaction, step, asked_ns) in enumerate(waiting):
            if transaction == adu.transaction:
                del waiting[place]
                frame = bytes([adu.unit]) + adu.pdu
                step.turns[0].answers.append(Sent(end_ns - asked_ns, frame, end_ns - start_ns))
                step.answer_text = text
                answered.append(adu.unit)
                break
    return {unit: tape for unit, tape in sorted(tapes.items()) if unit in set(answered)}
