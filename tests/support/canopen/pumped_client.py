"""canopen's client, unmodified, in virtual time: its waits advance the time of its network.

The recipe: no `connect()`, and received frames are passed to `Network.notify`. The SDO client's
queue, the PDO maps' conditions and p402's clock are replaced by versions that advance virtual time.
"""

import queue
import types
from abc import abstractmethod

import canopen
import canopen.profiles.p402 as p402
from canopen.sdo import SdoClient


class PumpedNetwork(canopen.Network):
    """A network without connection; subclasses send frames and let virtual time pass."""

    @abstractmethod
    def now_ns(self) -> int:
        """Return the network's time."""

    @abstractmethod
    def pump_until(self, done, timeout_s: float) -> bool:
        """Let time pass, with frames both ways, and return whether `done` in time."""

    def pump(self, duration_ns: int) -> None:
        self.pump_until(lambda: False, duration_ns / 1e9)


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

    def __init__(self, network: PumpedNetwork) -> None:
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

    def wait_on(self, network: PumpedNetwork) -> None:
        """Let PDO maps wait in virtual time; required after each `pdo.read()`."""
        for maps in (self.tpdo, self.rpdo):
            for pdo in maps.values():
                pdo.receive_condition = PumpedCondition(network)


def booted(network: PumpedNetwork, eds, monkeypatch, node_id: int) -> PumpedNode402:
    """Return a node on the network that knows the drive's EDS, after the boot of the drive."""
    node = PumpedNode402(node_id, str(eds))
    network.add_node(node)
    clock = types.SimpleNamespace(monotonic=lambda: network.now_ns() / 1e9, sleep=None)
    monkeypatch.setattr(p402, "time", clock)
    assert network.pump_until(lambda: node.nmt.state == "PRE-OPERATIONAL", 1.0)
    return node


def set_up_402(network: PumpedNetwork, node: PumpedNode402, cyclic_tpdos=(1, 2)) -> None:
    """Make status TPDOs cyclic, as BaseNode402 requires, and the node operational."""
    for number in cyclic_tpdos:
        node.sdo[0x1800 + number - 1][5].raw = 5
    node.nmt.state = "OPERATIONAL"
    node.setup_402_state_machine()
    node.wait_on(network)
    network.pump(20_000_000)
