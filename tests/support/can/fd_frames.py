"""CAN FD as python-can's users see it, over every connection.

Expectations follow python-can's SocketCAN interface (4.6.1) and the kernel: FD frames need sockets
opened with `fd=True`; BRS and ESI arrive as sent.
"""

from contextlib import contextmanager

import can
import pytest
from can.interfaces.socketcan.socketcan import build_can_frame

from motorhil.motorapi import UsageError
from motorhil.motorapi.runtime.wall import WallRuntime

LENGTHS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64]  # ISO 11898-1:2015, DLC


def fd_message(can_id, data=b"", extended=False, **flags):
    return can.Message(
        arbitration_id=can_id, data=data, is_extended_id=extended, is_fd=True, **flags
    )


def classical(can_id, data=b""):
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def linux_frame(message):
    """Return the frame as python-can packs it, without its copy of the DLC in a reserved byte."""
    frame = bytearray(build_can_frame(message))
    frame[7] = 0
    return bytes(frame)


@contextmanager
def runtime_for(bus):
    """Yield the runtime of a bus: the rig's own, or one on the wall clock."""
    if (own := getattr(bus, "runtime", None)) is not None:
        yield own
        return
    runtime = WallRuntime()
    try:
        yield runtime
    finally:
        runtime.close()


class FdListeners:
    """Tests of the motor interface's runtime for a fixture `bench`, as for `FdFrames`."""

    def test_fd_listener_receives_every_frame_as_linux_packs_it(self, bench):
        sent = [
            classical(0x124, b"12"),
            fd_message(0x123, bytes(range(64)), bitrate_switch=True),
            fd_message(0x1ABCDE00, b"", True, error_state_indicator=True),
            classical(0x125),
        ]
        with bench.open(fd=True) as bus, bench.open(fd=True) as other, runtime_for(bus) as runtime:
            classical_only, every = [], []
            runtime.listen(bus, lambda frame, *_: classical_only.append(frame))
            runtime.listen(bus, lambda *heard: every.append(heard), fd=True)
            for count, message in enumerate(sent, 1):
                other.send(message)  # alone, since pending frames go by priority
                assert runtime.wait_until(lambda count=count: len(every) == count, 30.0)
        frames = [linux_frame(message) for message in sent]
        assert [(frame, own) for frame, _, own in every] == [(one, False) for one in frames]
        assert classical_only == [frames[0], frames[3]]

    def test_fd_frame_of_runtime_is_sent_and_reported(self, bench):
        message = fd_message(0x123, bytes(range(48)), bitrate_switch=True)
        with bench.open(fd=True) as bus, bench.open(fd=True) as other, runtime_for(bus) as runtime:
            told = []
            runtime.listen(bus, lambda frame, _, own: told.append((frame, own)), fd=True)
            runtime.send(bus, linux_frame(message))
            heard = other.recv(30.0)
            assert runtime.wait_until(lambda: bool(told), 30.0)
        assert told == [(linux_frame(message), True)]
        assert (heard.arbitration_id, heard.is_fd, heard.bitrate_switch) == (0x123, True, True)
        assert bytes(heard.data) == bytes(message.data)

    def test_runtime_refuses_fd_on_a_classical_bus_object(self, bench):
        with bench.open() as bus, runtime_for(bus) as runtime:
            with pytest.raises(UsageError, match="opened for classical CAN; open it with fd=True"):
                runtime.listen(bus, lambda *_: None, fd=True)
            with pytest.raises(UsageError, match="opened for classical CAN"):
                runtime.send(bus, linux_frame(fd_message(0x123)))


class FdFrames(FdListeners):
    """Tests for a fixture `bench`: `open(**options)` joins an FD bus."""

    @pytest.mark.parametrize("extended", [False, True])
    def test_fd_frame_of_every_length_arrives_unchanged(self, bench, extended):
        with bench.open(fd=True) as bus, bench.open(fd=True) as other:
            for length in LENGTHS:
                can_id = 0x1ABCDE00 + length if extended else 0x100 + length
                data = bytes(range(length))
                bus.send(fd_message(can_id, data, extended))
                heard = other.recv(30.0)
                assert (heard.arbitration_id, heard.is_extended_id) == (can_id, extended)
                assert (heard.is_fd, heard.dlc, bytes(heard.data)) == (True, length, data)
                others = (heard.is_error_frame, heard.is_remote_frame, heard.bitrate_switch)
                assert others == (False, False, False)

    @pytest.mark.parametrize("switch", [False, True])
    @pytest.mark.parametrize("passive", [False, True])
    def test_fd_frame_keeps_brs_and_esi(self, bench, switch, passive):
        with bench.open(fd=True) as bus, bench.open(fd=True) as other:
            flags = {"bitrate_switch": switch, "error_state_indicator": passive}
            bus.send(fd_message(0x123, bytes(12), **flags))
            heard = other.recv(30.0)
            assert (heard.bitrate_switch, heard.error_state_indicator) == (switch, passive)

    def test_classical_and_fd_frames_of_one_identifier_keep_format(self, bench):
        with bench.open(fd=True) as bus, bench.open(fd=True) as other:
            for sent in (classical(0x123, b"12345678"), fd_message(0x123, b"12345678")):
                bus.send(sent)
                heard = other.recv(30.0)
                assert (heard.is_fd, bytes(heard.data)) == (sent.is_fd, b"12345678")
            bus.send(can.Message(arbitration_id=0x124, is_remote_frame=True, is_extended_id=False))
            assert other.recv(30.0).is_remote_frame

    def test_fd_frame_of_invalid_length_is_padded(self, bench):
        with bench.open(fd=True) as bus, bench.open(fd=True) as other:
            bus.send(fd_message(0x123, b"123456789"))
            heard = other.recv(30.0)
            assert bytes(heard.data) == b"123456789\0\0\0"

    def test_classical_bus_object_ignores_fd_frames(self, bench):
        with bench.open(fd=True) as bus, bench.open() as other:
            bus.send(fd_message(0x123, bytes(64)))
            bus.send(classical(0x124))
            assert other.recv(30.0).arbitration_id == 0x124
            assert other.protocol is can.CanProtocol.CAN_20
            assert bus.protocol is can.CanProtocol.CAN_FD

    def test_classical_bus_object_refuses_to_send_fd_frames(self, bench):
        with bench.open() as bus, bench.open(fd=True) as other:
            with pytest.raises(can.CanOperationError):
                bus.send(fd_message(0x123, bytes(64)))
            bus.send(classical(0x124))
            assert other.recv(30.0).arbitration_id == 0x124

    @pytest.mark.parametrize("own", [True, False])
    def test_own_fd_frames_follow_receive_option(self, bench, own):
        with bench.open(fd=True, receive_own_messages=own) as bus, bench.open(fd=True) as other:
            bus.send(fd_message(0x123, bytes(20), bitrate_switch=True))
            assert other.recv(30.0).arbitration_id == 0x123  # proves that it was on the bus
            other.send(fd_message(0x321, bytes(24)))
            heard = [bus.recv(30.0) for _ in range(1 + own)]
            assert [len(one.data) for one in heard] == [20, 24][-1 - own :]

    def test_filters_apply_to_fd_frames(self, bench):
        filters = [{"can_id": 0x321, "can_mask": 0x7FF, "extended": False}]
        with bench.open(fd=True, can_filters=filters) as bus, bench.open(fd=True) as other:
            for can_id in (0x123, 0x321):
                other.send(fd_message(can_id, bytes(64)))
            assert bus.recv(30.0).arbitration_id == 0x321
