"""Modbus framing, on a serial line and in a TCP stream.

Source of the frames: MODBUS over Serial Line V1.02, section 2.5.1.2 and appendix B (02h 07h has the
checksum 1241h); pymodbus' framers, which are not ours; the Messaging on TCP/IP guide V1.0b.
"""

import pytest
from hypothesis import event, given
from hypothesis import strategies as st
from pymodbus.framer import FramerRTU

from motorhil.emulators.modbus.registers import Register, RegisterBank
from motorhil.emulators.modbus.rtu import RtuUnit, crc16, with_crc
from motorhil.emulators.modbus.server import Diagnostics, ModbusServer
from motorhil.emulators.modbus.tcp import GONE, MbapStream, TcpGateway, adu

MS = 1_000_000


def server() -> ModbusServer:
    bank = RegisterBank([Register(n, f"r{n}", default=n) for n in range(0x100)])
    return ModbusServer(holding=bank, diagnostics=Diagnostics())


def test_crc_equals_examples_of_standard():
    assert crc16(b"\x02\x07") == b"\x41\x12"
    assert with_crc(bytes.fromhex("01030000000A")).hex(" ") == "01 03 00 00 00 0a c5 cd"


@given(st.binary(max_size=40))
def test_crc_equals_other_implementation(data):
    assert crc16(data) == FramerRTU.compute_CRC(data).to_bytes(2, "big")


def exchange(unit: RtuUnit, frame: str, now_ns: int = 0) -> str:
    unit.receive(bytes.fromhex(frame), now_ns)
    due_ns = unit.next_deadline_ns()
    if due_ns is None:
        return ""
    unit.expire(due_ns)
    return b"".join(unit.take_output()).hex(" ").upper()


def test_unit_responds_after_reply_time():
    unit = RtuUnit(1, server(), reply_ns=3 * MS)
    unit.receive(bytes.fromhex("010300020001 25CA"), 10 * MS)
    assert unit.next_deadline_ns() == 13 * MS
    unit.expire(13 * MS - 1)
    assert unit.take_output() == []
    unit.expire(13 * MS)
    assert unit.take_output() == [with_crc(bytes.fromhex("0103020002"))]
    assert unit.take_output() == []


def test_frame_for_other_unit_is_ignored():
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
def test_invalid_frame_is_counted_without_response(frame):
    unit = RtuUnit(1, server())
    assert exchange(unit, frame) == ""
    assert unit.server.diagnostics is not None
    assert unit.server.diagnostics.bus_errors == 1


def test_broadcast_is_executed_without_response():
    unit = RtuUnit(1, server())
    assert exchange(unit, with_crc(bytes.fromhex("000600050777")).hex()) == ""
    assert unit.server.holding is not None
    assert unit.server.holding["r5"] == 0x777


def test_request_before_response_is_ignored_and_counted():
    unit = RtuUnit(1, server())
    unit.receive(with_crc(bytes.fromhex("010600050001")), 0)
    unit.receive(with_crc(bytes.fromhex("010600050002")), MS // 2)
    unit.expire(MS)
    assert len(unit.take_output()) == 1
    assert unit.ignored == 1
    assert unit.server.holding is not None
    assert unit.server.holding["r5"] == 1


@pytest.mark.parametrize("unit", [0, 248, 255, -1])
def test_invalid_unit_is_refused(unit):
    with pytest.raises(ValueError, match="1 to 247"):
        RtuUnit(unit, server())


def mbap(transaction: int, unit: int, pdu: str, protocol: int = 0) -> bytes:
    data = bytes.fromhex(pdu)
    head = transaction.to_bytes(2, "big") + protocol.to_bytes(2, "big")
    return head + (len(data) + 1).to_bytes(2, "big") + bytes((unit,)) + data


def test_pending_requests_differ_by_transaction():
    asked = b"".join(mbap(n, 1, f"03 {n:04X} 0001") for n in (7, 3, 9))
    expected = [(n, 1, bytes.fromhex(f"03 {n:04X} 0001")) for n in (7, 3, 9)]
    assert MbapStream().feed(asked) == expected


@given(st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=5), st.data())
def test_stream_may_be_split_anywhere(numbers, data):
    asked = b"".join(mbap(n, 1, f"03 {n:04X} 0001") for n in numbers)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(asked)), max_size=6)))
    event(f"{len(cuts)} cuts")
    stream = MbapStream()
    pieces = zip([0, *cuts], [*cuts, len(asked)], strict=True)
    found = [request for low, high in pieces for request in stream.feed(asked[low:high])]
    assert [transaction for transaction, _, _ in found] == numbers
    assert b"".join(adu(*request) for request in found) == asked


