"""The gateway to SocketCAN, with an interface that brings frames faster than a bus takes them."""

from types import SimpleNamespace

import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.gateways import socketcan
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World

FLOOD = 20_000
MS = 1_000_000


class Interface:
    """A CAN_RAW socket of the kernel, with this many frames to read."""

    def __init__(self, frame):
        self.left = FLOOD
        self._frame = frame

    def bind(self, address):
        pass

    def setblocking(self, flag):
        pass

    def recv(self, size):
        if not self.left:
            raise BlockingIOError
        self.left -= 1
        return self._frame

    def send(self, frame):
        return len(frame)


@pytest.mark.parametrize("frame", [b"\1" + bytes(15), bytes(7)], ids=["valid", "refused"])
def test_flood_from_outside_waits_in_the_kernel(monkeypatch, frame):
    interface = Interface(frame)
    kernel = SimpleNamespace(
        socket=lambda *kind: interface, AF_CAN=29, SOCK_RAW=3, CAN_RAW=1, SOL_CAN_RAW=101
    )
    monkeypatch.setattr(socketcan, "socket", kernel)
    monkeypatch.setattr(socketcan, "link_kind", lambda name: "vcan")
    queue = EventQueue()
    world = World(queue)
    world.add_bus(CanBus("can0", 500_000))
    world.add_silent("can0", "listener")
    gateway = socketcan.SocketCanGateway("vcan0", world, "can0")
    gateway.readable(interface)
    assert interface.left == FLOOD - 1_024
    if gateway.ignored:
        return
    assert gateway.sources() == []
    queue.run_until(100 * MS)
    assert gateway.sources() == [interface]
    gateway.readable(interface)
    assert FLOOD - 2_048 < interface.left < FLOOD - 1_024
