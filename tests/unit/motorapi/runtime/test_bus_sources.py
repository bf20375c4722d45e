"""Frame sources: the age of a frame on a bus with its own time."""

import socket
import struct
from types import SimpleNamespace

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.motorapi.runtime import can_sources as bus_sources
from tests.support.can.fd_frames import FdListeners

FRAME = struct.pack("<IB3x8s", 0x181, 1, b"\x07")
CLOCK_NS = 7_000_000_000  # offset of this process's clock to the bus clock

delays = st.lists(
    st.tuples(st.integers(0, 50_000_000), st.integers(0, 50_000_000)), min_size=1, max_size=20
)


class TimedBus:
    """A bus whose frames have their own times, and are read later."""

    channel_info = "timed"

    def __init__(self, rows):
        self.rows = rows

    def receive_frame(self, timeout_s):
        return (FRAME, self.rows.pop(0), False) if self.rows else None

    def transmit(self, frame):
        raise NotImplementedError


@given(delays)
def test_frame_age_is_by_the_bus_clock_however_late_it_is_read(gaps_and_delays):
    bus_ns, now_ns, rows, arrivals = 0, 0, [], []
    for gap_ns, delay_ns in gaps_and_delays:
        bus_ns += gap_ns
        now_ns = max(now_ns, CLOCK_NS + bus_ns + delay_ns)  # in order, whatever the delay
        rows.append(bus_ns)
        arrivals.append(now_ns)
    clock = iter(arrivals)
    source = bus_sources.source_of(TimedBus(list(rows)))
    told = []
    real, bus_sources.time = bus_sources.time, SimpleNamespace(monotonic_ns=lambda: next(clock))
    try:
        for arrival_ns in arrivals:
            _, age_ns, _ = source.receive(0.0)
            assert age_ns >= 0
            told.append(arrival_ns - age_ns)
    finally:
        bus_sources.time = real
    assert told == sorted(told)
    least_ns = [
        min(a - b for a, b in zip(arrivals[: k + 1], rows, strict=False)) for k in range(len(rows))
    ]
    place = least_ns.index(least_ns[-1])  # no smaller delay from here on
    settled = next(
        (k for k in range(place, len(rows)) if rows[k] + least_ns[-1] >= max(told[: k + 1])), None
    )
    if settled is not None:
        assert told[settled:] == [row + least_ns[-1] for row in rows[settled:]]


def test_error_messages_of_a_socket_are_passed_unchanged():
    """Read an error message (linux/can/error.h: CAN_ERR_DLC is 8 bytes), here error passive."""
    message = struct.pack("<IB3x8s", 0x2000_0204, 8, bytes.fromhex("0020000000008000"))
    ours, kernels = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, kernels:
        source = bus_sources._SocketCanSource(SimpleNamespace(channel_info="pair"), ours)
        kernels.send(message)
        assert source.receive(0.0) == (message, 0, False)


class VirtualBench:
    """The bus of python-can's own interface `virtual`, which is read message by message."""

    def open(self, fd=False):
        protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        return can.Bus(interface="virtual", channel="fd sources", protocol=protocol)


@pytest.mark.wall
class TestFdFramesAsMessages(FdListeners):
    @pytest.fixture
    def bench(self):
        return VirtualBench()
