"""Requirements of the Modbus specification that other servers miss.

Each check is a function of a requester, so it is also run against pymodbus's own server, which
fails it: that is its planted fault. Expected bytes: MODBUS Application Protocol V1.1b3, section 6
and its state diagrams; Messaging on TCP/IP V1.0b, section 4.4; Serial Line V1.02, 2.
"""

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from select import select

import pytest

from motorhil.emulators.modbus.rtu import with_crc
from motorhil.emulators.modbus.tcp import adu
from tests.support.modbus.served import CLIENTS_MAX, Served

pytestmark = pytest.mark.wall

Ask = Callable[[int, bytes], bytes]
READ_5 = bytes.fromhex("03 0005 0001")


@pytest.fixture
def served(tmp_path) -> Iterator[Served]:
    there = Served(tmp_path / "line")
    try:
        yield there
    finally:
        there.close()


@pytest.fixture(params=["tcp", "rtu"])
def ask(request, served) -> Ask:
    return served.ask_tcp if request.param == "tcp" else served.ask_rtu


def test_idle_clients_leave_room_for_a_new_one(served):
    """The guide on TCP, connection management: the oldest unused connection is closed."""
    others = CLIENTS_MAX - 1  # one is in use
    idle = [socket.create_connection(served.socket.address) for _ in range(others)]
    for number in range(10):
        assert served.ask_tcp(1, pdu("03 0000 0001"))[0] == 0x03  # it is in use
        idle.append(socket.create_connection(served.socket.address))
        served.until(lambda: select([idle[number]], [], [], 0)[0])  # noqa: B023 -- at once
        assert idle[number].recv(1) == b""
    assert served.ask_tcp(1, pdu("03 0000 0001"))[0] == 0x03
    for one in idle:
        one.close()


def pdu(text: str) -> bytes:
    return bytes.fromhex(text)


# ---- checks for any server ----


def quantity_0_and_one_too_many_are_illegal_values(ask: Ask) -> None:
    for function, most in ((1, 2000), (2, 2000), (3, 125), (4, 125)):
        for count in (0, most + 1):
            request = bytes((function, 0, 5)) + count.to_bytes(2, "big")
            assert ask(1, request) == bytes((function | 0x80, 3)), (function, count)
    assert ask(1, pdu("10 0005 0000 00")) == pdu("90 03")
    assert ask(1, pdu("0F 0005 0000 00")) == pdu("8F 03")
    assert ask(1, pdu("17 0005 0000 0005 0001 02 0001")) == pdu("97 03")
    assert ask(1, pdu("17 0005 007E 0005 0001 02 0001")) == pdu("97 03")


def the_greatest_quantity_is_right(ask: Ask) -> None:
    assert ask(1, pdu("03 0005 007D"))[:2] == pdu("03 FA")


def a_coil_is_on_or_off_and_1234h_is_neither(ask: Ask) -> None:
    assert ask(1, pdu("05 0007 1234")) == pdu("85 03")
    assert ask(1, pdu("01 0007 0001")) == pdu("01 01 00")
    assert ask(1, pdu("05 0007 FF00")) == pdu("05 0007 FF00")
    assert ask(1, pdu("05 0007 0001")) == pdu("85 03")
    assert ask(1, pdu("01 0007 0001")) == pdu("01 01 01")


def function_17h_writes_nothing_if_its_read_range_is_illegal(ask: Ask) -> None:
    before = ask(1, READ_5)
    assert ask(1, pdu("17 FF00 0001 0005 0001 02 BEEF")) == pdu("97 02")
    assert ask(1, READ_5) == before
    assert ask(1, pdu("17 0005 0001 0005 0001 02 BEEF")) == pdu("17 02 BEEF")


def a_foreign_unit_is_not_answered_as_if_it_were_there(ask: Ask) -> None:
    before = ask(1, READ_5)
    assert ask(9, pdu("06 0005 BEEF")) == pdu("86 0B")
    assert ask(1, READ_5) == before


def nobody_answers_as_all_units(ask: Ask) -> None:
    before = ask(1, READ_5)
    assert ask(0, pdu("06 0005 BEEF")) == pdu("86 0B")  # TCP has no broadcast
    assert ask(1, READ_5) == before


CHECKS = [
    quantity_0_and_one_too_many_are_illegal_values,
    a_coil_is_on_or_off_and_1234h_is_neither,
    function_17h_writes_nothing_if_its_read_range_is_illegal,
]
UNITS_ON_TCP = [a_foreign_unit_is_not_answered_as_if_it_were_there, nobody_answers_as_all_units]


@pytest.mark.parametrize("check", [*CHECKS, the_greatest_quantity_is_right])
def test_served_units_pass_check(ask, check):
    check(ask)


@pytest.mark.parametrize("check", UNITS_ON_TCP)
def test_gateway_responds_for_missing_units(served, check):
    check(served.ask_tcp)


# ---- checks with several responses ----


def pipelined(unit: int, count: int) -> tuple[bytes, list[int]]:
    """Return this many requests in one piece, and their transaction identifiers."""
    transactions = [0x7000 + 3 * number for number in range(count)]
    return b"".join(adu(one, unit, READ_5) for one in transactions), transactions


