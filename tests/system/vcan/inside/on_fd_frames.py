"""CAN FD on real vcan: the kernel between a rig and python-can."""

import fcntl
import socket
import struct

import can
import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.gateways.hub import HubServer
from motorhil.emulators.gateways.socketcan import SocketCanError, SocketCanGateway, link_mtu
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from tests.support.can.error_bus import ErrorBench
from tests.support.can.fd_frames import FdFrames, fd_message

CAN_MTU = 16
SIOCSIFFLAGS = 0x8914
SIOCSIFMTU = 0x8922
UP = 1


def change_mtu(interface, size):
    """Run `ip link set down ...; ip link set ... mtu SIZE up`."""
    name = interface.encode()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as kernel:
        fcntl.ioctl(kernel, SIOCSIFFLAGS, struct.pack("16sh14x", name, 0))
        fcntl.ioctl(kernel, SIOCSIFMTU, struct.pack("16si12x", name, size))
        fcntl.ioctl(kernel, SIOCSIFFLAGS, struct.pack("16sh14x", name, UP))


class Bench(ErrorBench):
    """A rig's bus that is on vcan0, and on a hub."""

    def __init__(self, path):
        super().__init__(
            lambda world: [SocketCanGateway("vcan0", world, "can0"), HubServer(path, world)],
            5_000_000,
        )
        self.path = path

    def open(self, **options):
        return can.Bus(interface="socketcan", channel="vcan0", **options)

    def open_emulated(self, **options):
        return can.Bus(interface="emulated", channel=self.path, **options)


class Across:
    """A pair of buses on vcan0 and on the rig in turns: each frame passes the gateway."""

    def __init__(self, bench):
        self._bench = bench
        self._opened = 0

    def open(self, **options):
        self._opened += 1
        return (self._bench.open if self._opened % 2 else self._bench.open_emulated)(**options)


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    bench = Bench(str(tmp_path_factory.mktemp("fd") / "hub"))
    yield bench
    bench.close()


class TestOnVcan(FdFrames):
    @pytest.fixture
    def bench(self, served):
        return served


class TestFromVcanToTheRig(FdFrames):
    @pytest.fixture
    def bench(self, served):
        return Across(served)


class TestFromTheRigToVcan(FdFrames):
    @pytest.fixture
    def bench(self, served):
        across = Across(served)
        across._opened = 1
        return across


def test_frames_unfit_for_a_classical_bus_stay_outside():
    bench = ErrorBench(lambda world: [SocketCanGateway("vcan0", world, "can0")])
    try:
        with can.Bus(interface="socketcan", channel="vcan0", fd=True) as bus:
            bus.send(fd_message(0x123, bytes(64)))
            bus.send(can.Message(arbitration_id=0x124, is_extended_id=False))
        with can.Bus(interface="socketcan", channel="vcan0") as bus:
            bus.send(can.Message(arbitration_id=0x125, is_extended_id=False))
    finally:
        bench.close()  # once all received frames are processed
    assert all(len(frame) == 16 for _, frame in bench.heard)


def test_interface_without_fd_is_reported():
    world = World(EventQueue())
    world.add_bus(CanBus("can0", data_bitrate_bit_s=2_000_000))
    world.add_bus(CanBus("can1"))
    before = link_mtu("vcan1")
    change_mtu("vcan1", CAN_MTU)
    try:
        assert link_mtu("vcan1") == CAN_MTU
        with pytest.raises(SocketCanError, match=r"vcan1: does not support CAN FD \(MTU 16\)"):
            SocketCanGateway("vcan1", world, "can0")
        SocketCanGateway("vcan1", world, "can1").close()
    finally:
        change_mtu("vcan1", before)
