"""Modbus/TCP: a stream of bytes in, a stream of bytes out. Sans-I/O, one per connection.

Bytes may be split and joined anywhere; any number of requests may be under way at once, each is
answered in its turn, with its own transaction identifier. A stream that is not Modbus cannot be
found the way back into: it is closed.

Units: several controllers behind one address are a gateway's, and are told apart by the unit
identifier; a request to one that is not there is answered 0Bh (gateway target device failed to
respond). A controller that is alone is meant by FFh and 0 too. There is no broadcast on TCP.

Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, sections 3.1.3, 4.4.1 and 4.4.2.
"""

from collections.abc import Mapping
from typing import Final, final

from emulators.modbus.codes import ERROR, GATEWAY_TARGET_FAILED, PDU_MAX
from emulators.modbus.server import ModbusServer

_HEAD: Final = 7
_NOT_SIGNIFICANT: Final = (0x00, 0xFF)


@final
class MbapStream:
    """The server's end of one connection.

    Args:
        units: who answers, by unit identifier.

    Attributes:
        closed_because: why the connection is to be closed; None: it is well.
        requests: answered or not, counted.
    """

    def __init__(self, units: Mapping[int, ModbusServer]) -> None:
        self.closed_because: str | None = None
        self.requests = 0
        self._units: Final = units
        self._buffer = bytearray()

    def feed(self, data: bytes) -> bytes:
        """What goes back after these bytes; b"": nothing yet."""
        if self.closed_because is not None:
            return b""
        buffer = self._buffer
        buffer += data
        out: list[bytes] = []
        while len(buffer) >= _HEAD:
            protocol = int.from_bytes(buffer[2:4], "big")
            length = int.from_bytes(buffer[4:6], "big")
            if protocol != 0 or not 2 <= length <= PDU_MAX + 1:
                what = f"protocol {protocol}, length {length}"
                self.closed_because = f"no Modbus: {what}; must be 0, and 2 to {PDU_MAX + 1}"
                buffer.clear()
                break
            end = 6 + length
            if len(buffer) < end:
                break
            response = self._answer(buffer[6], bytes(buffer[_HEAD:end]))
            if response:
                size = (len(response) + 1).to_bytes(2, "big")
                out.append(bytes(buffer[:4]) + size + buffer[6:7] + response)
            del buffer[:end]
        return b"".join(out)

    def _answer(self, unit: int, request: bytes) -> bytes:
        self.requests += 1
        server = self._units.get(unit)
        if server is None and unit in _NOT_SIGNIFICANT and len(self._units) == 1:
            server = next(iter(self._units.values()))
        if server is None:
            return bytes((request[0] | ERROR, GATEWAY_TARGET_FAILED))
        return server.respond(request)