def test_fifty_pipelined_requests_are_answered_in_order(served):
    data, transactions = pipelined(2, 50)
    os.write(served.tcp.fileno(), data)
    for one in transactions:
        assert served.answer_tcp(one, 2) == pdu("03 02 07D5")


def test_request_may_be_split_at_any_byte(served):
    data, transactions = pipelined(1, 3)
    for cut in range(1, len(data)):
        os.write(served.tcp.fileno(), data[:cut])
        served.loop.step(0)
        served.loop.step(0)
        os.write(served.tcp.fileno(), data[cut:])
        for one in transactions:
            assert served.answer_tcp(one, 1) == pdu("03 02 03ED")


def test_slow_reader_loses_nothing_and_blocks_no_other(served):
    gateway = served.world.line("plant").gateway
    sent = 0
    with socket.socket() as late:
        late.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16_384)
        late.connect(served.socket.address)
        late.setblocking(False)
        assert served.ask_tcp(2, READ_5) == pdu("03 02 07D5")
        for connection in served.socket._connections:  # the kernel would buffer megabytes
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 16_384)
        asked = gateway.requests
        while not served.socket.backlogged():
            os.write(late.fileno(), adu(1, 1, pdu("03 0000 007D")) * 50)
            sent += 50
            while gateway.requests < asked + sent:
                served.loop.step(0.05)
            served.loop.step(0)
        assert served.ask_tcp(2, READ_5) == pdu("03 02 07D5")
        size = 7 + 2 + 250
        answers = served.heard(late.fileno(), size * sent)
    assert answers[:9] == pdu("0001 0000 00FD 01 03 FA")
    assert answers == answers[:size] * sent


def test_foreign_protocol_ends_its_connection_only(served):
    with socket.create_connection(served.socket.address) as other:
        other.sendall(b"GET / HTTP/1.1\r\n\r\n")
        served.until(lambda: bool(select([other], [], [], 0)[0]))
        assert other.recv(1) == b""
    assert served.ask_tcp(1, READ_5) == pdu("03 02 03ED")


def test_foreign_unit_on_line_is_silent(served):
    served.write(with_crc(bytes((9,)) + pdu("06 0005 BEEF")))
    assert served.ask_rtu(1, READ_5) == pdu("03 02 03ED")
    assert served.ask_rtu(2, READ_5) == pdu("03 02 07D5")


def test_broadcast_on_line_is_executed_without_response(served):
    served.write(with_crc(pdu("00 06 0005 BEEF")))
    assert served.ask_rtu(1, READ_5) == pdu("03 02 BEEF")
    assert served.ask_rtu(2, READ_5) == pdu("03 02 BEEF")


def test_broadcast_read_is_ignored(served):
    served.write(with_crc(b"\x00" + READ_5))
    assert served.ask_rtu(2, READ_5) == pdu("03 02 07D5")


def test_units_on_line_ignore_responses_of_others(served):
    for _ in range(10):
        assert served.ask_rtu(1, READ_5) == pdu("03 02 03ED")
        assert served.ask_rtu(2, READ_5) == pdu("03 02 07D5")


@pytest.mark.parametrize(
    "noise",
    ["00", "FF FF FF", "01 03 00 05 00 01 00 00", "01 03 00", "01 41 22", "01 10 0005 0001 02 BE"],
)
def test_invalid_frame_is_ignored_and_next_request_answered(served, noise):
    served.write(pdu(noise))
    served.until(lambda: served.world.line("rs485").line.frames == 1)
    assert served.ask_rtu(1, READ_5) == pdu("03 02 03ED")


def test_unknown_function_is_delimited_by_silence(served):
    assert served.ask_rtu(1, pdu("41 1234 5678")) == pdu("C1 01")


def test_frame_longer_than_usual_is_one_frame(served):
    echo = with_crc(pdu("01 08 0000 A537 1234 5678"))
    served.write(echo)
    assert served.heard(served.terminal, len(echo)) == echo


def test_frames_written_at_once_keep_silence_on_line(served):
    served.write(with_crc(pdu("00 06 0005 BEEF")) + with_crc(pdu("00 06 0006 CAFE")))
    assert served.ask_rtu(1, pdu("03 0005 0002")) == pdu("03 04 BEEF CAFE")
    line = served.world.line("rs485").line
    served.until(lambda: line.frames >= 4)  # the t3.5 of the response is over as well
    assert line.frames == 4


# ---- the planted fault: pymodbus's own server ----


@pytest.fixture(scope="module")
def peer() -> Iterator[Ask]:
    command = [sys.executable, "-m", "tests.benchmarks.pymodbus_peer", str(300)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as server:
        try:
            assert server.stdout is not None
            port = int(server.stdout.readline())
            with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:

                def ask(unit: int, request: bytes) -> bytes:
                    connection.sendall(adu(1, unit, request))
                    return connection.recv(300)[7:]

                yield ask
        finally:
            server.kill()


@pytest.mark.parametrize("check", [*CHECKS, *UNITS_ON_TCP])
def test_check_detects_fault_of_other_server(peer, check):
    with pytest.raises(AssertionError):
        check(peer)


def test_other_server_responds(peer):
    the_greatest_quantity_is_right(peer)
