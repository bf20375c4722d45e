"""Framing, on a line and in a stream.

Source of the frames: MODBUS over Serial Line V1.02, section 2.5.1.2 and appendix B (02h 07h has the
check sum 1241h); pymodbus' framers, which are not ours; the Messaging on TCP/IP guide V1.0b.
"""

import pytest
from hypothesis import event, given
from hypothesis import strategies as st
from pymodbus.framer import FramerRTU

from emulators.modbus.crc import crc16, with_crc
from emulators.modbus.diagnostics import Diagnostics
from emulators.modbus.registers import Register, RegisterBank
from emulators.modbus.rtu import RtuUnit
from emulators.modbus.server import ModbusServer
from emulators.modbus.tcp import MbapStream

MS = 1_000_000


def server(serial: bool = True) -> ModbusServer:
    bank = RegisterBank([Register(n, f"r{n}", default=n) for n in range(0x100)])
    return ModbusServer(holding=bank, diagnostics=Diagnostics() if serial else None)


def test_check_sums_of_the_standard():
    assert crc16(b"\x02\x07") == b"\x41\x12"
    assert with_crc(bytes.fromhex("01030000000A")).hex(" ") == "01 03 00 00 00 0a c5 cd"


@given(st.binary(max_size=40))
def test_check_sums_are_those_of_another_implementation(data):
    assert crc16(data) == FramerRTU.compute_CRC(data).to_bytes(2, "big")


def exchange(unit: RtuUnit, frame: str, now_ns: int = 0) -> str:
    unit.receive(bytes.fromhex(frame), now_ns)
    due_ns = unit.next_deadline_ns()
    if due_ns is None:
        return ""
    unit.expire(due_ns)
    return b"".join(unit.take_output()).hex(" ").upper()


def test_a_unit_answers_after_its_own_time():
    unit = RtuUnit(1, server(), reply_ns=3 * MS)
    unit.receive(bytes.fromhex("010300020001 25CA"), 10 * MS)
    assert unit.next_deadline_ns() == 13 * MS
    unit.expire(13 * MS - 1)
    assert unit.take_output() == []
    unit.expire(13 * MS)
    assert unit.take_output() == [with_crc(bytes.fromhex("0103020002"))]
    assert unit.take_output() == []


def test_what_is_not_its_own_it_does_not_answer():
    unit = RtuUnit(1, server())
    of_another = with_crc(bytes.fromhex("020300020001")).hex()
    answer_of_another = with_crc(bytes.fromhex("0203020002")).hex()
    assert exchange(unit, of_another) == ""
    assert exchange(unit, answer_of_another) == ""
    assert exchange(unit, "010300020001 25CA") == "01 03 02 00 02 39 85"
    assert unit.server.diagnostics is not None
    assert unit.server.diagnostics.bus_messages == 3
    assert unit.server.diagnostics.server_messages == 1


@pytest.mark.parametrize("frame", ["", "01", "0103 0000", "010300020001 25CB", "01" * 300])
def test_what_is_no_frame_is_counted_and_not_answered(frame):
    unit = RtuUnit(1, server())
    assert exchange(unit, frame) == ""
    assert unit.server.diagnostics is not None
    assert unit.server.diagnostics.bus_errors == 1


def test_a_broadcast_is_done_and_not_answered():
    unit = RtuUnit(1, server())
    assert exchange(unit, with_crc(bytes.fromhex("000600050777")).hex()) == ""
    assert unit.server.holding is not None
    assert unit.server.holding["r5"] == 0x777


def test_a_second_request_before_the_answer_to_the_first_is_ignored_and_counted():
    unit = RtuUnit(1, server())
    unit.receive(with_crc(bytes.fromhex("010600050001")), 0)
    unit.receive(with_crc(bytes.fromhex("010600050002")), MS // 2)
    unit.expire(MS)
    assert len(unit.take_output()) == 1
    assert unit.ignored == 1
    assert unit.server.holding is not None
    assert unit.server.holding["r5"] == 1


@pytest.mark.parametrize("unit", [0, 248, 255, -1])
def test_a_unit_that_cannot_be_is_refused(unit):
    with pytest.raises(ValueError, match="1 to 247"):
        RtuUnit(unit, server())


def mbap(transaction: int, unit: int, pdu: str, protocol: int = 0) -> bytes:
    data = bytes.fromhex(pdu)
    head = transaction.to_bytes(2, "big") + protocol.to_bytes(2, "big")
    return head + (len(data) + 1).to_bytes(2, "big") + bytes((unit,)) + data


def test_requests_under_way_at_once_are_all_answered_each_with_its_own_transaction():
    stream = MbapStream({1: server(serial=False)})
    asked = b"".join(mbap(n, 1, f"03 {n:04X} 0001") for n in (7, 3, 9))
    assert stream.feed(asked) == b"".join(mbap(n, 1, f"03 02 {n:04X}") for n in (7, 3, 9))


@given(st.lists(st.integers(0, 200), min_size=1, max_size=5), st.data())
def test_a_stream_may_be_split_anywhere(numbers, data):
    asked = b"".join(mbap(n, 1, f"03 {n:04X} 0001") for n in numbers)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(asked)), max_size=6)))
    event(f"{len(cuts)} cuts")
    stream = MbapStream({1: server(serial=False)})
    pieces = zip([0, *cuts], [*cuts, len(asked)], strict=True)
    answered = b"".join(stream.feed(asked[low:high]) for low, high in pieces)
    assert answered == MbapStream({1: server(serial=False)}).feed(asked)
    assert stream.requests == len(numbers)


def test_units_are_told_apart_and_a_missing_one_is_the_gateways_answer():
    two = MbapStream({1: server(serial=False), 2: server(serial=False)})
    assert two.feed(mbap(1, 2, "03 0005 0001")) == mbap(1, 2, "03 02 0005")
    assert two.feed(mbap(2, 3, "03 0005 0001")) == mbap(2, 3, "83 0B")
    assert two.feed(mbap(3, 0xFF, "03 0005 0001")) == mbap(3, 0xFF, "83 0B")


@pytest.mark.parametrize("unit", [0x00, 0x01, 0xFF])
def test_a_controller_that_is_alone_is_meant_by_no_particular_unit_too(unit):
    alone = MbapStream({1: server(serial=False)})
    assert alone.feed(mbap(1, unit, "03 0005 0001")) == mbap(1, unit, "03 02 0005")
    assert alone.feed(mbap(1, 0, "06 0005 0009")) == mbap(1, 0, "06 0005 0009")  # no broadcast here


@pytest.mark.parametrize(
    "head", ["0001 0001 0006 01", "0001 0000 0001 01", "0001 0000 00FF 01", "4745 5420 2F20 48"]
)
def test_a_stream_that_is_no_modbus_is_closed_with_the_reason(head):
    stream = MbapStream({1: server(serial=False)})
    assert stream.feed(bytes.fromhex(head)) == b""
    assert stream.closed_because is not None
    assert "no Modbus" in stream.closed_because
    assert stream.feed(mbap(1, 1, "03 0005 0001")) == b""
    longest = MbapStream({1: server(serial=False)})
    assert longest.feed(mbap(1, 1, "63" + "00" * 252)) == mbap(1, 1, "E3 01")
