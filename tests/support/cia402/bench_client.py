"""canopen's client against a bench: its waits advance the bench's time."""

from tests.support.canopen.pumped_client import PumpedNetwork, PumpedNode402, booted
from tests.support.cia402.bench import NODE, Bench

FRAME_NS = 120_000  # approximately one 8-byte frame at 1 Mbit/s


class BenchNetwork(PumpedNetwork):
    """A network where frames take time both ways; delivery never happens inside `send`."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self.bench = bench
        self._heard = len(bench.sent)

    def send_message(self, can_id, data, remote=False):
        assert not remote
        self.pump(FRAME_NS)
        self.bench.send(can_id, bytes(data))

    def now_ns(self) -> int:
        return self.bench.now

    def pump(self, duration_ns: int) -> None:
        """Advance time; the client receives every frame at its time."""
        end = self.bench.now + duration_ns
        while True:
            while self._heard < len(self.bench.sent):
                time_ns, can_id, data = self.bench.sent[self._heard]
                self._heard += 1
                self.notify(can_id, bytearray(data), time_ns / 1e9)
            due = self.bench.drive.next_deadline_ns()
            if due is None or due > end:
                break
            self.bench.run_until(due)
        self.bench.run_until(end)

    def pump_until(self, done, timeout_s: float) -> bool:
        end = self.bench.now + round(timeout_s * 1e9)
        while not done() and self.bench.now < end:
            self.pump(min(100_000, end - self.bench.now))
        return bool(done())


def connect(bench: Bench, eds: str, monkeypatch) -> tuple[BenchNetwork, PumpedNode402]:
    """Return a network and a node whose drive is pre-operational, with p402's clock replaced."""
    network = BenchNetwork(bench)
    return network, booted(network, eds, monkeypatch, NODE)
