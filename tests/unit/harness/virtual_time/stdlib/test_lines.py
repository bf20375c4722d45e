"""Connections and serial ports of unmodified programs on the lines of a rig."""

import asyncio
import fcntl
import io
import os
import select
import selectors
import socket
import struct
import subprocess
import sys
import termios
import threading
import time
import tty
from contextlib import contextmanager
from pathlib import Path

import pytest
import serial

from motorhil.harness.virtual_time.stdlib.install import in_virtual_time
from motorhil.motorapi.errors import UsageError
from motorhil.traces.digest import digest
from tests.support.modbus.rigs import opened, text

HERE = Path(__file__).parents[4] / "support" / "programs" / "unmodified"
# MODBUS Messaging on TCP/IP V1.0b, 4.2, and MODBUS over Serial Line V1.02: read register 1003h of
# unit 1. The status of a Leadshine drive at rest: path and command completed (manual, 1003h).
PDU = bytes.fromhex("03 1003 0001")
REQUEST = bytes.fromhex("0007 0000 0006 01") + PDU
ANSWER = bytes.fromhex("0007 0000 0005 01 03 02 0030")
RTU_REQUEST = b"\x01" + PDU + bytes.fromhex("70CA")
RTU_ANSWER = bytes.fromhex("01 03 02 0030 B850")
CHARACTER_NS = 10 * 10**9 // 115_200  # start bit, 8 data bits, stop bit
T35_S = 1.750e-3  # MODBUS over Serial Line V1.02, 2.5.1.1: above 19200 bit/s
BOOTED_S = 1.0


@contextmanager
def rig_of(line, more=""):
    """Return a rig with one drive on a line, booted, within virtual time."""
    place = "bus.line]\n"
    with opened(text(line=line).replace(place, place + more)) as rig, in_virtual_time(rig):
        time.sleep(BOOTED_S)
        yield rig


@pytest.fixture
def gateway():
    with rig_of("tcp", 'address = "192.0.2.7:5020"\n') as rig:
        yield rig


@pytest.fixture
def wires():
    with rig_of("rtu") as rig:
        yield rig


def connection(timeout_s=None):
    return socket.create_connection(("192.0.2.7", 5020), timeout_s)


def since_s(rig):
    return rig.runtime.now_ns() / 1e9 - BOOTED_S


# ---- whole programs ------------------------------------------------------------------------------

MOVED = {
    "tcp": "0.1021 s: 4940\n0.2042 s: 5000\n",  # 2 ms of the drive, 100 us of the network
    "rtu": "0.1070 s: 4990\n0.2140 s: 5000\n",
}
POLLED = {
    "tcp": [1.002, 1.004, 1.104, 1.106, 1.206, 1.208],
    "rtu": [1.005, 1.012, 1.110, 1.117, 1.215, 1.222],
}
LAST = {"tcp": "11\n", "rtu": "1.822 s: ModbusIOException\n"}  # 0Bh, or nothing for 0.5 s
WHERE = {"tcp": ("tcp", "line", "502"), "rtu": ("rtu", "/dev/line", "115200")}


@pytest.mark.parametrize("line", ["tcp", "rtu"])
def test_pymodbus_programs_give_equal_records_in_each_process(tmp_path, line):
    rig = tmp_path / "rig.toml"
    rig.write_text(text(line=line, names=("mast", "head")))
    polled = "".join(
        f"{at_s:.3f} s: unit {1 + place % 2}: [48]\n" for place, at_s in enumerate(POLLED[line])
    )
    for name, said in (("modbus_move", MOVED[line]), ("modbus_async", polled + LAST[line])):
        digests = []
        for seed in ("1", "2"):
            record = tmp_path / f"{name}{seed}.mcap"
            words = ("run", rig, HERE / f"{name}.py", "-o", record, "--", *WHERE[line])
            done = subprocess.run(
                [sys.executable, "-m", "motorhil", *map(str, words)],
                env={**os.environ, "PYTHONHASHSEED": seed},
                capture_output=True,
                text=True,
                check=False,
            )
            assert (done.returncode, done.stdout) == (0, said), done.stderr
            digests.append(digest(str(record)))
        assert digests[0] == digests[1]


