"""Modbus RTU: checksum, one unit on a serial line, and framing. Sans-I/O.

The line separates frames by silence. A frame that is addressed neither to the unit nor to all is
ignored. This includes requests to other units, and their responses, which begin with their own
address.

A byte stream has no silences. If the length of a request follows from its function code, and its
CRC is correct there, it is a complete frame whatever follows. Everything else (an unknown function,
a wrong CRC, the beginning of a frame) is delimited by silence, which the caller with a clock
detects.

The checksum is CRC-16, polynomial A001h (reflected), low byte first.

Source: MODBUS over Serial Line, Specification and Implementation Guide V1.02, section 2; MODBUS
Application Protocol Specification V1.1b3, section 6 (lengths).
"""

from functools import lru_cache
from typing import Final, final

from motorhil.emulators.modbus.codes import BROADCAST, UNITS
from motorhil.emulators.modbus.server import ModbusServer

_POLYNOMIAL: Final = 0xA001
_SHORTEST: Final = 4  # address, function code, checksum
_LONGEST: Final = 256
_FUNCTION: Final = 1
_CRC: Final = 2

_FIXED: Final = {
    **dict.fromkeys((0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x08), 8),
    **dict.fromkeys((0x07, 0x0B, 0x0C, 0x11), 4),
    0x16: 10,
    0x18: 6,
    0x2B: 7,  # MEI type 0Eh; another one is delimited by silence
}
"""The lengths with address and CRC. Function 08h may be longer: then the CRC at 8 is wrong."""
_COUNTED: Final = {0x0F: 6, 0x10: 6, 0x14: 2, 0x15: 2, 0x17: 10}
"""The offset of the byte count in the frame."""


def _table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ (_POLYNOMIAL if crc & 1 else 0)
        table.append(crc)
    return table


_TABLE: Final = _table()


@lru_cache(maxsize=1024)  # polling clients repeat the same requests
def crc16(data: bytes) -> bytes:
    """Return the two CRC bytes that follow these bytes on the line."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return bytes((crc & 0xFF, crc >> 8))


def with_crc(data: bytes) -> bytes:
    """Return the bytes with their CRC appended."""
    return data + crc16(data)


@final
class RtuUnit:
    """One server address on a line.

    Args:
        unit: 1..247.
        server: the server that responds.
        reply_ns: from the end of a request (t3.5 after its last character) to its response [ns].

    Attributes:
        ignored: requests that came before the response to the previous one.

    Raises:
        ValueError: the unit or the reply time is out of range.
    """

    def __init__(self, unit: int, server: ModbusServer, reply_ns: int = 1_000_000) -> None:
        if unit not in UNITS or reply_ns < 0:
            raise ValueError(
                f"unit {unit}, reply_ns {reply_ns}: invalid; expected unit 1 to "
                "247, reply_ns 0 or more"
            )
        self.unit: Final = unit
        self.server: Final = server
        self.ignored: int = 0
        self._reply_ns: Final = reply_ns
        self._request = b""
        self._due_ns: int | None = None
        self._output: list[bytes] = []

    def receive(self, frame: bytes, now_ns: int) -> bool:
        """Process a frame on the line: the bytes between two silences, with their CRC.

        Returns:
            True if it was a broadcast, which acts at once.
        """
        diagnostics = self.server.diagnostics
        if not _SHORTEST <= len(frame) <= _LONGEST or crc16(frame[:-2]) != frame[-2:]:
            if diagnostics is not None:
                diagnostics.bus_errors += 1
            return False
        if diagnostics is not None:
            diagnostics.bus_messages += 1
        if frame[0] == BROADCAST:
            self.server.broadcast(frame[1:-2])
            return True
        if frame[0] == self.unit:
            if self._due_ns is not None:
                self.ignored += 1
            else:
                self._request = frame[1:-2]
                self._due_ns = now_ns + self._reply_ns
        return False

    def spoiled(self) -> None:
        """Count invalid characters on the line, after a pause in a frame or a collision."""
        if self.server.diagnostics is not None:
            self.server.diagnostics.bus_errors += 1

    def next_deadline_ns(self) -> int | None:
        """Return when the response is due [ns], or None without a request."""
        return self._due_ns

    def expire(self, now_ns: int) -> bool:
        """Respond with the current values if the response is due; return whether it was."""
        if self._due_ns is None or now_ns < self._due_ns:
            return False
        self._due_ns = None
        response = self.server.respond(self._request)
        if response:
            self._output.append(with_crc(bytes((self.unit,)) + response))
        return True

    def take_output(self) -> list[bytes]:
        """Return and clear the frames to send now."""
        output, self._output = self._output, []
        return output

    def power_off(self) -> None:
        """Drop the pending response."""
        self._due_ns = None
        self._output.clear()


@final
class RtuRequests:
    """The characters of a client, cut into frames."""

    def __init__(self) -> None:
        self._buffer = b""

    @property
    def waits(self) -> bool:
        """True if characters wait for silence, or for more characters."""
        return bool(self._buffer)

    def feed(self, data: bytes) -> list[bytes]:
        """Return the frames that these characters have completed, in order."""
        self._buffer += data
        frames: list[bytes] = []
        while True:
            length = _length(self._buffer)
            frame = self._buffer[:length]
            if not length or len(frame) < length or crc16(frame[:-_CRC]) != frame[-_CRC:]:
                break
            frames.append(frame)
            self._buffer = self._buffer[length:]
        if len(self._buffer) > _LONGEST:  # too long for any frame
            frames.append(self.silence())
        return frames

    def silence(self) -> bytes:
        """Return the characters before a silence as one frame, valid or not."""
        rest, self._buffer = self._buffer, b""
        return rest


def _length(buffer: bytes) -> int:
    """Return the length of the request at the start of the buffer, or 0 if not known (yet)."""
    if len(buffer) <= _FUNCTION:
        return 0
    function = buffer[_FUNCTION]
    place = _COUNTED.get(function)
    if place is None:
        return _FIXED.get(function, 0)
    return place + 1 + buffer[place] + _CRC if len(buffer) > place else 0