@pytest.mark.parametrize(
    "head", ["0001 0001 0006 01", "0001 0000 0001 01", "0001 0000 00FF 01", "4745 5420 2F20 48"]
)
def test_foreign_stream_is_closed_with_reason(head):
    stream = MbapStream()
    assert stream.feed(bytes.fromhex(head)) == []
    assert stream.closed_because is not None
    assert "no Modbus" in stream.closed_because
    assert stream.feed(mbap(1, 1, "03 0005 0001")) == []
    assert len(MbapStream().feed(mbap(1, 1, "63" + "00" * 252))) == 1  # the maximum length


READ = (5, 1, bytes.fromhex("03 0005 0001"))


def gateway(*units: int) -> TcpGateway:
    one = TcpGateway(timeout_ns=100 * MS)
    for unit in units:
        one.add_unit(unit)
    return one


def test_unit_gets_one_request_at_a_time():
    one = gateway(1, 2)
    assert one.ask(10, (5, 1, b"\x03a"), 0) == (1, b"\x03a")
    assert one.ask(11, (5, 1, b"\x03b"), 0) is None
    assert one.ask(12, (9, 2, b"\x03c"), 0) == (2, b"\x03c")
    assert one.answered(2, b"\x03C") == (12, mbap(9, 2, "03 43"))
    assert one.answered(1, b"\x03A") == (10, mbap(5, 1, "03 41"))
    assert one.next_for(1, 0) == b"\x03b"
    assert one.answered(1, b"\x03B") == (11, mbap(5, 1, "03 42"))
    assert one.next_for(1, 0) is None
    assert one.answered(1, b"\x03D") is None


def test_gateway_responds_for_silent_unit():
    one = gateway(1)
    one.ask(10, READ, 0)
    assert one.next_deadline_ns() == 100 * MS
    assert one.expired(100 * MS - 1) == []
    assert one.expired(100 * MS) == [(1, 10, mbap(5, 1, "83 0B"))]
    assert one.timeouts == 1


def test_late_response_is_not_used_for_next_request():
    one = gateway(1)
    one.ask(10, READ, 0)
    one.expired(100 * MS)
    assert one.ask(10, (6, 1, b"\x03b"), 100 * MS) is None  # until the old response has come
    assert one.answered(1, b"\x03 late") is None
    assert one.next_for(1, 110 * MS) == b"\x03b"
    assert one.answered(1, b"\x03B") == (10, mbap(6, 1, "03 42"))


def test_silent_unit_is_asked_again_after_timeout():
    one = gateway(1)
    one.ask(10, READ, 0)
    one.expired(100 * MS)
    one.ask(10, (6, 1, b"\x03b"), 100 * MS)
    assert one.next_deadline_ns() == 200 * MS
    assert one.expired(200 * MS) == [(1, GONE, b"")]
    assert one.next_for(1, 200 * MS) == b"\x03b"


@pytest.mark.parametrize("unit", [0x00, 0x01, 0xFF])
def test_single_controller_accepts_any_unspecific_unit(unit):
    alone = gateway(1)
    assert alone.knows(unit)
    alone.ask(10, (5, unit, b"\x03a"), 0)
    assert alone.answered(1, b"\x03A") == (10, mbap(5, unit, "03 41"))
    assert not gateway(1, 2).knows(0xFF)
    assert one_refuses(gateway(1, 2)) == mbap(5, 3, "83 0B")


def one_refuses(one: TcpGateway) -> bytes:
    return one.refusal((5, 3, bytes.fromhex("03 0005 0001")))


def test_closed_connection_gets_no_response():
    one = gateway(1)
    one.ask(10, READ, 0)
    one.forget(10)
    answer = one.answered(1, b"\x03A")
    assert answer is not None
    assert answer[0] == GONE


def test_queued_request_of_closed_connection_is_dropped():
    one = gateway(1)
    one.ask(10, READ, 0)
    one.ask(10, (6, 1, b"\x06b"), 0)
    one.ask(11, (7, 1, b"\x03c"), 0)
    one.forget(10)
    one.answered(1, b"\x03A")
    assert one.next_for(1, 0) == b"\x03c"


def test_request_for_silent_unit_is_dropped_on_disconnect():
    one = gateway(1)
    one.ask(10, READ, 0)
    one.expired(100 * MS)
    one.ask(10, (6, 1, b"\x06b"), 100 * MS)
    one.forget(10)
    one.expired(200 * MS)
    assert one.next_for(1, 200 * MS) is None


def test_queue_of_unit_is_limited():
    one = gateway(1, 2)
    for number in range(64):
        assert not one.is_full(1)
        one.ask(10, (number, 1, b"\x03a"), 0)
    assert one.is_full(1)
    assert not one.is_full(2)
    assert one.refusal((5, 1, b"\x03a")) == mbap(5, 1, "83 0A")
    one.answered(1, b"\x03A")
    assert not one.is_full(1)


def test_duplicate_unit_is_refused():
    with pytest.raises(ValueError, match="unit 1: already used"):
        gateway(1, 1)
