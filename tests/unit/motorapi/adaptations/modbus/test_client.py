"""A Modbus line whose peer violates the protocol."""

import logging

import pytest
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from motorhil.motorapi.adaptations.modbus.client import ModbusLine, ModbusProtocolViolation
from motorhil.motorapi.errors import DeadlineExceeded, LinkError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import ProcessLock
from tests.support.modbus.bench import with_crc
from tests.support.modbus.rigs import MS, opened

TIMEOUT_S = 0.2
NEXT_S = 0.15  # delay of the next answer


class Subscription:
    def __init__(self, listeners, listener):
        self.cancel = lambda: listeners.remove(listener)
        listeners.append(listener)


class Line:
    """A ByteLine whose other end is the test's: `answer(line, number of the request)`."""

    name = "line"
    silence_ns = 1_750_000
    is_closed = False

    def __init__(self, runtime, framing, answer):
        self.framing = framing
        self.sent = []
        self._runtime = runtime
        self._answer = answer
        self._listeners = []

    def duration_ns(self, characters):
        return 0

    def listen(self, on_data):
        return Subscription(self._listeners, on_data)

    def send(self, data):
        self.sent.append((self._runtime.now_ns(), data))
        self._answer(self, len(self.sent))

    def hear(self, data):
        for listener in tuple(self._listeners):
            listener(data, self._runtime.now_ns())

    def hear_after(self, time_s, data):
        def hear():
            timer.cancel()
            self.hear(data)

        timer = self._runtime.every(time_s, hear)

    def hear_always(self, period_s, data):
        self._runtime.every(period_s, lambda: self.hear(data))


class Connection(Line):
    """A connection that answers from its second one on."""

    is_refused = False
    connections = 1

    def reconnect(self):
        if self.is_refused:
            raise LinkError(link=self.name, reason="no connection")
        self.connections += 1
        self.is_closed = False


def never(line, number):
    """Answer no request."""


@pytest.fixture
def runtime():
    with opened() as rig:
        yield rig.runtime


def on(runtime, answer=never, framing="rtu"):
    line = Line(runtime, framing, answer)
    return line, ModbusLine(line, runtime, None)


def read(line, unit=1):
    request = ReadHoldingRegistersRequest(address=0x10, count=1)
    return line.ask(request, unit, TIMEOUT_S).registers


def rtu(value, unit=1):
    """Return the answer to `read` (V1.1b3, 6.3)."""
    return with_crc(bytes((unit, 3, 2)) + value.to_bytes(2, "big"))


def tcp(transaction, pdu, length=None):
    size = len(pdu) + 1 if length is None else length
    return bytes((0, transaction, 0, 0, 0, size, 1)) + pdu


def late(*pieces):
    """Answer the first request late, in pieces (time [s], bytes), and the others in time."""

    def answer(line, number):
        if number > 1:
            line.hear_after(NEXT_S, rtu(2222))
            return
        for time_s, data in pieces:
            line.hear_after(time_s, data)

    return answer


@pytest.mark.parametrize(
    "pieces",
    [
        pytest.param([(0.25, b"\xff"), (0.3, rtu(1111))], id="noise before it"),
        pytest.param([(0.25, rtu(1111)[:3]), (0.266, rtu(1111)[3:])], id="by an adapter of 16 ms"),
        pytest.param([(0.19, rtu(1111)[:3]), (0.266, rtu(1111)[3:])], id="half of it in time"),
        pytest.param([(0.25, rtu(7, unit=2)), (0.3, rtu(1111))], id="another unit before it"),
    ],
)
def test_late_answer_in_pieces_is_not_the_next_one(runtime, pieces):
    _, modbus = on(runtime, late(*pieces))
    with pytest.raises((DeadlineExceeded, ModbusProtocolViolation)):
        read(modbus)
    assert read(modbus) == [2222]
    assert read(modbus) == [2222]


@pytest.mark.parametrize("framing", ["rtu", "tcp"])
@pytest.mark.parametrize(
    ("unit", "pdu"), [(2, "03 02 0007"), (1, "04 02 0007"), (1, "84 02")], ids=["unit", "04", "84"]
)
def test_answer_of_another_unit_or_function_is_not_taken(runtime, framing, unit, pdu):
    def answer(line, number):
        for time_s, own, said in ((0.01, unit, pdu), (0.05, 1, "03 02 0457")):
            data = bytes((own,)) + bytes.fromhex(said)
            head = bytes((0, number, 0, 0, 0, len(data)))
            line.hear_after(time_s, with_crc(data) if framing == "rtu" else head + data)

    _, modbus = on(runtime, answer, framing)
    if framing == "tcp":
        assert read(modbus) == [1111]
    else:  # where the other one ends is not known
        with pytest.raises(ModbusProtocolViolation, match=r"not an answer to the request \(0"):
            read(modbus)


READ = ReadHoldingRegistersRequest(address=0x10, count=1)
WRITE = WriteSingleRegisterRequest(address=0x10, registers=[5])
WRITE_TWO = WriteMultipleRegistersRequest(address=0x10, registers=[5, 6])


