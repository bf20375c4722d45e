"""The client of canopen on a `Wire`; its waits play the wire."""

import queue
import types

import canopen
import canopen.profiles.p402 as p402
from canopen.sdo import SdoClient

from tests.support.canopen.drive_wire import RTR, Wire, text_of


class WireNetwork(canopen.Network):
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

    def pump(self, duration_ns: int) -> None:
        self.pump_until(lambda: False, duration_ns / 1e9)

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


class WireSdoClient(SdoClient):
    RESPONSE_TIMEOUT = 0.3

    def read_response(self):
        self.network.pump_until(lambda: not self.responses.empty(), self.RESPONSE_TIMEOUT)
        if self.responses.empty():
            raise canopen.SdoCommunicationError("No SDO response received")
        item = self.responses.get_nowait()
        self.responses = queue.Queue()
        self.responses.put(item)
        return super().read_response()


class WireCondition:
    """A replacement of threading.Condition whose wait plays time until a notification."""

    def __init__(self, network: WireNetwork) -> None:
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
        return self._network.pump_until(lambda: self._notified, timeout or 10.0)


class WireNode402(p402.BaseNode402):
    def add_sdo(self, rx_cobid, tx_cobid):
        client = WireSdoClient(rx_cobid, tx_cobid, self.object_dictionary)
        self.sdo_channels.append(client)
        return client

    def wait_on(self, network: WireNetwork) -> None:
        """Let PDO maps wait on the wire; required after each `pdo.read()`, which makes new ones."""
        for maps in (self.tpdo, self.rpdo):
            for pdo in maps.values():
                pdo.receive_condition = WireCondition(network)


def connect(wire: Wire, eds, monkeypatch, node_id: int = 5) -> tuple[WireNetwork, WireNode402]:
    """Return a client that knows the drive's EDS, after the boot of the drive."""
    network = WireNetwork(wire)
    node = WireNode402(node_id, str(eds))
    network.add_node(node)
    clock = types.SimpleNamespace(monotonic=lambda: wire.now / 1e9, sleep=None)
    monkeypatch.setattr(p402, "time", clock)
    assert network.pump_until(lambda: node.nmt.state == "PRE-OPERATIONAL", 1.0)
    return network, node


def set_up_402(network: WireNetwork, node: WireNode402, cyclic_tpdos=(1, 2)) -> None:
    """Make status TPDOs cyclic, as BaseNode402 requires, and the node operational."""
    for number in cyclic_tpdos:
        node.sdo[0x1800 + number - 1][5].raw = 5
    node.nmt.state = "OPERATIONAL"
    node.setup_402_state_machine()
    node.wait_on(network)
    network.pump(20_000_000)
