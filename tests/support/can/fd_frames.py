"""CAN FD as python-can's users see it, over every connection.

Expectations follow python-can's SocketCAN interface (4.6.1) and the kernel: FD frames need sockets
opened with `fd=True`; BRS and ESI arrive as sent.
"""

import can
import pytest

LENGTHS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64]  # ISO 11898-1:2015, DLC


def fd_message(can_id, data=b"", extended=False, **flags):
    return can.Message(
        arbitration_id=can_id, data=data, is_extended_id=extended, is_fd=True, **flags
    )


def classical(can_id, data=b""):
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


class FdFrames:
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
