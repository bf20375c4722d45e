"""Modbus RTU: one unit on a serial line. Sans-I/O.

The line separates frames by silence; this module processes them. A frame that is addressed neither
to the unit nor to all is ignored. This includes requests to other units, and their responses, which
begin with their own address.

Source: MODBUS over Serial Line, Specification and Implementation Guide V1.02, section 2.
"""

from typing import Final, final

from emulators.modbus.codes import BROADCAST, UNITS
from emulators.modbus.crc import crc16, with_crc
from emulators.modbus.server import ModbusServer

_SHORTEST: Final = 4  # address, function code, checksum
_LONGEST: Final = 256


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
        self.ignored = 0
        self._reply_ns: Final = reply_ns
        self._request = b""
        self._due_ns: int | None = None
        self._output: list[bytes] = []

    def receive(self, frame: bytes, now_ns: int) -> None:
        """Process a frame on the line: the bytes between two silences, with their CRC."""
        diagnostics = self.server.diagnostics
        if not _SHORTEST <= len(frame) <= _LONGEST or crc16(frame[:-2]) != frame[-2:]:
            if diagnostics is not None:
                diagnostics.bus_errors += 1
            return
        if diagnostics is not None:
            diagnostics.bus_messages += 1
        if frame[0] == BROADCAST:
            self.server.broadcast(frame[1:-2])
        elif frame[0] == self.unit:
            if self._due_ns is not None:
                self.ignored += 1
                return
            self._request = frame[1:-2]
            self._due_ns = now_ns + self._reply_ns

    def spoiled(self) -> None:
        """Count invalid characters on the line, after a pause in a frame or a collision."""
        if self.server.diagnostics is not None:
            self.server.diagnostics.bus_errors += 1

    def next_deadline_ns(self) -> int | None:
        """Return when the response is due [ns], or None without a request."""
        return self._due_ns

    def expire(self, now_ns: int) -> None:
        """Respond with the current values if the response is due."""
        if self._due_ns is None or now_ns < self._due_ns:
            return
        self._due_ns = None
        response = self.server.respond(self._request)
        if response:
            self._output.append(with_crc(bytes((self.unit,)) + response))

    def take_output(self) -> list[bytes]:
        """Return and clear the frames to send now."""
        output, self._output = self._output, []
        return output

    def power_off(self) -> None:
        """Drop the pending response."""
        self._due_ns = None
        self._output.clear()
