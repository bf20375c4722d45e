"""Passive decoder of the Modbus traffic on one line, into sentences and facts.

It is independent of the emulators and of the motor interface. Addresses are those of the PDU, from
0.

Function 43 with MEI type 13 reads and writes objects of a CANopen device behind a gateway.

Source: MODBUS Application Protocol Specification V1.1b3, sections 6 (function codes) and 7
(exception codes); igus, Operating Manual dryve D1 V2.4, pages 104 to 110 (MEI type 13).
"""

import struct
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Final, final

from motorhil.traces.decoding.cia402 import controlword_text, mode_text, statusword_text
from motorhil.traces.decoding.events import DecodedEvent, Fact, Kind, Value
from motorhil.traces.decoding.objects import standard_name, value_of, value_text
from motorhil.traces.formats.modbus import Adu, can_answer
from motorhil.traces.formats.tcp import Way

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
_OBJECTS: Final = bytes((43, 13))
_OBJECT_HEAD: Final = 12  # up to the byte count
_WORDS: Final[dict[int, Callable[[int], str]]] = {
    0x6040: controlword_text,
    0x6041: statusword_text,
    0x6060: mode_text,
    0x6061: mode_text,
}


@final
class ModbusDecoder:
    """Decoder of one line, or of all connections of one channel; ADUs in recorded order."""

    def __init__(self, unit_names: Mapping[int, str] | None = None) -> None:
        """Create a decoder with the names of units."""
        self._names: dict[int, str] = {}
        for unit, name in (unit_names or {}).items():
            self.call(unit, name)
        self._pending: dict[tuple[Way | None, int], Adu] = {}

    def call(self, unit: int, name: str) -> None:
        """Set the name of a unit that has none yet."""
        if unit not in self._names:
            self._names[unit] = f"{name} (unit {unit})"

    def forget_requests(self) -> None:
        """Abandon all pending requests, because ADUs are missing from here on."""
        self._pending.clear()

    def decode(self, adu: Adu) -> DecodedEvent:
        """Decode an ADU: a request, or a response together with its request."""
        way = adu.way if adu.to_server or adu.way is None else adu.way.back
        key = (way, adu.transaction)
        name = self._names.get(adu.unit)
        if name is None:
            name = f"unit {adu.unit}"
        if adu.to_server:
            self._pending[key] = adu
            broadcast = adu.unit == 0 and adu.way is None  # a broadcast is not answered
            facts = _written(adu.pdu, adu.pdu) if broadcast else ()
            words = partial(_asked, name, adu.pdu)
            return DecodedEvent(Kind.MODBUS_REQUEST, adu.unit, words, facts)
        request = self._pending.get(key)
        if request is None or not can_answer(request, adu):
            text = f"Modbus {name}: response without a request: {_hex(adu.pdu)}"
            return DecodedEvent(Kind.MODBUS_RESPONSE, adu.unit, text)
        del self._pending[key]
        late_ns = adu.time_ns - request.time_ns
        if adu.is_exception:
            code = adu.pdu[1] if len(adu.pdu) > 1 else 0
            told = f"exception {code}, {EXCEPTIONS.get(code, 'a non-standard code')}"
            asked_for = _request_text(request.pdu)
            text = f"Modbus {name}: refuses {asked_for}: {told}{_late(late_ns)}"
            facts = (Fact(f"{asked_for} refused", code, told),)
            return DecodedEvent(Kind.MODBUS_RESPONSE, adu.unit, text, facts)
        facts = _read(request.pdu, adu.pdu) + _written(request.pdu, adu.pdu)
        words = partial(_answered, name, request.pdu, adu.pdu, facts, late_ns)
        return DecodedEvent(Kind.MODBUS_RESPONSE, adu.unit, words, facts)


def _asked(name: str, pdu: bytes) -> str:
    return f"Modbus to {name}: {_request_text(pdu)}"


def _answered(
    name: str, request: bytes, response: bytes, facts: tuple[Fact, ...], late_ns: int
) -> str:
    return f"Modbus {name}: {_response_text(request, response, facts)}{_late(late_ns)}"


def _late(late_ns: int) -> str:
    return f" (after {late_ns / 1e9 * 1e3:.3f} ms)"


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
    if pdu[:2] == _OBJECTS and len(pdu) >= _OBJECT_HEAD:
        return "write " + _told(_written(pdu, pdu)) if pdu[2] else f"read {_object_name(pdu)}"
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
    if request[:2] == _OBJECTS and len(request) >= _OBJECT_HEAD:
        return () if request[2] else _object_facts(response, False)
    if len(request) < 5 or len(response) < 2 or response[1] != len(response) - 2:
        return ()
    start, count, data = _u16(request, 1), _u16(request, 3), response[2:]
    if function in (3, 4, 23) and len(data) == 2 * count:
        name = "input register" if function == 4 else "register"
        return _registers(name, start, data, False)
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
    if request[:2] == _OBJECTS and len(request) > _OBJECT_HEAD and request[2]:
        return _object_facts(request, True)
    at = 6 if function in (15, 16) else 10 if function == 23 else 0
    if not at or len(request) < at or request[at - 1] != len(request) - at:
        return ()
    start, count, data = _u16(request, at - 5), _u16(request, at - 3), request[at:]
    if function == 15 and len(data) == (count + 7) // 8:
        bits = [data[number // 8] >> number % 8 & 1 for number in range(count)]
        return tuple(_fact("coil", start + n, bit, True) for n, bit in enumerate(bits))
    if function != 15 and len(data) == 2 * count:
        return _registers("register", start, data, True)
    return ()


def _registers(name: str, start: int, data: bytes, told_to: bool) -> tuple[Fact, ...]:
    values = struct.unpack(f">{len(data) // 2}H", data)
    return tuple([_fact(name, start + n, value, told_to) for n, value in enumerate(values)])


def _fact(name: str, address: int, value: int, told_to: bool) -> Fact:
    words = _register_text if "register" in name else _coil_text
    return Fact(_place(name, address), value, words, told_to)


@lru_cache(4096)
def _place(name: str, address: int) -> str:
    return f"{name} {address:04X}h"


def _register_text(value: Value) -> str:
    assert isinstance(value, int)
    return f"{value:04X}h"


def _coil_text(value: Value) -> str:
    return "on" if value else "off"


def _object_name(pdu: bytes) -> str:
    index, subindex = _u16(pdu, 5), pdu[7]
    name = standard_name(index, subindex).text
    place = f"object {index:04X}h" + (f":{subindex}" if subindex else "")
    return f"{place} {name}".rstrip()


def _object_facts(pdu: bytes, told_to: bool) -> tuple[Fact, ...]:
    """Return the value of an object in a telegram; none if its length is wrong."""
    if len(pdu) <= _OBJECT_HEAD or pdu[_OBJECT_HEAD - 1] != len(pdu) - _OBJECT_HEAD:
        return ()
    index, data = _u16(pdu, 5), pdu[_OBJECT_HEAD:]
    kind = standard_name(index, pdu[7]).kind
    value = value_of(kind, data)
    text = value_text(kind, len(data), value)
    if index in _WORDS and isinstance(value, int):
        text += f" ({_WORDS[index](value)})"
    return (Fact(_object_name(pdu), value, text, told_to),)


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
