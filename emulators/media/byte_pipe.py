"""A stream of bytes between a client and a server, as TCP is: in order, split and joined. Sans-I/O.

Each connection has two directions. What is sent arrives a latency later, in one piece unless a
fault splits it; what was sent before arrives before. Faults: a PAUSE splits what is sent (the rest
comes later), DELAY holds it up with all that follows, LOSE and TRUNCATE lose the rest of the
connection as a broken one does: nothing arrives in that direction any more. REPEAT and NOISE are no
faults of TCP and do nothing here.
"""

from collections import deque
from typing import Final, final

from emulators.media.serial_faults import Fate, SerialFaultPlan

# (bytes, connection, whether they go to the server)
PipeDelivery = tuple[bytes, int, bool]


@final
class _Direction:
    """One way of one connection."""

    __slots__ = ("free_ns", "is_broken", "name", "waiting")

    def __init__(self, name: str) -> None:
        self.name = name
        self.free_ns = 0
        self.is_broken = False
        self.waiting: deque[tuple[int, int, bytes]] = deque()  # (due, turn, bytes)


@final
class BytePipe:
    """All connections to one address.

    Args:
        name: what records call it.
        latency_ns: from sending to arriving [ns].
        faults: what goes wrong, on purpose; None: nothing ever does.
    """

    def __init__(
        self, name: str, latency_ns: int = 50_000, faults: SerialFaultPlan | None = None
    ) -> None:
        if latency_ns < 0:
            raise ValueError(f"latency {latency_ns} ns: 0 or more")
        self.name: Final = name
        self._latency_ns: Final = latency_ns
        self._plan: Final = faults
        self._ways: list[tuple[_Direction, _Direction]] = []  # to the server, to the client
        self._turn = 0

    def connect(self, client: str, server: str) -> int:
        """The number of a new connection."""
        self._ways.append((_Direction(client), _Direction(server)))
        return len(self._ways) - 1

    def close(self, connection: int) -> None:
        """What is still on its way is lost."""
        for way in self._ways[connection]:
            way.is_broken = True
            way.waiting.clear()

    def submit(self, connection: int, to_server: bool, data: bytes, now_ns: int) -> None:
        """These bytes were sent."""
        way = self._ways[connection][0 if to_server else 1]
        if way.is_broken or not data:
            return
        fate: Fate = (data, 0, 0, 0, True)
        if self._plan is not None:
            fate = self._plan.fates(data, way.name, now_ns)[0]
        sent, later_ns, pause_after, pause_ns, is_heard = fate
        if not is_heard:
            way.is_broken = True
            return
        at_ns = max(now_ns + self._latency_ns + later_ns, way.free_ns)
        if pause_ns and 0 < pause_after < len(sent):
            self._put(way, sent[:pause_after], at_ns)
            self._put(way, sent[pause_after:], at_ns + pause_ns)
        else:
            self._put(way, sent if len(sent) <= len(data) else data, at_ns)
        if len(sent) < len(data):
            way.is_broken = True

    def _put(self, way: _Direction, data: bytes, due_ns: int) -> None:
        self._turn += 1
        way.free_ns = due_ns
        way.waiting.append((due_ns, self._turn, data))

    def next_deadline_ns(self) -> int | None:
        """When something arrives [ns]; None: nothing is on its way."""
        first = self._first()
        return None if first is None else first[0]

    def expire(self, now_ns: int) -> list[PipeDelivery]:
        """What has arrived by now, in order."""
        out: list[PipeDelivery] = []
        while True:
            first = self._first()
            if first is None or first[0] > now_ns:
                return out
            _, _, connection, to_server = first
            way = self._ways[connection][0 if to_server else 1]
            out.append((way.waiting.popleft()[2], connection, to_server))

    def _first(self) -> tuple[int, int, int, bool] | None:
        best: tuple[int, int, int, bool] | None = None
        for connection, (forth, back) in enumerate(self._ways):
            for way, to_server in ((forth, True), (back, False)):
                if way.waiting:
                    due_ns, turn, _ = way.waiting[0]
                    if best is None or (due_ns, turn) < best[:2]:
                        best = (due_ns, turn, connection, to_server)
        return best
