"""An emulated TCP byte stream between a client and a server. Sans-I/O.

Each connection has two directions. Data arrive one latency after they were sent, in order, and in
one piece unless a fault splits them.

Faults: PAUSE splits the data and delays the rest. DELAY delays the data and all that follow. LOSE
discards these data only, as a gateway does whose serial line loses a frame. TRUNCATE breaks the
connection: nothing arrives in that direction any more. REPEAT and NOISE do not exist in TCP and
have no effect.
"""

from heapq import heappop, heappush
from typing import Final, final

from motorhil.emulators.media.serial_faults import Fate, SerialFaultPlan

_MBAP: Final = 6  # bytes of the header before the server address

# (bytes, connection, True if they go to the server)
PipeDelivery = tuple[bytes, int, bool]


@final
class _Direction:
    """One direction of one connection."""

    __slots__ = ("free_ns", "is_broken", "name")

    def __init__(self, name: str) -> None:
        self.name = name
        self.free_ns = 0
        self.is_broken = False  # data sent from now on are lost


@final
class BytePipe:
    """All connections to one address.

    Args:
        name: the name used in records.
        latency_ns: the time from sending to arrival [ns].
        faults: the faults to inject; None: no faults.
    """

    def __init__(
        self, name: str, latency_ns: int = 50_000, faults: SerialFaultPlan | None = None
    ) -> None:
        if latency_ns < 0:
            raise ValueError(f"latency_ns: invalid value {latency_ns}; expected 0 ns or more")
        self.name: Final = name
        self._latency_ns: Final = latency_ns
        self._plan: Final = faults
        # By number of an open connection: to the server, to the client.
        self._ways: dict[int, tuple[_Direction, _Direction]] = {}
        self._closing: set[int] = set()  # connections whose client has closed its end
        self._opened = 0
        self._waiting: list[tuple[int, int, bytes, int, bool]] = []  # (due, turn, and a delivery)
        self._turn = 0

    def connect(self, client: str, server: str) -> int:
        """Open a connection and return its number."""
        connection = self._opened
        self._opened += 1
        self._ways[connection] = _Direction(client), _Direction(server)
        return connection

    def close(self, connection: int) -> bool:
        """Close the client's end. Return False while data are on their way to the server.

        These still arrive, as in TCP (RFC 9293, 3.6). Nothing arrives at the client any more.
        """
        if connection in self._ways and self.pending(connection):
            self._closing.add(connection)
            return False
        self._ways.pop(connection, None)
        self._closing.discard(connection)
        return True

    def submit(
        self, connection: int, to_server: bool, data: bytes, now_ns: int, sender: str | None = None
    ) -> bytes:
        """Send bytes and return those that arrive, unless the connection is closed before.

        `sender` is the device behind that end, for fault rules.
        """
        ways = self._ways.get(connection)
        if ways is None or not data:
            return b""
        way = ways[0 if to_server else 1]
        if way.is_broken:
            return b""
        fate: Fate = (data, 0, 0, 0, True)
        if self._plan is not None:
            fate = self._plan.fates(data, sender or way.name, now_ns, _MBAP)[0]
        sent, later_ns, pause_after, pause_ns, is_heard = fate
        if not is_heard:
            return b""
        if len(sent) > len(data):  # noise does not exist in TCP
            sent = data
        at_ns = max(now_ns + self._latency_ns + later_ns, way.free_ns)
        if pause_ns and 0 < pause_after < len(sent):
            self._put(sent[:pause_after], at_ns, connection, to_server)
            at_ns += pause_ns
            self._put(sent[pause_after:], at_ns, connection, to_server)
        else:
            self._put(sent, at_ns, connection, to_server)
        way.free_ns = at_ns
        if len(sent) < len(data):
            way.is_broken = True
        return sent

    def _put(self, data: bytes, due_ns: int, connection: int, to_server: bool) -> None:
        self._turn += 1
        heappush(self._waiting, (due_ns, self._turn, data, connection, to_server))

    def pending(self, connection: int) -> int:
        """Return the number of bytes of the connection on their way to the server."""
        return sum(len(one[2]) for one in self._waiting if one[3] == connection and one[4])

    def next_deadline_ns(self) -> int | None:
        """Return the time of the next arrival [ns], or None if nothing is in transit."""
        waiting = self._waiting
        while waiting:
            due_ns, _, _, connection, _ = waiting[0]
            if connection in self._ways:
                return due_ns
            heappop(waiting)
        return None

    def expire(self, now_ns: int) -> list[PipeDelivery]:
        """Return the data that have arrived by `now_ns`, in order."""
        out: list[PipeDelivery] = []
        waiting = self._waiting
        while waiting and waiting[0][0] <= now_ns:
            _, _, data, connection, to_server = heappop(waiting)
            if connection in self._ways and (to_server or connection not in self._closing):
                out.append((data, connection, to_server))
        return out