@pytest.mark.parametrize("framing", ["rtu", "tcp"])
@pytest.mark.parametrize(
    ("request_", "pdu"),
    [
        (READ, "03 00"),
        (READ, "03 04 0007 0008"),
        (WRITE, "06 0011 0005"),
        (WRITE, "06 0010 0004"),
        (WRITE_TWO, "10 0011 0002"),
        (WRITE_TWO, "10 0010 0001"),
    ],
)
def test_answer_that_does_not_repeat_its_request_is_refused(runtime, framing, request_, pdu):
    def answer(line, number):
        said = bytes.fromhex(pdu)
        line.hear_after(0.01, with_crc(b"\x01" + said) if framing == "rtu" else tcp(1, said))

    _, modbus = on(runtime, answer, framing)
    with pytest.raises(ModbusProtocolViolation):
        modbus.ask(request_, 1, TIMEOUT_S)


@pytest.mark.parametrize("length", [0, 1, 255])
def test_invalid_header_is_reported_and_next_answer_is_read(runtime, length):
    def answer(line, number):
        said = bytes.fromhex("03 02 0007")
        line.hear_after(0.01, tcp(number, said, length if number == 1 else None))

    _, modbus = on(runtime, answer, "tcp")
    with pytest.raises(ModbusProtocolViolation):
        read(modbus)
    assert read(modbus) == [7]


@pytest.mark.parametrize("split", range(1, 11))
def test_half_a_late_answer_on_tcp_harms_no_other(runtime, split):
    first, second = (tcp(n, bytes((3, 2, 0, n))) for n in (1, 2))

    def answer(line, number):
        line.hear_after(0.01, first[:split] if number == 1 else first[split:] + second)

    _, modbus = on(runtime, answer, "tcp")
    with pytest.raises(ModbusProtocolViolation):
        read(modbus)
    assert read(modbus) == [2]


def test_never_silent_line_times_out_but_a_stop_is_sent(runtime):
    line, modbus = on(runtime)
    line.hear_always(0.001, b"\x55")
    runtime.run_for(0.1)
    began_ns = runtime.now_ns()
    with pytest.raises(DeadlineExceeded, match="it is never silent"):
        read(modbus)
    assert runtime.now_ns() - began_ns == pytest.approx(2_000 * MS, abs=5 * MS)
    assert line.sent == []
    began_ns = runtime.now_ns()
    modbus.post(WRITE, 1, TIMEOUT_S)
    runtime.run_for(0.5)
    assert [time_ns - began_ns for time_ns, _ in line.sent] == [pytest.approx(100 * MS, abs=2 * MS)]


def test_posted_request_does_not_wait_for_a_late_answer(runtime):
    line, modbus = on(runtime)
    with pytest.raises(DeadlineExceeded):
        read(modbus, unit=2)
    began_ns = runtime.now_ns()
    modbus.post(WRITE, 1, TIMEOUT_S)
    runtime.run_for(0.01)
    assert line.sent[-1][0] - began_ns < MS


@pytest.mark.parametrize(("framing", "waits"), [("rtu", True), ("tcp", False)])
def test_answer_to_a_program_that_died_is_waited_for(runtime, tmp_path, framing, waits):
    dead, lock = (ProcessLock("line", "the line", LockDirectory(tmp_path)) for _ in range(2))
    dead.acquire(runtime, "an exchange on the line")
    dead.abandon()
    answers = {"rtu": rtu(7), "tcp": tcp(1, b"\3\2\0\7")}
    line = Line(runtime, framing, lambda line, _: line.hear_after(MS / 1e9, answers[framing]))
    client = ModbusLine(line, runtime, lock)
    line.hear_after(0.1, rtu(5))
    begun_ns = runtime.now_ns()
    assert read(client) == [7]
    waited_ns = line.sent[0][0] - begun_ns
    assert waited_ns == (ModbusLine.QUARANTINE_NS if waits else line.silence_ns)
    client.close()


@pytest.mark.parametrize("late_s", [0.21, 0.25], ids=["before", "after"])
def test_late_answer_around_a_posted_one_is_not_the_next(runtime, late_s):
    def answer(line, number):
        if number == 1:
            line.hear_after(late_s, rtu(1111))
        elif number == 2:
            line.hear_after(0.02, with_crc(bytes.fromhex("01 06 0010 0005")))
        else:
            line.hear_after(NEXT_S, rtu(2222))

    _, modbus = on(runtime, answer)
    with pytest.raises(DeadlineExceeded):
        read(modbus)
    stop = modbus.post(WRITE, 1, TIMEOUT_S)
    runtime.run_for(0.022)
    assert stop.is_over
    assert stop.error is None
    assert read(modbus) == [2222]
    assert modbus.strays == 1


