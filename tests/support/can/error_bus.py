"""An emulated bus in its own thread, with injectable error messages."""

import socket
import threading

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.gateways.loop import WallLoop
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from tests.support.can.error_messages import tell


class Order:
    """A gateway that receives orders "NAME NUL message" for the loop's thread, and answers them."""

    def __init__(self, world):
        self._world = world
        self._inside, self.outside = socket.socketpair()

    def sources(self):
        return [self._inside]

    def readable(self, source):
        name, _, message = source.recv(100).partition(b"\0")
        tell(self._world, "can0", name.decode(), message)
        source.send(b"done")

    def backlogged(self):
        return False

    def close(self):
        self._inside.close()
        self.outside.close()


class ErrorBench:
    """A world that `gateways(world)` serve."""

    channel = ""

    def __init__(self, gateways, data_bitrate_bit_s=None):
        queue = EventQueue()
        self.world = World(queue)
        self.world.add_bus(CanBus("can0", 1_000_000, data_bitrate_bit_s=data_bitrate_bit_s))
        self.world.add_host("can0", "ear", lambda *_: None)  # for the ACK
        self._loop = WallLoop(queue)
        self._order = Order(self.world)
        self.heard = []  # frames on the emulated bus: sender, frame
        self.came = threading.Event()  # set when there is one
        self.world.tap_frames(self._hear)
        for one in (*gateways(self.world), self._order):
            self._loop.add(one)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop.run, args=(self._stop.is_set,))
        self._loop.start()
        self._thread.start()

    def _hear(self, bus, time_ns, sender, frame):
        self.heard.append((sender, frame))
        self.came.set()

    def tell_node(self, name, message):
        self._order.outside.send(name.encode() + b"\0" + message)
        assert self._order.outside.recv(10) == b"done"

    def close(self):
        self._stop.set()
        self._thread.join()
        self._loop.close()
