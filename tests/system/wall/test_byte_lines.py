"""Wall-time lines whose peer accepts nothing: errors instead of endless waits."""

import errno
import os
import pty
import socket
import termios
import threading
import time
import tty

import pytest

from motorhil.motorapi.adaptations.modbus.client import ModbusLine
from motorhil.motorapi.errors import LinkError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.runtime.byte_streams import SerialLine, TcpLine
from motorhil.motorapi.runtime.wall import WallRuntime
from tests.support.modbus.bench import with_crc
from tests.support.modbus.unit_client import UnitClient

pytestmark = pytest.mark.wall

MUCH = bytes(60_000)  # bytes; sent repeatedly, it fills all buffers
TIMES = 400
LONG_S = 60.0  # for a busy machine; without a failure nothing waits for it


def fill(line):
    for _ in range(TIMES):
        line.send(MUCH)


def test_connection_with_an_unread_end_raises_link_error():
    with socket.create_server(("127.0.0.1", 0)) as server:
        line = TcpLine("127.0.0.1", server.getsockname()[1], runtime=WallRuntime())
        began_s = time.monotonic()
        with pytest.raises(LinkError, match="cannot send"):
            fill(line)
        assert time.monotonic() - began_s < LONG_S
        line.close()


def test_blocked_serial_line_raises_link_error():
    master, slave = pty.openpty()
    try:
        line = SerialLine(os.ttyname(slave), runtime=WallRuntime())
        began_s = time.monotonic()
        with pytest.raises(LinkError, match="cannot send"):
            fill(line)
        assert time.monotonic() - began_s < LONG_S
        line.close()
    finally:
        os.close(slave)
        os.close(master)


@pytest.mark.parametrize("call", ["tcgetattr", "tcsetattr", "tcflush"])
def test_device_lost_during_open_raises_with_a_remedy(call, monkeypatch):
    def gone(*args):
        raise termios.error(errno.EIO, "Input/output error")

    master, slave = pty.openpty()
    path = os.ttyname(slave)
    monkeypatch.setattr(termios, call, gone)
    with pytest.raises(
        LinkError, match=rf"^{path}: .*Input/output error.*check that it is plugged in"
    ):
        SerialLine(path, runtime=WallRuntime())
    os.close(slave)
    os.close(master)


def test_unsupported_speed_raises_with_the_settings():
    master, slave = pty.openpty()
    with pytest.raises(LinkError, match=r"with 1099511627776 bit/s, parity E, 1 stop bits \("):
        SerialLine(os.ttyname(slave), baud_bit_s=1 << 40, runtime=WallRuntime())
    os.close(slave)
    os.close(master)


def serve(master):
    """Answer each request for a register by its unit."""
    try:
        while request := os.read(master, 300):
            os.write(master, with_crc(request[:2] + b"\x02\x00" + request[:1]))
    except OSError:
        return


def unplug(master):
    """Answer one request, and end at the next one."""
    os.write(master, with_crc(os.read(master, 300)[:2] + b"\x02\x00\x07"))
    os.read(master, 300)
    os.close(master)


def test_replugged_serial_device_is_opened_anew(tmp_path):
    def plugged_in(life):
        master, slave = pty.openpty()
        tty.setraw(slave)
        threading.Thread(target=life, args=(master,), daemon=True).start()
        (tmp_path / "new").symlink_to(os.ttyname(slave))
        (tmp_path / "new").rename(tmp_path / "port")
        return slave

    runtime = WallRuntime()
    slaves = [plugged_in(unplug)]
    device = SerialLine(str(tmp_path / "port"), baud_bit_s=115_200, parity="N", runtime=runtime)
    line = ModbusLine(device, runtime, None)
    client = UnitClient(line, 5, LONG_S / 2)
    assert client.read_holding_registers(5).registers == [7]
    slaves.append(plugged_in(serve))
    with pytest.raises(LinkError, match="has ended"):
        client.read_holding_registers(5)
    assert client.read_holding_registers(5).registers == [5]
    assert line.reconnections == 1
    line.close()
    device.close()
    with pytest.raises(LinkError, match="is closed"):
        device.reconnect()
    runtime.close()
    for slave in slaves:
        os.close(slave)


def test_two_openers_of_a_device_read_only_their_answers(tmp_path):
    master, slave = pty.openpty()
    tty.setraw(slave)
    threading.Thread(target=serve, args=(master,), daemon=True).start()
    runtime, heard = WallRuntime(), {1: [], 2: []}
    # Both are opened before any request: pyserial's open drops received bytes, also another's
    # answer.
    where = {"path": os.ttyname(slave), "baud_bit_s": 115_200, "parity": "N", "runtime": runtime}
    ports = {unit: SerialLine(**where) for unit in heard}

    def ask(unit):
        port = ports[unit]
        lock = ProcessLock("port-exchange", "the port", LockDirectory(tmp_path))
        line = ModbusLine(port, runtime, lock)
        client = UnitClient(line, unit, LONG_S / 2)
        for _ in range(30):
            heard[unit] += client.read_holding_registers(5).registers
        line.close()
        port.close()

    parties = [runtime.spawn(f"unit {unit}", lambda unit=unit: ask(unit)) for unit in (1, 2)]
    for party in parties:
        assert party.join(LONG_S)
        assert party.error is None
    assert heard == {1: [1] * 30, 2: [2] * 30}
    runtime.close()
    os.close(slave)
    os.close(master)
