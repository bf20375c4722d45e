"""The wall runtime on real SocketCAN: the kernel marks our own frames."""

import socket
import struct

import can
import pytest

from motorhil.motorapi import LinkError, WallRuntime
from motorhil.motorapi.locking.directory import bus_name

LATE_S = 20.0
SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS = 101, 4  # include/uapi/linux/can/raw.h


def frame(can_id, data=b""):
    return struct.pack("<IB3x8s", can_id, len(data), data)


@pytest.fixture
def runtime():
    runtime = WallRuntime()
    yield runtime
    runtime.close()


@pytest.fixture
def bus():
    with can.Bus(interface="socketcan", channel="vcan0") as bus:
        yield bus


def test_own_frames_differ_from_equal_ones_of_others(runtime, bus):
    with can.Bus(interface="socketcan", channel="vcan0") as other:
        heard = []
        runtime.listen(bus, lambda frame, time_ns, own: heard.append((frame, own)))
        equal = can.Message(arbitration_id=0x80, is_extended_id=False)
        expected = []
        for k in range(20):
            other.send(equal)  # the same SYNC, from another sender
            runtime.send(bus, frame(0x80))
            runtime.send(bus, frame(0x201, bytes((k,))))
            expected += [
                (frame(0x80), False),
                (frame(0x80), True),
                (frame(0x201, bytes((k,))), True),
            ]
        assert runtime.wait_until(lambda: len(heard) == len(expected), LATE_S)
        assert heard == expected


def test_all_kinds_of_frames_pass_both_ways(runtime, bus):
    with can.Bus(interface="socketcan", channel="vcan0") as other:
        heard = []
        runtime.listen(bus, lambda frame, time_ns, own: heard.append((frame, own)))
        frames = [
            frame(0x123, b"\x01\x02\x03"),
            frame(0x8000_0000 | 0x1ABCDEF0, b"12345678"),
            struct.pack("<IB3x8s", 0x4000_0000 | 0x701, 4, b""),
        ]
        for one in frames:
            runtime.send(bus, one)
        got = [other.recv(LATE_S) for _ in frames]
        assert [message.arbitration_id for message in got] == [0x123, 0x1ABCDEF0, 0x701]
        assert got[2].is_remote_frame
        for message in got:
            other.send(message)
        assert runtime.wait_until(lambda: len(heard) == 6, LATE_S)
        assert heard == [(one, True) for one in frames] + [(one, False) for one in frames]


def test_times_are_the_kernels_and_never_in_the_future(runtime, bus):
    times_ns = []
    runtime.listen(bus, lambda frame, time_ns, own: times_ns.append((time_ns, runtime.now_ns())))
    sent_ns = runtime.now_ns()
    runtime.send(bus, frame(0x1))
    assert runtime.wait_until(lambda: bool(times_ns), LATE_S)
    time_ns, told_ns = times_ns[0]
    # Two clocks are read one after the other: a millisecond covers that.
    assert sent_ns - 1_000_000 <= time_ns <= told_ns


def test_interface_is_one_bus_for_locks_by_any_name(bus):
    index = socket.if_nametoindex("vcan0")
    with can.Bus(interface="socketcan", channel="vcan0") as other:
        assert bus_name(bus) == bus_name(other)
    assert bus_name(bus).startswith(f"can-if{index}-net")
    with can.Bus(interface="socketcan", channel="vcan1") as second:
        assert bus_name(second) != bus_name(bus)


def test_users_socket_is_left_unchanged(bus):
    runtime = WallRuntime()
    runtime.listen(bus, lambda *_: None)
    assert bus.socket.getsockopt(SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS) == 1
    runtime.close()
    assert bus.socket.getsockopt(SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS) == 0


def test_sending_on_a_closed_bus_raises(runtime):
    bus = can.Bus(interface="socketcan", channel="vcan0")
    bus.shutdown()
    with pytest.raises(LinkError, match="cannot send"):
        runtime.send(bus, frame(0x1))
    with pytest.raises(LinkError):
        runtime.listen(bus, lambda *_: None)
