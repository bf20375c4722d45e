"""Error frames of the `emulated` interface over a hub, and older clients."""

import os
import sys
import time
from pathlib import Path

import can
import pytest

from motorhil.emulators.gateways.hub import HubServer
from tests.support.can.error_bus import ErrorBench
from tests.support.can.error_frames import PASSIVE, ErrorFrames

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
        return time.time()


@pytest.fixture
def bench(tmp_path):
    bench = HubBench(str(tmp_path / "hub"))
    yield bench
    bench.close()


class TestOverAHub(ErrorFrames):
    def test_error_is_a_separate_record_ignored_by_old_clients(self, bench, monkeypatch):
        """An error message must not reach a client that would take it for a data frame."""
        with bench.open() as bus, bench.open() as other:
            monkeypatch.setattr(
                "motorhil.harness.python_can.hub_client.TOLD", 255
            )  # as before the error
            bench.tell(bus, PASSIVE)
            other.send(can.Message(arbitration_id=0x123, is_extended_id=False))
            assert bus.recv(30.0).arbitration_id == 0x123
