"""Telegrams of the CANopen gateway in a dryve D1: Modbus TCP, function 43, MEI type 13.

A telegram reads or writes one object. The answer repeats its header. Some firmware does not repeat
the transaction identifier (it answers 0), answers with another unit, adds bytes to an exception, or
repeats the written data: all of them are accepted, as one request at a time is in flight.

Source: igus, Operating Manual dryve D1 V2.4, pages 104 to 110.
"""

from dataclasses import dataclass
from typing import Final, final

from motorhil.motorapi.api import Exchange, MotorError, PeerError

_MBAP: Final = 6  # up to the length
_HEAD: Final = 12  # of a PDU, up to the byte count
_LENGTHS: Final = range(2, 255)
_FUNCTION, _MEI, _ERROR = 0x2B, 0x0D, 0x80
_HEARD_MAX: Final = 512
ABSENT, ILLEGAL_VALUE = 2, 3
_GATEWAY_TARGET_FAILED: Final = 0x0B
_TEXT: Final = {
    1: "illegal function",
    ABSENT: "no such object",
    ILLEGAL_VALUE: "illegal value or length",
    4: "device failure",
    5: "acknowledge",
    6: "busy",
    _GATEWAY_TARGET_FAILED: "gateway target device failed to respond",
}


@final
@dataclass(frozen=True, slots=True)
class Request:
    """A telegram of the host.

    Attributes:
        index, subindex: of the object.
        size: number of its bytes, 1 to 4.
        data: the value to write; None: the object is read.
    """

    index: int
    subindex: int
    size: int
    data: bytes | None = None

    def __str__(self) -> str:
        """Return its object, as in documents."""
        return f"{self.index:04X}h:{self.subindex}"

    def pdu(self) -> bytes:
        """Return its PDU."""
        head = bytes((_FUNCTION, _MEI, self.data is not None, 0, 0))
        place = self.index.to_bytes(2, "big") + bytes((self.subindex, 0, 0, 0, self.size))
        return head + place + (self.data or b"")


@final
class DryveException(PeerError):  # noqa: N818 -- the manual's name
    """The drive refused a telegram.

    Attributes: line, request, code.
    """

    def __init__(self, line: str, request: Request, code: int) -> None:
        self.line = line
        self.request = request
        self.code = code
        what = "read" if request.data is None else f"write {request.data.hex(' ').upper()} to"
        text = _TEXT.get(code, "code not listed in its manual")
        super().__init__(f"{line}: {what} {request}: refused: {text} ({code:02X}h)")

    @property
    def is_silence(self) -> bool:
        """True if a gateway in front reports that the drive does not answer."""
        return self.code == _GATEWAY_TARGET_FAILED


@final
class DryveCodec:
    """Requests to bytes, bytes to PDUs; see `Codec`.

    Attributes: heard.
    """

    def __init__(self, line: str) -> None:
        self.heard: bytes = b""
        self._line = line
        self._buffer = b""
        self._repeats = False  # whether this drive repeats the transaction identifier

    @property
    def is_inside(self) -> bool:
        """True if the end of an answer is still to come."""
        return bool(self._buffer)

    def begin(self) -> None:
        """Forget received bytes, as a request is sent."""
        self.heard = b""

    def encode(self, exchange: Exchange[Request, bytes]) -> bytes:
        """Return the bytes of a request; the drive ignores the unit, but it must be sent."""
        pdu = exchange.request.pdu()
        length, unit = (len(pdu) + 1).to_bytes(2, "big"), bytes((exchange.unit,))
        return exchange.transaction.to_bytes(2, "big") + b"\0\0" + length + unit + pdu

    def feed(self, data: bytes, exchange: Exchange[Request, bytes] | None) -> bytes | None:
        """Return the PDU that `data` completes, if it may answer."""
        self._buffer += data
        answer: bytes | None = None
        while len(self._buffer) >= _MBAP:
            length = int.from_bytes(self._buffer[4:6], "big")
            if self._buffer[2:4] != b"\0\0" or length not in _LENGTHS:  # start again
                self.heard, self._buffer = self._buffer[:_HEARD_MAX], b""
                return answer
            end = _MBAP + length
            if len(self._buffer) < end:
                break
            adu, self._buffer = self._buffer[:end], self._buffer[end:]
            number = int.from_bytes(adu[:2], "big")
            if exchange is None or ((number or self._repeats) and number != exchange.transaction):
                continue
            self._repeats = bool(number)
            self.heard = adu
            answer = answer or adu[_MBAP + 1 :]
        if self._buffer:
            self.heard = self._buffer
        return answer

    def answers(self, answer: bytes, request: Request) -> bool:
        """Return whether a PDU may answer this very request: direction, object, length."""
        if answer[0] == _FUNCTION | _ERROR:
            return len(answer) > 1
        count = len(answer) - _HEAD
        if count < 0 or answer[: _HEAD - 1] != request.pdu()[: _HEAD - 1]:
            return False
        if request.data is None:
            return answer[_HEAD - 1] == count and 1 <= count <= request.size
        return answer[_HEAD - 1] == count and answer[_HEAD:] in (b"", request.data)

    def refusal(self, exchange: Exchange[Request, bytes], answer: bytes) -> MotorError | None:
        """Return the error of an exception."""
        if answer[0] != _FUNCTION | _ERROR:
            return None
        return DryveException(self._line, exchange.request, answer[1])

    def awaited(self, request: Request) -> str:
        """Return the words for the answer to a request."""
        return f"answer to {'read' if request.data is None else 'write'} {request}"


def data_of(answer: bytes) -> bytes:
    """Return the data of an answer to a read."""
    return answer[_HEAD:]
