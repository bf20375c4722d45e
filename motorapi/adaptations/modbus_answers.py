"""Modbus exchanges, and recognition of answers in the received bytes.

pymodbus decodes. On a serial line, all bytes received since a request must be its answer, complete
and with its check sum. On TCP, the bytes are a stream of ADUs, each read from its header. So half
of a late answer does no harm.

Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, section 3.1.3 (MBAP); for the request
fields repeated in a response, MODBUS Application Protocol V1.1b3, sections 6.3, 6.6 and 6.12.
"""

from typing import TYPE_CHECKING, Final, final

from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ModbusPDU
from pymodbus.pdu.exceptionresponse import ExceptionResponse
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

if TYPE_CHECKING:
    from motorapi.errors import MotorError
    from motorapi.fencing import Owned

_HEAD: Final = 7  # of MBAP, with the unit
_LENGTHS: Final = range(2, 255)  # in MBAP: of the unit and a PDU
_HEARD_MAX: Final = 512  # bytes; more than any answer


@final
class Exchange:
    """A request and, once it is over, its answer or its error."""

    __slots__ = (
        "answer",
        "asked_ns",
        "error",
        "is_over",
        "is_posted",
        "owned",
        "request",
        "timeout_s",
        "transaction",
        "unit",
    )

    def __init__(
        self, request: ModbusPDU, unit: int, timeout_s: float, owned: "Owned | None" = None
    ) -> None:
        self.request: Final = request
        self.unit: Final = unit
        self.timeout_s: Final = timeout_s
        self.owned: Final = owned  # must be ours when the request is sent; None: not required
        self.transaction = 0
        self.asked_ns = 0
        self.is_posted = False
        self.answer: ModbusPDU | None = None
        self.error: MotorError | None = None
        self.is_over = False


def answers(answer: ModbusPDU, request: ModbusPDU) -> bool:
    """Return whether it may answer this very request: same number of registers, same address."""
    if isinstance(answer, ExceptionResponse):
        return True
    if isinstance(request, ReadHoldingRegistersRequest):
        return len(answer.registers) == request.count
    if isinstance(request, WriteSingleRegisterRequest):
        return (answer.address, answer.registers) == (request.address, request.registers)
    if isinstance(request, WriteMultipleRegistersRequest):
        return (answer.address, answer.count) == (request.address, request.count)
    return True


@final
class FrameReader:
    """A reader of answers on a serial line.

    Attributes: framer; heard (all bytes since the request).
    """

    def __init__(self) -> None:
        self.framer: Final = FramerRTU(DecodePDU(False))
        self.heard = b""

    def begin(self) -> None:
        """Forget received bytes, as a request is sent."""
        self.heard = b""

    def feed(self, data: bytes, exchange: Exchange | None) -> ModbusPDU | None:
        """Return the answer of the addressed unit and function that `data` completes, if any."""
        if exchange is None:
            return None
        heard = self.heard = (self.heard + data)[-_HEARD_MAX:]
        if len(heard) < 5 or not _is_of(heard[0], heard[1], exchange):
            return None
        return _decoded(self.framer, heard, exchange)


@final
class StreamReader:
    """A reader of answers on TCP.

    Attributes: framer; heard (the bytes since the request, except answers to others).
    """

    def __init__(self) -> None:
        self.framer: Final = FramerSocket(DecodePDU(False))
        self.heard = b""
        self._buffer = b""

    def begin(self) -> None:
        """Forget received bytes, as a request is sent."""
        self.heard = b""

    def feed(self, data: bytes, exchange: Exchange | None) -> ModbusPDU | None:
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


def _is_of(unit: int, function: int, exchange: Exchange) -> bool:
    return unit == exchange.unit and function & 0x7F == exchange.request.function_code


def _decoded(framer: FramerRTU | FramerSocket, adu: bytes, exchange: Exchange) -> ModbusPDU | None:
    try:
        return framer.handleFrame(adu, exchange.unit, exchange.transaction)[1]
    except (ModbusException, ValueError, IndexError):  # pymodbus raises these for an invalid frame
        return None
