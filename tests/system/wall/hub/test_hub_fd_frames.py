"""CAN FD over a hub, with clients that lack it."""

import contextlib
import select
import struct

import can
import pytest

from motorhil.emulators.can.frame import pack_fd
from motorhil.emulators.gateways.hub import HubServer
from motorhil.emulators.simulation.ownership_notice import GREETING
from motorhil.harness.python_can.hub_client import HubLink
from motorhil.harness.recording.sources import HubClocks, HubTap, parse_place
from motorhil.harness.replay.real_bus import HubSink
from tests.support.can.error_bus import ErrorBench
from tests.support.can.fd_frames import FdFrames, classical, fd_message

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
    def test_older_client_receives_no_fd_frame(self, bench):
        older = HubLink(bench.channel)  # its greeting is protocol 1's
        with bench.open(fd=True) as bus:
            bus.send(fd_message(0x123, bytes(64)))
            bus.send(classical(0x124))
            frame, _, _ = older.receive(30.0)
        older.close()
        assert (len(frame), frame[:2]) == (16, b"\x24\x01")
        assert GREETING == b"motorhil-hub 1 "

    def test_incomplete_frame_is_completed_as_a_driver_would(self, bench):
        """Otherwise a recorder of the bus receives an invalid canfd_frame (seen in `serve`)."""
        raw = HubLink(bench.channel, True)
        with bench.open(fd=True) as bus:
            flags_unknown, length = 0xF8, 9  # no FDF, and not a CAN FD length
            raw.send(struct.pack("<IBB2x64s", 0x123, length, flags_unknown, b"123456789"))
            raw.send(struct.pack("<IBB2x64s", 0x124, 65, 0x04, b""))
            heard = bus.recv(30.0)
            assert (heard.is_fd, bytes(heard.data)) == (True, b"123456789\0\0\0")
            # Its own client gets the error, and is disconnected; its first frame may come before.
            with pytest.raises(can.CanOperationError, match="65 bytes of data"):
                list(iter(lambda: raw.receive(30.0), None))
        raw.close()

    def test_recording_and_replaying_a_hub_keeps_all_fd_frames(self, bench):
        place = parse_place(bench.channel)
        tap, sink = HubTap(place, HubClocks([place])), HubSink(place, print)
        sent = pack_fd(0x123, bytes(64))
        with contextlib.closing(tap), contextlib.closing(sink):
            assert sink.carries_fd
            sink.send(sent)
            assert select.select([tap], [], [], 30.0)[0]
            assert [frame for _, _, frame in tap.read(0)] == [sent]


def test_fd_recording_for_a_classical_bus_is_refused(tmp_path):
    bench = HubBench(str(tmp_path / "hub"), None)
    try:
        with pytest.raises(can.CanInitializationError, match="bus can0 is classical CAN"):
            bench.open(fd=True)
        with bench.open() as bus, bench.open() as other:
            bus.send(classical(0x123))
            assert other.recv(30.0).arbitration_id == 0x123
        with contextlib.closing(HubSink(parse_place(bench.channel), print)) as sink:
            assert not sink.carries_fd
    finally:
        bench.close()
