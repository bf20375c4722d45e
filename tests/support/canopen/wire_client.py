"""The client of canopen on a `Wire`; its waits play the wire."""

from tests.support.canopen.drive_wire import RTR, Wire, text_of
from tests.support.canopen.pumped_client import PumpedNetwork, PumpedNode402, booted


class WireNetwork(PumpedNetwork):
    """A network without connection: frames use the host's port, and arrive after each event."""

    def __init__(self, wire: Wire) -> None:
        super().__init__()
        self.wire = wire
        self._inbox: list[tuple[bytes, int]] = []
        wire.listeners.append(lambda raw, now_ns: self._inbox.append((raw, now_ns)))

    def send_message(self, can_id, data, remote=False):
        data = bytes(data)
        head = (can_id | RTR if remote else can_id).to_bytes(4, "little")
        self.wire.host.send(head + bytes((len(data), 0, 0, 0)) + data.ljust(8, b"\0"))

    def now_ns(self) -> int:
        return self.wire.now

    def pump_until(self, done, timeout_s: float) -> bool:
        """Play the wire and return whether `done` in time; the client hears each complete frame."""
        end = self.wire.now + round(timeout_s * 1e9)
        self._deliver()
        while not done():
            due = self.wire.queue.next_time_ns()
            if due is None or due > end:
                self.wire.run_to(end)
                self._deliver()
                return bool(done())
            self.wire.queue.run_next()
            self._deliver()
        return True

    def _deliver(self) -> None:
        while self._inbox:
            raw, now_ns = self._inbox.pop(0)
            if not raw[3]:  # neither remote nor 29-bit
                data = bytearray.fromhex(text_of(raw).partition("#")[2])
                self.notify(int.from_bytes(raw[:4], "little"), data, now_ns / 1e9)


def connect(wire: Wire, eds, monkeypatch, node_id: int = 5) -> tuple[WireNetwork, PumpedNode402]:
    """Return a client that knows the drive's EDS, after the boot of the drive."""
    network = WireNetwork(wire)
    return network, booted(network, eds, monkeypatch, node_id)
