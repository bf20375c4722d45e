"""CAN errors as python-can's users see them, over every connection.

Expected bytes follow linux/can/error.h, by hand, and python-can's SocketCAN interface (4.6.1,
`capture_message`). Filters work as in the kernel (net/can/raw.c): only CAN_RAW_ERR_FILTER applies
to error messages.
"""

import can
import pytest
from can import BusState

# can_frame: can_id little-endian, length, padding, data; data[1] state, [2] type, [3] location, [6]
# TEC, [7] REC
PASSIVE = bytes.fromhex("04020020 08 000000 0020000000008000")  # CRTL, CNT: TX passive, TEC 128
WARNING = bytes.fromhex("04020020 08 000000 0008000000006000")  # CRTL, CNT: TX warning, TEC 96
ACTIVE = bytes.fromhex("04020020 08 000000 0040000000005f00")  # CRTL, CNT: error active again
BUS_OFF = bytes.fromhex("40000020 08 000000 0000000000000000")
RESTARTED = bytes.fromhex("00010020 08 000000 0000000000000000")
NO_ACK = bytes.fromhex("a8000020 08 000000 0000801900000000")  # PROT, ACK, BUSERROR: TX, ACK slot
DATA = bytes.fromhex("04020000 08 000000 0020000000008000")  # an ordinary frame: identifier 204h


def message(can_id, data=b""):
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


class ErrorFrames:
    """Tests for a fixture `bench`: `open(**options)` joins, `tell(bus, message)` reports an error.

    Attributes:
        is_rx: value of is_rx for messages from the own host.
        keeps_state: True if `bus.state` follows the errors.
    """

    is_rx = True
    keeps_state = True

    def test_error_arrives_as_complete_error_frame(self, bench):
        with bench.open() as bus:
            bench.tell(bus, PASSIVE)
            heard = bus.recv(30.0)
        assert (heard.is_error_frame, heard.arbitration_id, heard.dlc) == (True, 0x204, 8)
        assert bytes(heard.data) == bytes.fromhex("0020000000008000")
        others = (heard.is_extended_id, heard.is_remote_frame, heard.is_fd, heard.is_rx)
        assert others == (False, False, False, self.is_rx)
        assert heard.channel == bench.channel
        assert heard.timestamp == pytest.approx(bench.now_s(), abs=5.0)

    def test_can_filters_neither_block_errors_nor_admit_frames(self, bench):
        filters = [{"can_id": 0x321, "can_mask": 0x7FF, "extended": False}]
        with bench.open(can_filters=filters) as bus, bench.open() as other:
            other.send(message(0x204))
            bench.tell(bus, NO_ACK)
            other.send(message(0x321))
            heard = [bus.recv(30.0), bus.recv(30.0)]
            assert sorted(m.arbitration_id for m in heard) == [0xA8, 0x321]
            bus.set_filters([{"can_id": 0x7FF, "can_mask": 0x7FF}])
            bench.tell(bus, BUS_OFF)
            assert bus.recv(30.0).arbitration_id == 0x40

    def test_errors_with_ignore_option_are_not_received(self, bench):
        with bench.open(ignore_rx_error_frames=True) as bus, bench.open() as other:
            bench.tell(bus, PASSIVE)
            other.send(message(0x321))
            assert bus.recv(30.0).arbitration_id == 0x321

    @pytest.mark.parametrize("own", [True, False])
    def test_own_frames_with_errors_follow_receive_option(self, bench, own):
        with bench.open(receive_own_messages=own) as bus, bench.open() as other:
            bus.send(message(0x123))
            assert other.recv(30.0).arbitration_id == 0x123  # proves that it was on the bus
            bench.tell(bus, NO_ACK)
            heard = [bus.recv(30.0) for _ in range(1 + own)]
            assert [m.is_error_frame for m in heard] == [False, True][-1 - own :]
            assert [m.is_rx for m in heard] == [False, self.is_rx][-1 - own :]

    def test_data_frame_with_bits_of_an_error_stays_data(self, bench):
        with bench.open() as bus, bench.open() as other:
            other.send(message(0x204, bytes.fromhex("0020000000008000")))
            heard = bus.recv(30.0)
            assert (heard.is_error_frame, heard.arbitration_id) == (False, 0x204)
            assert bus.state is BusState.ACTIVE

    def test_errors_reach_logger_and_printer(self, bench, tmp_path):
        # python-can's candump writer writes 20000080# for all of them; its BLF writer keeps them
        log, text = tmp_path / "heard.blf", tmp_path / "heard.txt"
        told = (WARNING, PASSIVE, BUS_OFF)
        with bench.open() as bus:
            for one in told:
                bench.tell(bus, one)
            self.hand_out(bus, [can.Printer(text), can.Logger(log)], len(told))
        printed = text.read_text().splitlines()
        assert [line.split("ID:")[1].split()[0] for line in printed] == ["204", "204", "040"]
        assert all(" E " in line for line in printed)
        with can.LogReader(log) as reader:
            kept = list(reader)
        assert [(m.arbitration_id, bytes(m.data)) for m in kept] == [
            (int.from_bytes(one[:2], "little"), one[8:]) for one in told
        ]
        assert all(m.is_error_frame for m in kept)

    def hand_out(self, bus, listeners, count):
        """Pass `count` messages of the bus to every listener, and stop the listeners."""
        mails = can.BufferedReader()
        notifier = can.Notifier(bus, [*listeners, mails], timeout=0.1)
        for _ in range(count):
            assert mails.get_message(30.0) is not None
        notifier.stop()

    def test_bus_state_follows_errors_if_supported(self, bench):
        told = (WARNING, PASSIVE, WARNING, ACTIVE, PASSIVE, BUS_OFF, RESTARTED, PASSIVE, NO_ACK)
        states = []
        with bench.open() as bus:
            for one in told:
                bench.tell(bus, one)
                assert bus.recv(30.0).is_error_frame
                states.append(bus.state.name)
            with pytest.raises(NotImplementedError):
                bus.state = BusState.ACTIVE
        followed = "ACTIVE PASSIVE ACTIVE ACTIVE PASSIVE ERROR ACTIVE PASSIVE PASSIVE"
        if not self.keeps_state:
            followed = " ".join(["ACTIVE"] * len(told))
        assert " ".join(states) == followed
