"""Batch reader on local datagram sockets, which have time stamps like CAN sockets."""

import errno
import socket
import struct

import pytest

from motorhil.harness.recording import socketcan as datagrams
from motorhil.harness.recording.socketcan import BATCH, DatagramReader

NOW = 7


def classic(number):
    return struct.pack("<IB3x8s", number, 8, struct.pack("<Q", number))


def flexible(number):
    return struct.pack("<IBB2x64s", number, 64, 5, bytes(range(64)))


@pytest.fixture
def pair():
    first, second = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with first, second:
        yield first, second


def test_read_frames_keep_order_and_kernel_stamps(pair):
    sender, receiver = pair
    reader = DatagramReader(receiver)
    for number in range(5):
        sender.send(classic(number))
    _, ancillary, _, _ = receiver.recvmsg(72, 128)  # frame 0, read with Python's own call
    seconds, nanoseconds = struct.unpack("@ll", ancillary[0][2])
    first_ns = seconds * 1_000_000_000 + nanoseconds
    entries = reader.read(4, 5, NOW)
    assert [frame for _, _, frame in entries] == [classic(number) for number in range(1, 5)]
    assert {source for source, _, _ in entries} == {4}
    times = [time_ns for _, time_ns, _ in entries]
    assert times == sorted(times)
    assert 0 <= times[0] - first_ns < 1_000_000_000
    assert reader.read(4, 5, NOW) == []


def test_read_mixed_lengths_keeps_sizes_and_counts_invalid(pair):
    sender, receiver = pair
    reader = DatagramReader(receiver)
    told = [classic(1), flexible(2), b"rubbish", classic(3), b"", flexible(4)]
    for data in told:
        sender.send(data)
    entries = reader.read(0, 1, NOW)
    assert [frame for _, _, frame in entries] == [classic(1), flexible(2), classic(3), flexible(4)]
    assert all(time_ns > NOW for _, time_ns, _ in entries)
    assert reader.ignored == 2


def test_read_short_frame_after_long_one_has_no_old_bytes(pair):
    sender, receiver = pair
    reader = DatagramReader(receiver)
    sender.send(flexible(2))
    reader.read(0, 1, NOW)
    sender.send(classic(1))
    sender.send(flexible(3))
    assert [frame for _, _, frame in reader.read(0, 1, NOW)] == [classic(1), flexible(3)]
    sender.send(flexible(4))
    sender.send(classic(5))
    assert [frame for _, _, frame in reader.read(0, 1, NOW)] == [flexible(4), classic(5)]


def test_read_after_full_batch_returns_the_rest(pair):
    sender, receiver = pair
    sender.setblocking(False)
    reader = DatagramReader(receiver)
    sent, heard, largest = 0, [], 0
    while sent < BATCH + 10:
        try:
            sender.send(classic(sent))
            sent += 1
        except BlockingIOError:  # the kernel's queue is full
            part = reader.read(0, 1, NOW)
            largest = max(largest, len(part))
            heard += part
    while part := reader.read(0, 1, NOW):
        largest = max(largest, len(part))
        heard += part
    assert [frame for _, _, frame in heard] == [classic(number) for number in range(sent)]
    assert largest <= BATCH


def test_read_without_stamps_uses_given_time(pair, monkeypatch):
    sender, receiver = pair
    monkeypatch.setattr(datagrams, "_SO_TIMESTAMPNS", 9999)  # no kernel supports it
    reader = DatagramReader(receiver)
    assert not reader.stamped
    sender.send(classic(1))
    assert reader.read(0, 1, NOW) == [(0, NOW, classic(1))]


def test_read_on_closed_socket_raises_os_error(pair):
    _, receiver = pair
    reader = DatagramReader(receiver)
    receiver.close()
    with pytest.raises(OSError, match="descriptor") as caught:
        reader.read(0, 1, NOW)
    assert caught.value.errno == errno.EBADF


def test_dropped_counts_kernel_losses():
    """UDP drops frames when its queue is full, and counts them like a CAN socket."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)  # the minimum size
        reader = DatagramReader(receiver)
        sent, heard = 500, 0
        for number in range(sent):
            sender.sendto(classic(number), receiver.getsockname())
        while part := reader.read(0, 1, NOW):
            heard += len(part)
        assert reader.dropped == 0  # the kernel reports it with the next frame
        for _ in range(2):
            sender.sendto(classic(0), receiver.getsockname())
            assert len(reader.read(0, 1, NOW)) == 1
            assert 0 < heard < sent
            assert reader.dropped == sent - heard
