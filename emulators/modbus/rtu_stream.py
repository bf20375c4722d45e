"""RTU framing for a byte stream without silences. Sans-I/O.

If the length of a request follows from its function code, and its CRC is correct there, it is a
complete frame whatever follows. Everything else (an unknown function, a wrong CRC, the beginning of
a frame) is delimited by silence, which the caller with a clock detects.

Source: MODBUS Application Protocol Specification V1.1b3, section 6 (lengths); MODBUS over Serial
Line V1.02, section 2.5.1.1 (silence).
"""

from typing import Final, final

from emulators.modbus.crc import crc16

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