# ---- gateways ------------------------------------------------------------------------------------


def by_blocking_recv(own):
    own.settimeout(None)
    return own.recv(64)


def by_timed_recv(own):
    own.settimeout(0.5)
    return own.recv(64)


def by_select(own):
    own.setblocking(False)
    assert select.select([own], [], [], 0.5)[0] == [own]
    return own.recv(64)


def by_selector(own):
    with selectors.DefaultSelector() as selector:
        selector.register(own, selectors.EVENT_READ)
        assert selector.select(0.5)
    return own.recv(64)


def by_file(own):
    with own.makefile("rb", buffering=0) as file:
        return file.read(64)


@pytest.mark.parametrize(
    "receive", [by_blocking_recv, by_timed_recv, by_select, by_selector, by_file]
)
def test_answer_of_drive_arrives_after_its_times(gateway, receive):
    with connection() as own:
        own.sendall(REQUEST)
        assert since_s(gateway) == 0.0
        assert receive(own) == ANSWER
    # latency_s, and the drive's reply_s
    assert since_s(gateway) == pytest.approx(50e-6 + 0.002 + 50e-6, abs=1e-9)


def test_receive_times_out_in_the_rigs_time(gateway):
    with connection(0.25) as own, pytest.raises(TimeoutError):
        own.recv(64)
    assert since_s(gateway) == pytest.approx(0.25, abs=1e-6)


def test_asyncio_streams_exchange_with_gateway(gateway):
    async def ask():
        reader, writer = await asyncio.open_connection("192.0.2.7", 5020)
        assert writer.get_extra_info("peername") == ("192.0.2.7", 5020)
        writer.write(REQUEST)
        answer = await reader.readexactly(len(ANSWER))
        writer.close()
        await writer.wait_closed()
        return answer

    assert asyncio.run(ask()) == ANSWER


def test_two_connections_are_served_in_order_of_requests(gateway):
    with connection() as one, connection() as other:
        other.sendall(REQUEST)
        one.sendall(REQUEST)
        assert select.select([one, other], [], [])[0] == [other]
        assert one.recv(64) == other.recv(64) == ANSWER


def test_gateway_closes_connection_with_foreign_bytes(gateway):
    with connection() as own:
        own.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert own.recv(64) == b""
        with pytest.raises(BrokenPipeError):
            own.send(REQUEST)


def endpoints(rig):
    return [one.name for one in rig.world.line("line").endpoints]


def test_connection_ends_when_its_last_descriptor_is_closed(gateway):
    own = connection()
    copy = own.dup()
    own.close()
    time.sleep(0.01)
    assert endpoints(gateway) == ["mast", "host"]
    copy.sendall(REQUEST)
    assert copy.recv(64) == ANSWER
    copy.close()
    time.sleep(0.01)
    assert endpoints(gateway) == ["mast"]


def test_answer_arrives_after_the_end_of_writing(gateway):
    with connection(1.0) as own:
        own.sendall(REQUEST)
        own.shutdown(socket.SHUT_WR)
        assert own.recv(64) == ANSWER
        with pytest.raises(BrokenPipeError):
            own.send(REQUEST)
        assert endpoints(gateway) == ["mast", "host"]
    time.sleep(0.01)
    assert endpoints(gateway) == ["mast"]


@pytest.mark.parametrize("way", ["close", "shutdown"])
def test_request_before_a_close_is_carried_out(gateway, way):
    """Write the jog speed, register 01E1h (Leadshine manual), and read it by a new connection."""
    with connection() as own:
        own.sendall(bytes.fromhex("0007 0000 0006 01 06 01E1 007B"))
        if way == "shutdown":
            own.shutdown(socket.SHUT_RDWR)
    with connection(1.0) as own:
        time.sleep(0.01)
        own.sendall(bytes.fromhex("0008 0000 0006 01 03 01E1 0001"))
        assert own.recv(64) == bytes.fromhex("0008 0000 0005 01 03 02 007B")


