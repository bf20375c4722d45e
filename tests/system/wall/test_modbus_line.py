"""Threads of one process on a shared Modbus line."""

import socket
import threading

import pytest

from motorhil.motorapi.adaptations.modbus.client import ModbusLine
from motorhil.motorapi.errors import LinkError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.runtime.byte_streams import TcpLine
from motorhil.motorapi.runtime.wall import WallRuntime
from tests.support.modbus.unit_client import UnitClient

pytestmark = pytest.mark.wall

THREADS, EXCHANGES = 3, 5
LONG_S = 60.0  # for a busy machine; without a failure nothing waits for it


def serve(server):
    """Answer each request for one register by its address (MODBUS TCP, MBAP header)."""
    client = server.accept()[0]
    with client:
        heard = b""
        while data := client.recv(4096):
            heard += data
            while len(heard) >= 12:
                request, heard = heard[:12], heard[12:]
                answer = request[6:7] + b"\x03\x02" + request[8:10]
                client.sendall(request[:4] + len(answer).to_bytes(2, "big") + answer)


class SlowLock:
    """A lock between processes that takes some time, as one with system calls may."""

    def __init__(self, lock):
        self.lock = lock
        self.met = threading.Event()
        self.inside = 0

    def acquire(self, *args):
        self.inside += 1
        if self.inside > 1:
            self.met.set()
        self.met.wait(0.01)  # for another thread that would enter as well
        self.inside -= 1
        return self.lock.acquire(*args)


def test_threads_on_a_shared_line_exchange_in_turn(tmp_path):
    runtime = WallRuntime()
    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=serve, args=(server,), daemon=True).start()
        connection = TcpLine("127.0.0.1", server.getsockname()[1], runtime=runtime)
        lock = SlowLock(ProcessLock("line-exchange", "the line", LockDirectory(tmp_path)))
        line = ModbusLine(connection, runtime, lock)
        heard = [[] for _ in range(THREADS)]

        def ask(number):
            client = UnitClient(line, number + 1, LONG_S / 2)
            for count in range(EXCHANGES):
                address = 1000 * number + count
                heard[number] += client.read_holding_registers(address, count=1).registers

        parties = [
            runtime.spawn(f"asks {number}", lambda number=number: ask(number))
            for number in range(THREADS)
        ]
        try:
            assert all(party.join(LONG_S) for party in parties)
            assert [party.error for party in parties] == [None] * THREADS
            expected = [list(range(1000 * n, 1000 * n + EXCHANGES)) for n in range(THREADS)]
            assert heard == expected
            assert not lock.met.is_set()
        finally:
            line.close()
            connection.close()
            runtime.close()


@pytest.mark.parametrize("end", ["ours", "theirs"])
def test_ended_connection_fails_its_request(end):
    """Another request gets a new connection, unless the application has closed its own."""
    runtime = WallRuntime()
    with socket.create_server(("127.0.0.1", 0)) as server:
        connection = TcpLine("127.0.0.1", server.getsockname()[1], runtime=runtime)
        line = ModbusLine(connection, runtime, None)
        other = server.accept()[0]
        asked = runtime.spawn(
            "asks", lambda: UnitClient(line, 1, LONG_S).read_holding_registers(0, count=1)
        )
        assert len(other.recv(12)) == 12
        (connection if end == "ours" else other).close()
        assert asked.join(LONG_S / 2)  # would raise an error of another request
        assert isinstance(asked.error, LinkError)
        assert runtime.wait_until(lambda: False, 0.2) is False
        client = UnitClient(line, 1, LONG_S / 2)
        if end == "ours":
            with pytest.raises(LinkError, match="is closed"):
                client.read_holding_registers(7, count=1)
        else:
            threading.Thread(target=serve, args=(server,), daemon=True).start()
            assert client.read_holding_registers(7, count=1).registers == [7]
        line.close()
        connection.close()
        other.close()
        runtime.close()


def test_refused_connection_is_tried_again_each_second():
    runtime = WallRuntime()
    server = socket.create_server(("127.0.0.1", 0))
    connection = TcpLine("127.0.0.1", server.getsockname()[1], runtime=runtime)
    line = ModbusLine(connection, runtime, None)
    client = UnitClient(line, 1, LONG_S / 2)
    server.accept()[0].close()
    server.close()
    assert runtime.wait_until(lambda: connection.is_closed, LONG_S)
    reasons = []
    while not reasons or "last attempt" not in reasons[-1]:
        with pytest.raises(LinkError) as caught:
            client.read_holding_registers(7, count=1)
        reasons.append(str(caught.value))
    assert any("no connection (" in reason for reason in reasons)
    line.close()
    connection.close()
    runtime.close()
