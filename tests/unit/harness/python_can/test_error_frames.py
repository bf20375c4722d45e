"""Error frames of the `emulated` interface in a rig of this process."""

from types import SimpleNamespace

import can
import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from motorhil.harness.python_can.bus import close_rig, open_rig
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.harness.virtual_time.stdlib.install import in_virtual_time
from tests.support.can.error_frames import PASSIVE, ErrorFrames
from tests.support.can.error_messages import tell


class Bench:
    channel = "can0"

    def __init__(self):
        queue = EventQueue()
        self.world = World(queue)
        self.world.add_bus(CanBus("can0"))
        self.runtime = VirtualRuntime(queue)
        open_rig(self.world, self.runtime)
        self._names = {}

    def open(self, **options):
        bus = can.Bus(interface="emulated", channel="can0", **options)
        self._names[bus] = f"host-{len(self._names) + 1}" if self._names else "host"
        return bus

    def tell(self, bus, message):
        tell(self.world, "can0", self._names[bus], message)

    def now_s(self):
        return self.runtime.now_ns() / 1e9

    def close(self):
        close_rig(self.world)
        self.runtime.close()


@pytest.fixture
def bench():
    bench = Bench()
    yield bench
    bench.close()


class TestInARig(ErrorFrames):
    def hand_out(self, bus, listeners, count):  # a Notifier is a thread of a program, see below
        for _ in range(count):
            heard = bus.recv(0.0)
            for listener in listeners:
                listener(heard)
        for listener in listeners:
            listener.stop()

    def test_error_is_reported_to_one_program_at_its_time(self, bench):
        with bench.open() as bus, bench.open() as other:
            bench.runtime.run_for(0.25)
            bench.tell(bus, PASSIVE)
            assert bus.recv(0.0).timestamp == 0.25
            assert other.recv(0.1) is None

    def test_bus_state_is_known_without_reading(self, bench):
        with bench.open() as bus:
            bench.tell(bus, PASSIVE)
            assert bus.state is can.BusState.PASSIVE


def test_notifier_thread_of_a_plain_program_hears_errors(bench):
    with in_virtual_time(SimpleNamespace(runtime=bench.runtime, seed=1)), bench.open() as bus:
        bench.world.queue.alarm(lambda _: bench.tell(bus, PASSIVE)).set(100_000_000)
        mails = can.BufferedReader()
        notifier = can.Notifier(bus, [mails])
        heard = mails.get_message(timeout=1.0)
        notifier.stop()
        assert bus.state is can.BusState.PASSIVE
    assert (heard.is_error_frame, heard.arbitration_id, heard.timestamp) == (True, 0x204, 0.1)