def test_thread_that_ends_sends_what_it_has_written(gateway):
    with connection() as own:
        thread = threading.Thread(target=os.writev, args=(own.fileno(), [REQUEST]))
        thread.start()
        assert own.recv(64) == ANSWER
        thread.join()


def test_socket_has_addresses_and_options_of_tcp(gateway):
    with connection() as own:
        assert own.getpeername() == ("192.0.2.7", 5020)
        assert own.getsockname()[0] == "127.0.0.1"
        own.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        assert own.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == 1
        assert own.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == 0


@pytest.mark.parametrize(
    ("address", "where"),
    [
        ("", ("line", 502)),
        ('address = "localhost:5020"\n', ("127.0.0.1", 5020)),
        ('address = "127.0.0.1:5020"\n', ("localhost", 5020)),
        ('address = "plant.example:502"\n', ("plant.example", 502)),
        ('address = "[2001:db8::7]:502"\n', ("2001:db8::7", 502)),
    ],
)
def test_gateway_has_address_of_rig_file(address, where):
    with rig_of("tcp", address), socket.create_connection(where) as own:
        own.sendall(REQUEST)
        assert own.recv(64) == ANSWER


def test_connection_to_hardware_is_refused_by_name(gateway):
    with (
        socket.socket() as own,
        pytest.raises(
            UsageError,
            match=r"socket.connect .* 192.0.2.8:502: hardware .* \(its lines: line at"
            r' 192.0.2.7:5020\); write address = "192.0.2.8:502" in its \[bus.NAME\]',
        ),
    ):
        own.connect(("192.0.2.8", 502))


def test_unread_answers_are_kept_up_to_a_limit(gateway, capsys):
    question = bytes.fromhex("0007 0000 0006 01 03 6200 0064")  # 100 registers
    answer_size = 6 + 3 + 200
    with connection() as own:
        for _ in range(3_000):
            own.sendall(question)
            time.sleep(0.003)
        received = 0
        while select.select([own], [], [], 0.1)[0]:
            received += len(own.recv(65_536))
    assert received % answer_size == 0
    assert 65_536 <= received < 3_000 * answer_size
    told = "motorhil: 192.0.2.7:5020: more than 65536 characters are not read; the others are lost"
    assert capsys.readouterr().err.splitlines() == [told]


# ---- serial ports --------------------------------------------------------------------------------


@contextmanager
def port(flags=os.O_NONBLOCK):
    fd = os.open("/dev/line", os.O_RDWR | os.O_NOCTTY | flags)
    try:
        yield fd
    finally:
        os.close(fd)


def test_characters_take_their_time_on_the_wires(wires):
    with port() as fd:
        assert os.write(fd, RTU_REQUEST) == 8
        answer = b""
        while len(answer) < len(RTU_ANSWER):
            assert select.select([fd], [], [], 0.5)[0] == [fd]
            answer += os.read(fd, 64)
    assert answer == RTU_ANSWER
    # 8 characters, t3.5, the drive's reply_s, 7 characters
    expected_s = (15 * CHARACTER_NS) / 1e9 + T35_S + 0.002
    assert since_s(wires) == pytest.approx(expected_s, abs=2e-6)


def test_blocking_read_waits_for_characters(wires):
    with port(0) as fd:
        os.write(fd, RTU_REQUEST)
        assert os.read(fd, 64) == RTU_ANSWER


def test_write_waits_for_silence_after_the_answer(wires):
    with port(0) as fd:
        os.write(fd, RTU_REQUEST)
        assert os.read(fd, 64) == RTU_ANSWER
        heard_s = since_s(wires)
        os.write(fd, RTU_REQUEST)
        assert since_s(wires) == pytest.approx(heard_s + T35_S, abs=1e-9)
        assert os.read(fd, 64) == RTU_ANSWER


def test_drain_waits_until_the_last_character_is_sent(wires):
    with port() as fd:
        os.write(fd, bytes(100))
        unsent = struct.unpack("I", fcntl.ioctl(fd, termios.TIOCOUTQ, bytes(4)))
        assert unsent == (100,)
        termios.tcdrain(fd)
        assert since_s(wires) == pytest.approx(100 * CHARACTER_NS / 1e9, abs=1e-7)


