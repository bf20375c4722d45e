"""Requests in characters whose silences were lost: a pseudo-terminal hands over bytes, not times.

A request whose length follows from its function code, and whose check sum is right there, is a
frame at once, whatever follows it. Anything else (an unknown function, a wrong check sum, the
beginning of a frame) is told apart by silence, which whoever has a clock tells. Sans-I/O.

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
    0x2B: 7,  # MEI type 0Eh; another one is told apart by silence
}
"""With address and check sum. Function 08h may be longer: then its check sum is wrong at 8."""
_COUNTED: Final = {0x0F: 6, 0x10: 6, 0x14: 2, 0x15: 2, 0x17: 10}
"""Where in the frame the number of bytes stands that follow it."""


@final
class RtuRequests:
    """What a client writes, cut into frames."""

    def __init__(self) -> None:
        self._buffer = b""

    @property
    def waits(self) -> bool:
        """Whether there are characters that silence, or more of them, must make a frame."""
        return bool(self._buffer)

    def feed(self, data: bytes) -> list[bytes]:
        """The frames that these characters have completed, in order."""
        self._buffer += data
        frames: list[bytes] = []
        while True:
            length = _length(self._buffer)
            frame = self._buffer[:length]
            if not length or len(frame) < length or crc16(frame[:-_CRC]) != frame[-_CRC:]:
                break
            frames.append(frame)
            self._buffer = self._buffer[length:]
        if len(self._buffer) > _LONGEST:  # no frame any more, whatever follows
            frames.append(self.silence())
        return frames

    def silence(self) -> bytes:
        """Nothing came for a while: what was there is one frame, right or wrong."""
        rest, self._buffer = self._buffer, b""
        return rest


def _length(buffer: bytes) -> int:
    """How long the request is that the buffer begins with; 0: not known (yet)."""
    if len(buffer) <= _FUNCTION:
        return 0
    function = buffer[_FUNCTION]
    place = _COUNTED.get(function)
    if place is None:
        return _FIXED.get(function, 0)
    return place + 1 + buffer[place] + _CRC if len(buffer) > place else 0
