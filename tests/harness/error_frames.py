"""What python-can's users see of errors, wherever they are joined: one class for every way.

Expected bytes are linux/can/error.h's, by hand, and what python-can's SocketCAN interface makes of
them (4.6.1, `capture_message`); what filters do to them is the kernel's (net/can/raw.c: an error
message goes by CAN_RAW_ERR_FILTER alone).
"""

import can
import pytest
from can import BusState

# can_frame: can_id little-endian, length, padding, data; data[1] state, [2] what, [3] where,
# [6] TEC, [7] REC
PASSIVE = bytes.fromhex("04020020 08 000000 0020000000008000")  # CRTL, CNT: TX passive, TEC 128
WARNING = bytes.fromhex("04020020 08 000000 0008000000006000")  # CRTL, CNT: TX warning, TEC 96
ACTIVE = bytes.fromhex("04020020 08 000000 0040000000005f00")  # CRTL, CNT: error active again
BUS_OFF = bytes.fromhex("40000020 08 000000 0000000000000000")
RESTARTED = bytes.fromhex("00010020 08 000000 0000000000000000")
NO_ACK = bytes.fromhex("a8000020 08 000000 0000801900000000")  # PROT, ACK, BUSERROR: TX, ACK slot
DATA = bytes.fromhex("04020000 08 000000 0020000000008000")  # a frame: identifier 204h


def message(can_id, data=b""):
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


class ErrorFrames:
    """Bring a fixture `bench`: `open(**options)` joins, `tell(bus, message)` tells of an error.

    Attributes: is_rx, as this way calls what comes from its own host; keeps_state, whether
    `bus.state` follows.
    """

    is_rx = True
    keeps_state = True

    def test_an_error_is_an_error_frame_with_all_that_it_tells(self, bench):
        with bench.open() as bus:
            bench.tell(bus, PASSIVE)
            heard = bus.recv(30.0)
        assert (heard.is_error_frame, heard.arbitration_id, heard.dlc) == (True, 0x204, 8)
        assert bytes(heard.data) == bytes.fromhex("0020000000008000")
        others = (heard.is_extended_id, heard.is_remote_frame, heard.is_fd, heard.is_rx)
        assert others == (False, False, False, self.is_rx)
        assert heard.channel == bench.channel
        assert heard.timestamp == pytest.approx(bench.now_s(), abs=5.0)

    def test_no_filter_holds_an_error_back_and_none_lets_a_frame_in_for_it(self, bench):
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

    def test_who_wants_no_errors_hears_none(self, bench):
        with bench.open(ignore_rx_error_frames=True) as bus, bench.open() as other:
            bench.tell(bus, PASSIVE)
            other.send(message(0x321))
            assert bus.recv(30.0).arbitration_id == 0x321

    @pytest.mark.parametrize("own", [True, False])
    def test_own_frames_are_heard_or_not_as_ever(self, bench, own):
        with bench.open(receive_own_messages=own) as bus, bench.open() as other:
            bus.send(message(0x123))
            assert other.recv(30.0).arbitration_id == 0x123  # so it has been on the bus
            bench.tell(bus, NO_ACK)
            heard = [bus.recv(30.0) for _ in range(1 + own)]
            assert [m.is_error_frame for m in heard] == [False, True][-1 - own :]
            assert [m.is_rx for m in heard] == [False, self.is_rx][-1 - own :]

    def test_a_frame_with_the_same_bits_is_no_error(self, bench):
        with bench.open() as bus, bench.open() as other:
            other.send(message(0x204, bytes.fromhex("0020000000008000")))
            heard = bus.recv(30.0)
            assert (heard.is_error_frame, heard.arbitration_id) == (False, 0x204)
            assert bus.state is BusState.ACTIVE

    def test_a_logger_keeps_them_and_a_printer_prints_them(self, bench, tmp_path):
        # python-can's candump writer writes 20000080# for all of them; its BLF writer what they are
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
        """Every listener has heard `count` messages of the bus, and is stopped."""
        mails = can.BufferedReader()
        notifier = can.Notifier(bus, [*listeners, mails], timeout=0.1)
        for _ in range(count):
            assert mails.get_message(30.0) is not None
        notifier.stop()

    def test_the_state_follows_where_the_interface_keeps_one(self, bench):
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
