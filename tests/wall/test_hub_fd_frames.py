"""CAN FD of the `emulated` interface over a hub's socket; clients that do not know it."""

import can
import pytest

from emulators.hub import HubServer
from emulators.hub_protocol import GREETING
from harness.hub_client import HubLink
from tests.harness.fd_frames import FdFrames, classical, fd_message
from tests.wall.error_bench import ErrorBench

pytestmark = pytest.mark.wall


class HubBench(ErrorBench):
    def __init__(self, path, data_bitrate_bit_s=5_000_000):
        super().__init__(lambda world: [HubServer(path, world)], data_bitrate_bit_s)
        self.channel = path

    def open(self, **options):
        return can.Bus(interface="emulated", channel=self.channel, **options)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    bench = HubBench(str(tmp_path_factory.mktemp("fd") / "hub"))
    yield bench
    bench.close()


class TestOverAHub(FdFrames):
    def test_an_older_client_hears_no_frame_that_it_could_not_take(self, bench):
        older = HubLink(bench.channel)  # its greeting is protocol 1's, as ever
        with bench.open(fd=True) as bus:
            bus.send(fd_message(0x123, bytes(64)))
            bus.send(classical(0x124))
            frame, _, _ = older.receive(5.0)
        older.close()
        assert (len(frame), frame[:2]) == (16, b"\x24\x01")
        assert GREETING == b"motorhil-hub 1 "


def test_a_classical_bus_is_told_so_before_anything_is_sent(tmp_path):
    bench = HubBench(str(tmp_path / "hub"), None)
    try:
        with pytest.raises(can.CanInitializationError, match="bus can0 is classical CAN"):
            bench.open(fd=True)
        with bench.open() as bus, bench.open() as other:
            bus.send(classical(0x123))
            assert other.recv(5.0).arbitration_id == 0x123
    finally:
        bench.close()