def test_flush_drops_what_was_received(wires):
    with port() as fd:
        os.write(fd, RTU_REQUEST)
        time.sleep(0.1)
        assert struct.unpack("I", fcntl.ioctl(fd, termios.FIONREAD, bytes(4))) == (7,)
        termios.tcflush(fd, termios.TCIFLUSH)
        assert struct.unpack("I", fcntl.ioctl(fd, termios.FIONREAD, bytes(4))) == (0,)


def test_port_is_a_terminal_with_settings(wires, capsys):
    with port() as fd:
        assert os.isatty(fd)
        first = termios.tcgetattr(fd)
        settings = [*first[:2], first[2] | termios.HUPCL, *first[3:]]
        termios.tcsetattr(fd, termios.TCSANOW, settings)
        assert termios.tcgetattr(fd) == settings
        tty.setraw(fd)
        assert not termios.tcgetattr(fd)[3] & (termios.ICANON | termios.ECHO)
        termios.tcsetattr(fd, termios.TCSANOW, first)  # as it was, whatever its bit rate
        signals = struct.unpack("I", fcntl.ioctl(fd, termios.TIOCMGET, bytes(4)))[0]
        assert signals & termios.TIOCM_CTS
        with pytest.raises(OSError, match="not supported"):
            fcntl.ioctl(fd, termios.TIOCGPGRP, bytes(4))
    assert "9600" in capsys.readouterr().err  # tty.setraw keeps the bit rate


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"baudrate": 9_600}, "9600 bit/s, 8N1"),
        ({"parity": "E"}, "115200 bit/s, 8E1"),
        ({"stopbits": 2}, "115200 bit/s, 8N2"),
        ({"bytesize": 7}, "115200 bit/s, 7N1"),
        ({"baudrate": 250_000}, "250000 bit/s, 8N1"),
        ({}, None),
    ],
)
def test_settings_that_the_line_has_not_are_told(wires, capsys, asked, told):
    with serial.Serial("/dev/line", **{"baudrate": 115_200, **asked}, timeout=0.1) as own:
        own.write(RTU_REQUEST)
        own.flush()
        assert own.read(7) == RTU_ANSWER
        assert own.read(1) == b""
    line = (
        f"motorhil: /dev/line: opened with {told}; line line has 115200 bit/s, 8N1, which is used"
    )
    assert capsys.readouterr().err.splitlines() == ([] if told is None else [line])


def test_settings_of_struct_termios2_are_kept(wires, capsys):
    """Linux, asm-generic/termbits.h: c_iflag, ..., c_cc, c_ispeed, c_ospeed."""
    layout = struct.Struct("=4IB19s2I")
    get, put = 0x802C542A, 0x402C542B  # TCGETS2, TCSETS2
    with port() as fd:
        own = bytearray(64)
        assert fcntl.ioctl(fd, get, own) == 0
        *flags, line, controls, _, rate = layout.unpack_from(own)
        assert flags == termios.tcgetattr(fd)[:4]
        assert (controls[termios.VMIN], rate) == (1, 9_600)
        flags[2:] = [flags[2] & ~0o010017 | 0o010000, 0]  # BOTHER; no ICANON, no ECHO
        controls = bytes(19)
        fcntl.ioctl(fd, put, layout.pack(*flags, line, controls, 250_000, 250_000))
        assert fcntl.ioctl(fd, get, bytes(44)) == layout.pack(*flags, 0, controls, *[250_000] * 2)
        assert termios.tcgetattr(fd)[3] == 0
        os.set_blocking(fd, True)
        assert os.read(fd, 1) == b""  # VMIN and VTIME 0
        signals = bytearray(4)
        assert fcntl.ioctl(fd, termios.TIOCMGET, signals) == 0
        assert signals[0] & termios.TIOCM_CTS
        fcntl.ioctl(fd, 0x541F, fcntl.ioctl(fd, 0x541E, bytes(72)))  # as setserial does
    assert capsys.readouterr().err.count("opened with 250000 bit/s, 8N1") == 1


