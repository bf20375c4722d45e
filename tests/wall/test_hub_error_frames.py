"""Error frames of the `emulated` interface over a hub's socket; who does not know them."""

import os
import sys
from pathlib import Path

import can
import pytest

from emulators.hub import HubServer
from tests.harness.error_frames import PASSIVE, ErrorFrames
from tests.wall.error_bench import ErrorBench

pytestmark = pytest.mark.wall


class HubBench(ErrorBench):
    def __init__(self, path):
        super().__init__(lambda world: [HubServer(path, world)])
        self.channel = path
        program = Path(sys.argv[0]).name.replace(" ", "_")
        self._name = f"{program}[{os.getpid()}]"
        self._names = {}

    def open(self, **options):
        bus = can.Bus(interface="emulated", channel=self.channel, **options)
        count = len(self._names)
        self._names[bus] = self._name if not count else f"{self._name}-{count + 1}"
        return bus

    def tell(self, bus, message):
        self.tell_node(self._names[bus], message)

    def now_s(self):
        return self.world.queue.now_ns / 1e9


@pytest.fixture
def bench(tmp_path):
    bench = HubBench(str(tmp_path / "hub"))
    yield bench
    bench.close()


class TestOverAHub(ErrorFrames):
    def test_an_error_is_a_record_of_its_own_that_older_clients_ignore(self, bench, monkeypatch):
        """What is no traffic may not reach who would take it for some."""
        with bench.open() as bus, bench.open() as other:
            monkeypatch.setattr("harness.hub_client.TOLD", 255)  # as before there was one
            bench.tell(bus, PASSIVE)
            other.send(can.Message(arbitration_id=0x123, is_extended_id=False))
            assert bus.recv(30.0).arbitration_id == 0x123