def test_request_behind_many_unanswered_ones_gets_its_turn(runtime):
    def answer(line, number):
        if line.sent[-1][1][0] == 9:
            line.hear_after(0.01, rtu(7, unit=9))

    _, modbus = on(runtime, answer)
    told = []

    def ask(unit):
        try:
            told.append(read(modbus, unit))
        except DeadlineExceeded:
            told.append(None)

    parties = [runtime.spawn(f"unit {unit}", lambda unit=unit: ask(unit)) for unit in range(1, 10)]
    for party in parties:
        assert party.join(20.0)
    assert told == [*[None] * 8, [7]]


def test_unexpected_line_failure_raises_link_error(runtime):
    def unplugged(line, number):
        raise OSError("unplugged")

    _, modbus = on(runtime, unplugged)
    for _ in range(2):
        with pytest.raises(LinkError, match="cannot send: unplugged"):
            read(modbus)


def cut(line):
    line.is_closed = True
    line.hear(b"")


def unplug(line):
    raise LinkError(link="line", reason="cannot send")


@pytest.mark.parametrize(
    ("trouble", "errors"),
    [
        (cut, [LinkError]),
        (unplug, [LinkError]),
        (lambda line: line.hear(tcp(1, b"\x03\x02\x00\x07")[:5]), [ModbusProtocolViolation]),
        (lambda line: line.hear(tcp(1, b"\x03\x02\x00\x07")[:9]), [ModbusProtocolViolation]),
        (lambda line: None, [DeadlineExceeded] * 10),  # 2 s
    ],
    ids=["ended", "cannot send", "half a header", "half an answer", "silent"],
)
def test_broken_tcp_connection_is_replaced(runtime, trouble, errors):
    def answer(line, number):
        if line.connections == 1:
            trouble(line)
        else:
            line.hear(tcp(number, b"\x03\x02\x00\x07"))

    connection = Connection(runtime, "tcp", answer)
    line = ModbusLine(connection, runtime, None)
    for error in errors:
        with pytest.raises(error):
            read(line)
    assert connection.connections == 1
    assert [read(line), read(line)] == [[7], [7]]
    assert (connection.connections, line.reconnections) == (2, 1)
    assert len(connection.sent) == len(errors) + 2  # no request twice


@pytest.mark.parametrize("trouble", [cut, unplug], ids=["ended", "cannot send"])
def test_unplugged_serial_line_is_opened_anew(runtime, trouble):
    def answer(line, number):
        if line.connections == 1:
            trouble(line)
        else:
            line.hear(rtu(7))

    connection = Connection(runtime, "rtu", answer)
    line = ModbusLine(connection, runtime, None)
    with pytest.raises(LinkError):
        read(line)
    assert [read(line), read(line)] == [[7], [7]]
    assert line.reconnections == 1
    assert len(connection.sent) == 3  # no request twice


def test_malformed_answer_is_logged_but_not_printed(runtime, monkeypatch, capsys, caplog):
    answer = tcp(1, b"\x03\x04\x00")  # four bytes announced, one sent
    with monkeypatch.context() as patch:
        patch.setattr(logging.root, "handlers", [])  # a program that has not configured logging
        _, line = on(runtime, lambda line, number: line.hear(answer), framing="tcp")
        with pytest.raises(ModbusProtocolViolation, match="03 04 00"):
            read(line)
        assert capsys.readouterr().err == ""
    _, line = on(runtime, lambda line, number: line.hear(tcp(1, b"\x03\x08\x00")), framing="tcp")
    with pytest.raises(ModbusProtocolViolation):
        read(line)
    assert "decode" in caplog.text


def test_late_answer_shows_that_a_connection_is_not_broken(runtime):
    """As of a gateway that waits for its unit longer than we do."""

    def answer(line, number):
        if number <= 12:
            line.hear_after(1.0, tcp(number, b"\x83\x0b"))
        else:
            line.hear(tcp(number, b"\x03\x02\x00\x07"))

    connection = Connection(runtime, "tcp", answer)
    line = ModbusLine(connection, runtime, None)
    for _ in range(12):
        with pytest.raises(DeadlineExceeded):
            read(line)
    assert read(line) == [7]
    assert connection.connections == 1


def test_refused_connection_raises_link_error_and_sends_nothing(runtime):
    connection = Connection(runtime, "tcp", lambda line, number: cut(line))
    line = ModbusLine(connection, runtime, None)
    with pytest.raises(LinkError, match="has ended"):
        read(line)
    connection.is_refused = True
    with pytest.raises(LinkError, match="no connection"):
        read(line)
    assert len(connection.sent) == 1
    connection.is_refused = False
    with pytest.raises(LinkError, match="has ended"):
        read(line)
    assert (len(connection.sent), connection.connections) == (2, 2)


def test_answer_in_pieces_does_not_break_a_connection(runtime):
    def answer(line, number):
        adu = tcp(number, b"\x03\x02\x00\x07")
        line.hear(adu[:5])
        line.hear_after(NEXT_S, adu[5:])

    connection = Connection(runtime, "tcp", answer)
    line = ModbusLine(connection, runtime, None)
    assert [read(line), read(line)] == [[7], [7]]
    assert connection.connections == 1
