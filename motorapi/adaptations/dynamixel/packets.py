"""Dynamixel Protocol 2.0 for a host: requests to bytes, bytes to statuses.

A packet is FF FF FD 00, id, length, instruction, parameters, CRC-16 (polynomial 8005h, start 0, not
reflected, over everything before it). After FF FF FD from the instruction on, the sender inserts
another FD. A status is instruction 55h with an error byte. Its highest bit, the alert, tells of a
hardware error, and does not make the status a failure.

Source: the maker's manual of Protocol 2.0.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple, final

from motorhil.motorapi.api import Exchange, MotorError, PeerError

BROADCAST: Final = 254
PING: Final = 1
READ: Final = 2
WRITE: Final = 3
REBOOT: Final = 8
SYNC_WRITE: Final = 131
_STATUS: Final = 85
_START: Final = b"\xff\xff\xfd"
_BEFORE_LENGTH: Final = 5
_LENGTH_END: Final = 7
_HEARD_MAX: Final = 2048
_ERRORS: Final = {
    1: "it could not be done",
    2: "unknown instruction",
    3: "wrong CRC",
    4: "value out of the register's range",
    5: "wrong length",
    6: "value beyond a limit register",
    7: "no access: read-only, unknown, or locked while torque is on",
}


@final
@dataclass(frozen=True, slots=True)
class Request:
    """An instruction with its parameters; `count` is the data bytes of its status."""

    instruction: int
    parameters: bytes = b""
    count: int = 0

    def __str__(self) -> str:
        names = {PING: "ping", READ: "read", WRITE: "write", REBOOT: "reboot"}
        name = names.get(self.instruction, f"instruction {self.instruction:02X}h")
        has_address = self.instruction in (READ, WRITE)
        at = int.from_bytes(self.parameters[:2], "little")
        return f"{name} at {at}" if has_address else name


@final
class Status(NamedTuple):
    """A status: its error (0: none) without the alert, the alert, its data."""

    error: int
    alert: bool
    data: bytes


DynamixelExchange = Exchange[Request, Status]


@final
class DynamixelRefused(PeerError):  # noqa: N818 -- what happened
    """The servo refused an instruction.

    Attributes: line, unit, request, error (1 to 7).
    """

    def __init__(self, *, line: str, unit: int, request: Request, error: int) -> None:
        self.line = line
        self.unit = unit
        self.request = request
        self.error = error
        text = _ERRORS.get(error, "an error that the manual does not list")
        super().__init__(f"{line} unit {unit}: {request} refused: {text} (error {error})")


def read_of(address: int, count: int) -> Request:
    """Return the request to read bytes."""
    return Request(READ, address.to_bytes(2, "little") + count.to_bytes(2, "little"), count)


def write_of(address: int, data: bytes) -> Request:
    """Return the request to write bytes."""
    return Request(WRITE, address.to_bytes(2, "little") + data)


def crc_of(data: bytes) -> int:
    """Return the CRC of a packet without it."""
    remainder = 0
    for byte in data:
        remainder ^= byte * 256
        for _ in range(8):
            remainder *= 2
            if remainder > 0xFFFF:
                remainder = remainder ^ 0x18005
    return remainder


@final
class DynamixelCodec:
    """A codec of a line with servos.

    Attributes: heard (the bytes since the request).
    """

    is_inside: Final = False

    def __init__(self, line: str) -> None:
        self.heard: bytes = b""
        self._line = line

    def begin(self) -> None:
        """Forget received bytes, as a request is sent."""
        self.heard = b""

    def encode(self, exchange: DynamixelExchange) -> bytes:
        """Return the packet of a request."""
        request = exchange.request
        body = bytes((request.instruction,)) + request.parameters
        body = body.replace(_START, _START + _START[2:])
        packet = _START + bytes((0, exchange.unit)) + (len(body) + 2).to_bytes(2, "little") + body
        return packet + crc_of(packet).to_bytes(2, "little")

    def feed(self, data: bytes, exchange: DynamixelExchange | None) -> Status | None:
        """Return the status of the addressed servo, once it is complete."""
        if exchange is None:
            return None
        heard = self.heard = (self.heard + data)[-_HEARD_MAX:]
        place = heard.find(_START)
        while place >= 0:
            found = _status_in(heard[place:], exchange.unit)
            if found is not None:
                return found
            place = heard.find(_START, place + 1)
        return None

    def answers(self, answer: Status, request: Request) -> bool:
        """Return whether it has as many bytes as were asked for, or an error."""
        return bool(answer.error) or len(answer.data) == request.count

    def refusal(self, exchange: DynamixelExchange, answer: Status) -> MotorError | None:
        """Return the error of a status."""
        if not answer.error:
            return None
        return DynamixelRefused(
            line=self._line, unit=exchange.unit, request=exchange.request, error=answer.error
        )

    def awaited(self, request: Request) -> str:
        """Return the words for the answer to a request."""
        return f"status after {request}"


def _status_in(packet: bytes, unit: int) -> Status | None:
    """Return the status of a servo at the beginning of these bytes."""
    if len(packet) <= _LENGTH_END or packet[3] == _START[2] or packet[4] != unit:
        return None
    end = _LENGTH_END + int.from_bytes(packet[_BEFORE_LENGTH:_LENGTH_END], "little")
    if len(packet) < end or end < _LENGTH_END + 4 or packet[_LENGTH_END] != _STATUS:
        return None
    if crc_of(packet[: end - 2]) != int.from_bytes(packet[end - 2 : end], "little"):
        return None
    body = packet[_LENGTH_END + 1 : end - 2].replace(_START + _START[2:], _START)
    return Status(body[0] & 0x7F, body[0] > 0x7F, body[1:])
