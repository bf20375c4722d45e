"""Errors of Modbus servers: refusals and invalid answers, below PeerError."""

# ruff: noqa: N818 -- the specification's names, and what happened

from typing import Final, final

from motorapi.errors import DeadlineExceeded, PeerError

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
class ModbusExceptionResponse(PeerError):
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


@final
class ModbusProtocolViolation(PeerError):
    """The received bytes are not an answer to the request.

    Attributes: line, unit, problem (in words), heard (the bytes).
    """

    def __init__(self, *, line: str, unit: int, problem: str, heard: bytes) -> None:
        self.line = line
        self.unit = unit
        self.problem = problem
        self.heard = heard
        shown = heard[:24].hex(" ").upper() + (" ..." if len(heard) > 24 else "")
        super().__init__(f"{line} unit {unit}: {problem} ({shown})")


def is_silence(error: Exception) -> bool:
    """Return whether the error means that a unit does not answer, directly or behind a gateway."""
    if isinstance(error, ModbusExceptionResponse):
        return error.exception_code == GATEWAY_TARGET_FAILED
    return isinstance(error, DeadlineExceeded)
