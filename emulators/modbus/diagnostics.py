"""Function 08h: counters and diagnostics of a server on a serial line.

Counters have 16 bits and wrap around. Messages and communication errors are those of the whole
line; every listener counts them.

Source: MODBUS Application Protocol Specification V1.1b3, section 6.8.
"""

from typing import Final, final

from emulators.modbus.codes import DIAGNOSTICS, ERROR, ILLEGAL_DATA_VALUE, ILLEGAL_FUNCTION

_QUERY_DATA: Final = 0x00
_RESTART: Final = 0x01
_REGISTER: Final = 0x02
_LISTEN_ONLY: Final = 0x04
_CLEAR: Final = 0x0A
_CLEAR_OVERRUN: Final = 0x14
_KEEP_LOG: Final = b"\x00\x00"
_CLEAR_LOG: Final = b"\xff\x00"


@final
class Diagnostics:
    """The counters of one unit, and its listen-only state.

    Attributes:
        bus_messages: messages on the line with a correct checksum.
        bus_errors: messages with a wrong checksum.
        exceptions: exception responses of this unit.
        server_messages: messages to this unit, or to all.
        no_responses: those of them without a response.
        overruns: characters that came faster than they could be read.
        listens_only: the unit does not respond until it is restarted.
        restarts_counted: number of communication restarts since power-on.
    """

    def __init__(self) -> None:
        self.restarts_counted = 0
        self.begin()

    def begin(self) -> None:
        """Restart communication: clear the counters and leave listen-only."""
        self.clear()
        self.listens_only = False

    def clear(self) -> None:
        """Clear the counters."""
        self.bus_messages = 0
        self.bus_errors = 0
        self.exceptions = 0
        self.server_messages = 0
        self.no_responses = 0
        self.overruns = 0

    def restarts(self, request: bytes) -> bool:
        """Return whether the request ends the listen-only state."""
        return len(request) == 5 and request[:3] == bytes((DIAGNOSTICS, 0, _RESTART))

    def respond(self, request: bytes) -> bytes:
        """Return the response PDU, or b"" for no response."""
        if len(request) < 3:
            return bytes((DIAGNOSTICS | ERROR, ILLEGAL_DATA_VALUE))
        what = int.from_bytes(request[1:3], "big")
        data = request[3:]
        if what == _QUERY_DATA:
            # any number of words is returned unchanged
            return request if data and not len(data) % 2 else self._refused(ILLEGAL_DATA_VALUE)
        if what == _RESTART:
            if data not in (_KEEP_LOG, _CLEAR_LOG):
                return self._refused(ILLEGAL_DATA_VALUE)
            listened = self.listens_only
            self.begin()
            self.restarts_counted += 1
            return b"" if listened else request
        counters = {
            _REGISTER: 0,
            0x0B: self.bus_messages,
            0x0C: self.bus_errors,
            0x0D: self.exceptions,
            0x0E: self.server_messages,
            0x0F: self.no_responses,
            0x10: 0,  # "negative acknowledge" is never sent
            0x11: 0,  # nor "busy"
            0x12: self.overruns,
        }
        if what not in counters and what not in (_LISTEN_ONLY, _CLEAR, _CLEAR_OVERRUN):
            return self._refused(ILLEGAL_FUNCTION)
        if data != b"\x00\x00":
            return self._refused(ILLEGAL_DATA_VALUE)
        if what == _LISTEN_ONLY:
            self.listens_only = True
            return b""
        if what == _CLEAR:
            self.clear()
            return request
        if what == _CLEAR_OVERRUN:
            self.overruns = 0
            return request
        return request[:3] + (counters[what] & 0xFFFF).to_bytes(2, "big")

    def _refused(self, code: int) -> bytes:
        return bytes((DIAGNOSTICS | ERROR, code))
