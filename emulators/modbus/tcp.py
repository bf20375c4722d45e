"""Modbus/TCP: requests and responses in a byte stream. Sans-I/O.

Bytes may be split and joined anywhere. Any number of requests may be pending at once, distinguished
by their transaction identifiers. A stream that is not Modbus cannot be resynchronised: its
connection is closed.

Controllers behind one address belong to a gateway and are distinguished by the unit identifier. A
request to a unit that does not exist, or does not respond, gets 0Bh (gateway target device failed
to respond). If too many requests wait for one unit, the next one gets 0Ah (gateway path
unavailable: overloaded). Requests of a disconnected client that the unit has not received are
dropped. A single controller also accepts FFh and 0. TCP has no broadcast.

Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, sections 3.1.3, 4.4.1 and 4.4.2.
"""

import struct
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

from motorhil.emulators.modbus.codes import (
    ERROR,
    GATEWAY_PATH_UNAVAILABLE,
    GATEWAY_TARGET_FAILED,
    PDU_MAX,
)

GATEWAY_TIMEOUT_NS: Final = 1_000_000_000
_MBAP: Final = struct.Struct(">HHHB")  # transaction, protocol, length, unit identifier
_HEAD: Final = _MBAP.size
_WAITING_MAX: Final = 64  # requests to one unit
_NOT_SIGNIFICANT: Final = (0x00, 0xFF)

# (transaction identifier, unit identifier, PDU)
Request = tuple[int, int, bytes]


def adu(transaction: int, unit: int, pdu: bytes) -> bytes:
    """Return the PDU behind its MBAP header."""
    return _MBAP.pack(transaction, 0, len(pdu) + 1, unit) + pdu


@final
class MbapStream:
    """One direction of one connection.

    Attributes:
        closed_because: the reason for closing the connection, or None.
    """

    def __init__(self) -> None:
        self.closed_because: str | None = None
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Request]:
        """Return the requests that these bytes have completed, in order."""
        if self.closed_because is not None:
            return []
        buffer = self._buffer
        buffer += data
        complete: list[Request] = []
        while len(buffer) >= _HEAD:
            transaction, protocol, length, unit = _MBAP.unpack_from(buffer)
            if protocol != 0 or not 2 <= length <= PDU_MAX + 1:
                what = f"protocol {protocol}, length {length}"
                self.closed_because = f"no Modbus: {what}; must be 0, and 2 to {PDU_MAX + 1}"
                buffer.clear()
                break
            end = 6 + length
            if len(buffer) < end:
                break
            complete.append((transaction, unit, bytes(buffer[_HEAD:end])))
            del buffer[:end]
        return complete


@final
@dataclass(slots=True, eq=False)
class _Pending:
    """A pending request."""

    connection: int
    transaction: int
    asked_unit: int
    pdu: bytes
    due_ns: int


@final
class TcpGateway:
    """The link between connections and units: one request at a time for each unit.

    Args:
        timeout_ns: the response timeout of a unit [ns].

    Attributes:
        requests, timeouts: counted.
    """

    def __init__(self, timeout_ns: int = GATEWAY_TIMEOUT_NS) -> None:
        self.requests: int = 0
        self.timeouts: int = 0
        self._timeout_ns: Final = timeout_ns
        self._queues: dict[int, deque[_Pending]] = {}
        self._owed_until_ns: dict[int, int] = {}  # by unit that timed out and may still respond

    def add_unit(self, unit: int) -> None:
        """Add a controller with this address.

        Raises:
            ValueError: the address is taken.
        """
        if unit in self._queues:
            raise ValueError(
                f"unit {unit}: already used by another controller; expected a unique unit"
            )
        self._queues[unit] = deque()

    def ask(self, connection: int, request: Request, now_ns: int) -> tuple[int, bytes] | None:
        """Queue a request.

        Returns:
            (unit, PDU) to hand on now; None: it waits for its turn.
        """
        self.requests += 1
        unit = self._unit(request[1])
        queue = self._queues[unit]
        queue.append(_Pending(connection, *request, now_ns + self._timeout_ns))
        return (unit, request[2]) if len(queue) == 1 and unit not in self._owed_until_ns else None

    def knows(self, asked_unit: int) -> bool:
        """Return whether there is a controller for this unit identifier."""
        return self._unit(asked_unit) in self._queues

    def refusal(self, request: Request) -> bytes:
        """Return the response to a request to an unknown or overloaded unit."""
        transaction, unit, pdu = request
        code = GATEWAY_PATH_UNAVAILABLE if self.is_full(unit) else GATEWAY_TARGET_FAILED
        return adu(transaction, unit, bytes((pdu[0] | ERROR, code)))

    def is_full(self, asked_unit: int) -> bool:
        """Return whether the queue of this unit is full."""
        return len(self._queues.get(self._unit(asked_unit), ())) >= _WAITING_MAX

    def answered(self, unit: int, pdu: bytes) -> tuple[int, bytes] | None:
        """Return (connection, ADU) for a unit's response; None if no client waits for it."""
        if self._owed_until_ns.pop(unit, None) is not None:
            return None  # its line cannot distinguish a late response from the next one
        queue = self._queues[unit]
        if not queue:
            return None
        pending = queue.popleft()
        return pending.connection, adu(pending.transaction, pending.asked_unit, pdu)

    def next_for(self, unit: int, now_ns: int) -> bytes | None:
        """Return the next PDU for the unit and start its timeout, or None."""
        queue = self._queues[unit]
        if not queue or unit in self._owed_until_ns:
            return None
        queue[0].due_ns = now_ns + self._timeout_ns
        return queue[0].pdu

    def next_deadline_ns(self) -> int | None:
        """Return the time of the next timeout of a unit [ns]."""
        due_ns = list(self._owed_until_ns.values())
        for unit, queue in self._queues.items():
            if queue and unit not in self._owed_until_ns:
                due_ns.append(queue[0].due_ns)
        return min(due_ns, default=None)

    def expired(self, now_ns: int) -> list[tuple[int, int, bytes]]:
        """Return (unit, connection, ADU) for each timed-out unit; call `next_for` then."""
        out: list[tuple[int, int, bytes]] = []
        for unit, queue in self._queues.items():
            owed_ns = self._owed_until_ns.get(unit)
            if owed_ns is not None:
                if owed_ns <= now_ns:
                    del self._owed_until_ns[unit]
                    out.append((unit, GONE, b""))
            elif queue and queue[0].due_ns <= now_ns:
                pending = queue.popleft()
                self.timeouts += 1
                self._owed_until_ns[unit] = now_ns + self._timeout_ns
                request = (pending.transaction, pending.asked_unit, pending.pdu)
                out.append((unit, pending.connection, self.refusal(request)))
        return out

    def forget(self, connection: int) -> None:
        """Drop the requests of a connection; a unit still executes the one it has received."""
        for unit, queue in self._queues.items():
            for pending in tuple(queue):
                if pending.connection != connection:
                    continue
                if pending is queue[0] and unit not in self._owed_until_ns:
                    pending.connection = GONE
                else:
                    queue.remove(pending)

    def units(self) -> Sequence[int]:
        """Return the addresses of the units."""
        return tuple(self._queues)

    def _unit(self, asked: int) -> int:
        if asked not in self._queues and asked in _NOT_SIGNIFICANT and len(self._queues) == 1:
            return next(iter(self._queues))
        return asked


GONE: Final = -1
"""The value in place of a closed connection."""