def test_timeout_of_pyserial_is_in_the_rigs_time(wires):
    timeout = serial.serialutil.Timeout(10.0)
    time.sleep(9.9)
    assert not timeout.expired()
    time.sleep(0.2)
    assert timeout.expired()


def test_port_that_is_closed_may_be_opened_again(wires):
    for _ in range(3):
        with serial.Serial("/dev/line", 115_200, timeout=0.1, exclusive=True) as own:
            own.write(RTU_REQUEST)
            assert own.read(7) == RTU_ANSWER
    assert endpoints(wires) == ["mast", "host"]


def test_port_of_hardware_is_refused_by_name(wires):
    with pytest.raises(
        UsageError, match=r"os.open .* /dev/ttyUSB7: hardware .* \(its lines: line at /dev/line\)"
    ):
        serial.Serial("/dev/ttyUSB7")


@pytest.mark.parametrize("mode", ["r+b", "rb+"])
def test_open_gives_an_unbuffered_file_on_the_port(wires, mode):
    with open("/dev/line", mode, buffering=0) as file:
        tty.setraw(file)
        assert file.isatty()
        start_s = time.monotonic()
        assert file.write(RTU_REQUEST) == len(RTU_REQUEST)
        assert b"".join(iter(lambda: file.read(1), b"\x50")) == RTU_ANSWER[:-1]
        least_s = (len(RTU_REQUEST) + len(RTU_ANSWER)) * CHARACTER_NS / 1e9
        assert least_s < time.monotonic() - start_s < 0.1
    with pytest.raises(ValueError, match="closed file"):
        file.fileno()


def test_open_layers_its_files_as_python_does(wires):
    with open("/dev/line", "wb") as out, Path("/dev/line").open("rb", buffering=7) as answers:
        tty.setraw(out)
        tty.setraw(answers)
        out.write(RTU_REQUEST)
        out.flush()
        assert answers.read(8 + 7) == RTU_REQUEST + RTU_ANSWER  # each hears what others send
        with pytest.raises(io.UnsupportedOperation, match="reading"):
            out.raw.read(1)
    with open("/dev/line", "w", encoding="ascii") as text_file:
        assert text_file.line_buffering
    wrong = pytest.raises(ValueError, match="binary mode doesn't take an encoding")
    with wrong, open("/dev/line", "rb", encoding="ascii"):
        pass
    with pytest.raises(io.UnsupportedOperation, match="not seekable"), open("/dev/line", "r+b"):
        pass
    assert len(endpoints(wires)) == 3


def test_descriptor_of_port_becomes_a_file(wires):
    with port(0) as fd, open(fd, "r+b", buffering=0, closefd=False) as file:
        file.write(RTU_REQUEST)
        assert file.read(1) == RTU_ANSWER[:1]
        assert select.select([file], [], [], 1.0)[0] == [file]
        file.close()
        assert os.isatty(fd)


def test_read_of_port_ends_after_vtime(wires):
    with port(0) as fd:
        tty.setraw(fd)
        settings = termios.tcgetattr(fd)
        settings[6][termios.VMIN], settings[6][termios.VTIME] = 0, 3
        termios.tcsetattr(fd, termios.TCSANOW, settings)
        start_s = since_s(wires)
        assert os.read(fd, 1) == b""
        assert since_s(wires) - start_s == pytest.approx(0.3, abs=1e-5)


def test_open_of_hardware_is_refused_by_name(wires):
    for path in ("/dev/ttyUSB7", Path("/dev/ttyACM0")):
        told = rf"open .* {path}: hardware .* line at /dev/line\)"
        with pytest.raises(UsageError, match=told), open(path, "r+b", buffering=0):
            pass


def test_other_files_are_opened_as_ever(wires, tmp_path):
    fd = os.open(tmp_path / "file", os.O_CREAT | os.O_RDWR, 0o600)
    assert os.write(fd, b"7") == 1
    assert not os.isatty(fd)
    os.close(fd)
    assert (tmp_path / "file").read_bytes() == b"7"
    with open(tmp_path / "file", "a") as file, open(os.dup(file.fileno()), "w") as copy:
        assert (file.write("8"), copy.write("9")) == (1, 1)
    assert (tmp_path / "file").read_text() in ("789", "798")
