"""canopen's client, unmodified, against a bench: its waits advance the bench's time.

The recipe: no `connect()`, and the drive's frames are passed to `Network.notify`. The SDO client's
queue, the PDO maps' conditions and p402's clock are replaced by versions that advance virtual time.
"""

import queue
import types

import canopen
import canopen.profiles.p402 as p402
from canopen.sdo import SdoClient

from tests.support.cia402.bench import MS, NODE, Bench

FRAME_NS = 120_000  # approximately one 8-byte frame at 1 Mbit/s


class BenchNetwork(canopen.Network):
    """A network where frames take time both ways; delivery never happens inside `send`."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self.bench = bench
        self._heard = len(bench.sent)

    def send_message(self, can_id, data, remote=False):
        assert not remote
        self.pump(FRAME_NS)
        self.bench.send(can_id, bytes(data))

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


class PumpedSdoClient(SdoClient):
    RESPONSE_TIMEOUT = 0.3

    def read_response(self):
        self.network.pump_until(lambda: not self.responses.empty(), self.RESPONSE_TIMEOUT)
        if self.responses.empty():
            raise canopen.SdoCommunicationError("No SDO response received")
        item = self.responses.get_nowait()
        self.responses = queue.Queue()
        self.responses.put(item)
        return super().read_response()


class PumpedCondition:
    """A replacement for threading.Condition: waiting advances time until a notification."""

    def __init__(self, network: BenchNetwork) -> None:
        self._network = network
        self._notified = False

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return False

    def notify_all(self) -> None:
        self._notified = True

    def wait(self, timeout=None) -> bool:
        self._notified = False
        return self._network.pump_until(
            lambda: self._notified, 10.0 if timeout is None else timeout
        )


class PumpedNode402(p402.BaseNode402):
    def add_sdo(self, rx_cobid, tx_cobid):
        client = PumpedSdoClient(rx_cobid, tx_cobid, self.object_dictionary)
        self.sdo_channels.append(client)
        return client


def connect(bench: Bench, eds: str, monkeypatch) -> tuple[BenchNetwork, PumpedNode402]:
    """Return a network and a node whose drive is pre-operational, with p402's clock replaced."""
    network = BenchNetwork(bench)
    node = PumpedNode402(NODE, eds)
    network.add_node(node)
    clock = types.SimpleNamespace(monotonic=lambda: bench.now / 1e9, sleep=None)
    monkeypatch.setattr(p402, "time", clock)
    network.pump(300 * MS)
    assert node.nmt.state == "PRE-OPERATIONAL"
    return network, node


def set_up(network: BenchNetwork, node: PumpedNode402, cyclic_tpdos=(1, 2)) -> None:
    for number in cyclic_tpdos:
        node.sdo[0x1800 + number - 1][5].raw = 5
    node.nmt.state = "OPERATIONAL"
    node.setup_402_state_machine()
    for maps in (node.tpdo, node.rpdo):
        for pdo in maps.values():
            pdo.receive_condition = PumpedCondition(network)
    network.pump(20 * MS)
