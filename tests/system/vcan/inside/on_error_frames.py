"""Error frames on real vcan: the kernel between a rig and python-can."""

import contextlib
import shutil
import subprocess
import time

import can
import pytest

from motorhil.emulators.gateways.socketcan import SocketCanGateway, link_kind
from tests.support.can.error_bus import ErrorBench
from tests.support.can.error_frames import NO_ACK, PASSIVE, ErrorFrames, message


class VcanBench(ErrorBench):
    channel = "vcan0"

    def __init__(self):
        super().__init__(lambda world: [SocketCanGateway("vcan0", world, "can0")])

    def open(self, **options):
        return can.Bus(interface="socketcan", channel="vcan0", **options)

    def tell(self, bus, message):
        self.tell_node("vcan0", message)

    def now_s(self):
        return time.time()


@pytest.fixture
def bench():
    bench = VcanBench()
    yield bench
    bench.close()


class TestOnVcan(ErrorFrames):
    is_rx = False  # of all frames of this host
    keeps_state = False

    def test_error_of_a_drive_stays_its_own(self, bench):
        """As on a real bus, whose interface knows only its own CAN controller."""
        bench.world.add_host("can0", "drive", lambda *_: None)
        with bench.open() as bus:
            bench.tell_node("drive", PASSIVE)
            bench.tell(bus, NO_ACK)
            assert bus.recv(5.0).arbitration_id == 0xA8

    def test_error_frame_of_a_program_is_not_put_on_the_rigs_bus(self, bench):
        """The kernel passes it to other programs, and has no further effect."""
        with bench.open() as bus, bench.open() as other:
            sent = can.Message(
                arbitration_id=0x204, data=PASSIVE[8:], is_error_frame=True, is_extended_id=False
            )
            bus.send(sent)
            assert other.recv(5.0).is_error_frame
            bus.send(message(0x123))
            assert other.recv(5.0).arbitration_id == 0x123
            assert bench.came.wait(30.0)
        assert [frame[:4] for _, frame in bench.heard] == [b"\x23\x01\0\0"]

    @pytest.mark.skipif(shutil.which("candump") is None, reason="no can-utils here")
    def test_candump_prints_error_frames(self, bench):
        command = ["candump", "-e", "-n", "1", "vcan0,0:0,#FFFFFFFF"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as candump:
            for _ in range(100):  # there is no sign when it begins to listen
                bench.tell(None, NO_ACK)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    candump.wait(0.1)
                    break
            told = candump.communicate(timeout=10)[0]
        assert "200000A8   [8]  00 00 80 19 00 00 00 00   ERRORFRAME" in told
        for word in ("error-on-tx", "acknowledge-slot", "no-acknowledgement-on-tx", "bus-error"):
            assert word in told


def test_hardware_interface_gets_no_error_message(monkeypatch):
    """Its driver would put a frame on the bus, with the class for its identifier."""
    monkeypatch.setattr("motorhil.emulators.gateways.socketcan.link_kind", lambda _: "can")
    with contextlib.closing(VcanBench()) as bench, bench.open() as bus, bench.open() as other:
        bench.tell(bus, PASSIVE)
        other.send(message(0x123))
        assert bus.recv(5.0).arbitration_id == 0x123


def test_kernel_reports_the_kind_of_interface():
    assert link_kind("vcan0") == "vcan"
    assert link_kind("lo") == ""
    with pytest.raises(OSError, match="no interface"):
        link_kind("vcan7")
