"""Modbus on a line: pymodbus encodes and decodes for `ExchangeLine`.

On a serial line all bytes since a request are its answer; on TCP the bytes are a stream of ADUs,
each read from its header.

Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, section 3.1.3 (MBAP); for the request
fields repeated in a response, MODBUS Application Protocol V1.1b3, sections 6.3, 6.6 and 6.12.
"""

import logging
from typing import Final, final

from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from motorhil.motorapi.api.line_exchanges import Exchange, ExchangeLine, LineProtocolViolation
from motorhil.motorapi.errors import MotorError, PeerError

ModbusProtocolViolation = LineProtocolViolation
ModbusExchange = Exchange[ModbusPDU, ModbusPDU]

# pymodbus warns of frames that it cannot decode. Our error has their bytes; without a handler
# of the application, Python would print the warning.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

_HEAD: Final = 7  # of MBAP, with the unit
_LENGTHS: Final = range(2, 255)  # in MBAP: of the unit and a PDU
_HEARD_MAX: Final = 512  # bytes; more than any answer
GATEWAY_TARGET_FAILED: Final = 0x0B
"""The exception code of a gateway, for a unit that does not answer."""

# MODBUS Application Protocol Specification V1.1b3, section 7
_TEXT: Final = {
    0x01: "illegal function",
    0x02: "illegal data address",
    0x03: "illegal data value",
    0x04: "server device failure",
    0x05: "acknowledge",
    0x06: "server device busy",
    0x08: "memory parity error",
    0x0A: "gateway path unavailable",
    GATEWAY_TARGET_FAILED: "gateway target device failed to respond",
}


@final
class ModbusExceptionResponse(PeerError):  # noqa: N818 -- the specification's name
    """The server refused a request (MODBUS Application Protocol V1.1b3, section 7).

    Attributes: line, unit, function (its code), address (PDU's, None: the request has none),
    exception_code.
    """

    def __init__(
        self, *, line: str, unit: int, function: int, address: int | None, exception_code: int
    ) -> None:
        self.line = line
        self.unit = unit
        self.function = function
        self.address = address
        self.exception_code = exception_code
        text = _TEXT.get(exception_code, "code not listed in the specification")
        where = "" if address is None else f" at {address:04X}h"
        super().__init__(
            f"{line} unit {unit}: function {function:02X}h{where} refused: {text}"
            f" ({exception_code:02X}h)"
        )

    @property
    def is_silence(self) -> bool:
        """True if a gateway reports that the unit does not answer."""
        return self.exception_code == GATEWAY_TARGET_FAILED


class _Reader:
    """Common part of the codecs of both framings.

    Attributes: framer; heard (the bytes since the request, on TCP except answers to others).
    """

    def __init__(self, line: str, framer: FramerRTU | FramerSocket) -> None:
        self.framer: Final = framer
        self.heard: bytes = b""
        self._line = line

    def begin(self) -> None:
        """Forget received bytes, as a request is sent."""
        self.heard = b""

    def encode(self, exchange: ModbusExchange) -> bytes:
        """Return the ADU of a request."""
        exchange.request.dev_id = exchange.unit
        exchange.request.transaction_id = exchange.transaction
        return self.framer.buildFrame(exchange.request)

    def answers(self, answer: ModbusPDU, request: ModbusPDU) -> bool:
        """Return whether it may answer this very request: number of registers, address."""
        if isinstance(answer, ExceptionResponse):
            return True
        if isinstance(request, ReadHoldingRegistersRequest):
            return len(answer.registers) == request.count
        if isinstance(request, WriteSingleRegisterRequest):
            return (answer.address, answer.registers) == (request.address, request.registers)
        if isinstance(request, WriteMultipleRegistersRequest):
            return (answer.address, answer.count) == (request.address, request.count)
        return True

    def refusal(self, exchange: ModbusExchange, answer: ModbusPDU) -> MotorError | None:
        """Return the error of an exception response."""
        if not isinstance(answer, ExceptionResponse):
            return None
        address = getattr(exchange.request, "address", None)
        return ModbusExceptionResponse(
            line=self._line,
            unit=exchange.unit,
            function=exchange.request.function_code,
            address=address if isinstance(address, int) else None,
            exception_code=answer.exception_code,
        )

    def awaited(self, request: ModbusPDU) -> str:
        """Return the words for the answer to a request."""
        return f"answer to function {request.function_code:02X}h"


@final
class FrameReader(_Reader):
    """A reader of answers on a serial line."""

    heard: bytes

    def __init__(self, line: str) -> None:
        super().__init__(line, FramerRTU(DecodePDU(False)))

    @property
    def is_inside(self) -> bool:
        """False: silence ends a frame."""
        return False

    def feed(self, data: bytes, exchange: ModbusExchange | None) -> ModbusPDU | None:
        """Return the answer of the addressed unit and function that `data` completes, if any."""
        if exchange is None:
            return None
        heard = self.heard = (self.heard + data)[-_HEARD_MAX:]
        if len(heard) < 5 or not _is_of(heard[0], heard[1], exchange):
            return None
        return _decoded(self.framer, heard, exchange)


@final
class StreamReader(_Reader):
    """A reader of answers on TCP."""

    heard: bytes

    def __init__(self, line: str) -> None:
        super().__init__(line, FramerSocket(DecodePDU(False)))
        self._buffer = b""

    @property
    def is_inside(self) -> bool:
        """True if the end of an ADU is still to come."""
        return bool(self._buffer)

    def feed(self, data: bytes, exchange: ModbusExchange | None) -> ModbusPDU | None:
        """Return the answer if `data` completes it."""
        self._buffer += data
        answer: ModbusPDU | None = None
        while len(self._buffer) > _HEAD:
            buffer = self._buffer
            length = int.from_bytes(buffer[4:6], "big")
            if buffer[2:4] != b"\x00\x00" or length not in _LENGTHS:  # not Modbus: start again
                self._buffer, self.heard = b"", buffer[:_HEARD_MAX]
                return answer
            end = 6 + length
            if len(buffer) < end:
                break
            adu, self._buffer = buffer[:end], buffer[end:]
            if exchange is None or int.from_bytes(adu[0:2], "big") != exchange.transaction:
                continue
            self.heard = adu
            if answer is None and _is_of(adu[6], adu[_HEAD], exchange):
                answer = _decoded(self.framer, adu, exchange)
        if self._buffer:
            self.heard = self._buffer
        return answer


def _is_of(unit: int, function: int, exchange: ModbusExchange) -> bool:
    return unit == exchange.unit and function & 0x7F == exchange.request.function_code


def _decoded(
    framer: FramerRTU | FramerSocket, adu: bytes, exchange: ModbusExchange
) -> ModbusPDU | None:
    try:
        return framer.handleFrame(adu, exchange.unit, exchange.transaction)[1]
    except (ModbusException, ValueError, IndexError):  # pymodbus raises these for an invalid frame
        return None


@final
class ModbusLine(ExchangeLine[ModbusPDU, ModbusPDU]):
    """The host's end of one Modbus line, shared by its units."""

    def _codec(self) -> FrameReader | StreamReader:
        return (StreamReader if self._is_tcp else FrameReader)(self.name)
