"""CAN FD of the `emulated` interface in a rig of this process."""

import can
import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.frame import pack_fd
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from motorhil.harness.python_can.bus import close_rig, open_rig
from motorhil.harness.python_can.receive_queue import ReceiveQueue
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from tests.support.can.fd_frames import FdFrames, classical, fd_message

RIG = """
[rig]
name = "fd"
[bus.can0]
bitrate_bit_s = 500_000
{data}
"""

MIXED = (
    RIG.format(data="data_bitrate_bit_s = 2_000_000")
    + """
[bus.can0.node.ear]
silent = true
{frames}
"""
)


class Bench:
    def __init__(self):
        queue = EventQueue()
        self.world = World(queue)
        self.world.add_bus(CanBus("can0", 500_000, data_bitrate_bit_s=2_000_000))
        self.runtime = VirtualRuntime(queue)
        open_rig(self.world, self.runtime)

    def open(self, **options):
        return can.Bus(interface="emulated", channel="can0", **options)

    def close(self):
        close_rig(self.world)
        self.runtime.close()


@pytest.fixture
def bench():
    bench = Bench()
    yield bench
    bench.close()


class TestInARig(FdFrames):
    def test_fd_frame_arrives_after_its_bits_at_both_rates(self, bench):
        # 17 nominal bits to BRS, 9 after the CRC delimiter, 99 at the data rate (test_can_bus_fd)
        data = bytes.fromhex("0011223344556677")
        with bench.open(fd=True) as bus, bench.open(fd=True) as other:
            bus.send(fd_message(0x123, data, bitrate_switch=True))
            assert other.recv(1.0).timestamp == 26 * 2e-6 + 99 * 0.5e-6

    def test_invalid_fd_message_is_refused_with_reason(self, bench):
        with bench.open(fd=True) as bus:
            remote = fd_message(0x123)
            remote.is_remote_frame = True
            too_long = fd_message(0x123)
            too_long.data = bytearray(65)
            for message, told in ((remote, "no remote frames"), (too_long, "65 data bytes")):
                with pytest.raises(can.CanOperationError, match=told):
                    bus.send(message)
        with bench.open() as bus, pytest.raises(can.CanOperationError, match="with fd=True"):
            bus.send(fd_message(0x123))

    def test_listener_without_fd_gets_classical_frames_only(self):
        heard = []
        ears = ReceiveQueue(False, 10, True)
        ears.listeners.append(lambda *told: heard.append(told))
        ears.receive(pack_fd(0x123), 0, False)
        assert not heard
        assert len(ears.backlog) == 1


def test_rig_with_fd_bus_counts_fd_frames(tmp_path):
    path = tmp_path / "fd.toml"
    path.write_text(MIXED.format(frames='frames = "fd"'))
    with Rig.open(path) as rig:
        with can.Bus(interface="emulated", channel="can0", fd=True) as bus:
            bus.send(fd_message(0x123, bytes(64), bitrate_switch=True))
            rig.runtime.run_for(0.01)
        assert rig.world.bus("can0").statistics.counts() == {0x123: 1}


def test_fd_option_on_a_classical_bus_is_refused(tmp_path):
    path = tmp_path / "fd.toml"
    path.write_text(RIG.format(data=""))
    with Rig.open(path):
        told = r"bus can0 is classical CAN; give \[bus.can0\] of the rig a data_bitrate_bit_s"
        with pytest.raises(can.CanInitializationError, match=told):
            can.Bus(interface="emulated", channel="can0", fd=True)
        with can.Bus(interface="emulated", channel="can0") as bus:
            bus.send(classical(0x123))


@pytest.mark.parametrize(
    ("frames", "told", "heard"),
    [
        ("", ["ear: destroys CAN FD frames: its CAN controller is classical"], 0),
        ('frames = "fd_tolerant"', [], 0),
        ('frames = "fd"', [], 1),
    ],
)
def test_node_reacts_to_fd_frame_by_its_controller_type(tmp_path, frames, told, heard):
    path = tmp_path / "fd.toml"
    path.write_text(MIXED.format(frames=frames))
    events = []
    with Rig.open(path) as rig:
        rig.world.tap_events(lambda *event: events.append(event[3]))
        with can.Bus(interface="emulated", channel="can0", fd=True) as bus:
            bus.send(fd_message(0x123))
            rig.runtime.run_for(0.0005)
        assert [event for event in events if "destroys" in event] == told
        assert rig.world.bus("can0").statistics.frames == heard


def test_unknown_can_controller_type_is_refused(tmp_path):
    path = tmp_path / "fd.toml"
    path.write_text(MIXED.format(frames='frames = "xl"'))
    with pytest.raises(RigError, match=r'fd.toml:10: .*"xl".*classical, fd_tolerant, fd'):
        Rig.open(path)
