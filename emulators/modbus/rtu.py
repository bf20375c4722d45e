"""A unit on a serial line: frames in, frames out, in RTU. Sans-I/O.

The line tells frames apart by silence; here is what a unit does with one. What is not addressed to
it, nor to all, is not its own: requests to others, and the responses of others, which begin with
their own address.

Source: MODBUS over Serial Line, Specification and Implementation Guide V1.02, section 2.
"""

from typing import Final, final

from emulators.modbus.codes import BROADCAST, UNITS
from emulators.modbus.crc import crc16, with_crc
from emulators.modbus.server import ModbusServer

_SHORTEST: Final = 4  # address, function code, check sum
_LONGEST: Final = 256


@final
class RtuUnit:
    """One server address on a line.

    Args:
        unit: 1..247.
        server: what answers.
        reply_ns: from the end of a request (t3.5 after its last character) to its response [ns].

    Attributes:
        ignored: requests that came before it had answered the one before.

    Raises:
        ValueError: no such unit.
    """

    def __init__(self, unit: int, server: ModbusServer, reply_ns: int = 1_000_000) -> None:
        if unit not in UNITS or reply_ns < 0:
            raise ValueError(f"unit {unit}, reply after {reply_ns} ns: 1 to 247, 0 or more")
        self.unit: Final = unit
        self.server: Final = server
        self.ignored = 0
        self._reply_ns: Final = reply_ns
        self._request = b""
        self._due_ns: int | None = None
        self._output: list[bytes] = []

    def receive(self, frame: bytes, now_ns: int) -> None:
        """A frame was on the line: what was between two silences, with its check sum."""
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
        """Something was on the line that is no frame: a pause in it, or a collision."""
        if self.server.diagnostics is not None:
            self.server.diagnostics.bus_errors += 1

    def next_deadline_ns(self) -> int | None:
        """When it answers [ns]; None: it was not asked."""
        return self._due_ns

    def expire(self, now_ns: int) -> None:
        """It answers, with what is so now."""
        if self._due_ns is None or now_ns < self._due_ns:
            return
        self._due_ns = None
        response = self.server.respond(self._request)
        if response:
            self._output.append(with_crc(bytes((self.unit,)) + response))

    def take_output(self) -> list[bytes]:
        """Frames to send now; they are then forgotten here."""
        output, self._output = self._output, []
        return output

    def power_off(self) -> None:
        """What it was about to answer is forgotten."""
        self._due_ns = None
        self._output.clear()
