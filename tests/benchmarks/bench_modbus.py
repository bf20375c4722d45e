"""Modbus figures: served TCP controller compared with pymodbus, and RTU cycle times.

Both servers run in processes of their own, ours on compiled cores if there are any. They answer the
same request of the same client alternately. The request reads 2 registers, one of which changes
(ours: a drive's feedback position; theirs: a counting action).
"""

import socket
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from time import perf_counter

from pymodbus.client import ModbusTcpClient

from motorhil.emulators.media.serial_line import SerialLine
from motorhil.emulators.modbus.rtu import with_crc
from motorhil.emulators.modbus.tcp import adu
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from tests.unit.emulators.simulation.test_lines import Registers

ROUNDS = 7
REQUESTS = 1500
BAUD = 115_200
RIG = """\
bus.plant = {kind = "modbus_tcp", latency_s = 0}
[controller.mast]
kind = "leadshine_pr"
bus = "plant"
unit = 1
timing = {boot_up_s = 0, reply_s = 0}
"""
COMPILED = Path(__file__).parents[2] / ".venv-compiled" / "bin" / "python"
_MOTORHIL = "import sys; from motorhil.harness.cli.main import main; sys.exit(main())"
Work = Callable[[], list[float]]
"""Asks REQUESTS times, and returns the wall time of each request [s]."""


@contextmanager
def _served() -> Iterator[tuple[int, int]]:
    """Yield (port, address to read) of a drive served by `motorhil serve`."""
    with tempfile.TemporaryDirectory() as folder:
        rig = Path(folder) / "rig.toml"
        rig.write_text(RIG)
        python = COMPILED if COMPILED.exists() else sys.executable
        words = [str(python), "-P", "-c", _MOTORHIL, "serve", str(rig)]
        words += ["--modbus-tcp", "127.0.0.1:0"]
        with _process(words) as said:
            yield int(said.split(":")[2].split(",")[0]), 0x1014


@contextmanager
def _peer() -> Iterator[tuple[int, int]]:
    """Yield (port, address to read) of pymodbus's own server."""
    with _process([sys.executable, "-m", "tests.benchmarks.pymodbus_peer", "300"]) as said:
        yield int(said), 0


@contextmanager
def _process(words: list[str]) -> Iterator[str]:
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        try:
            assert process.stdout is not None
            yield process.stdout.readline()
        finally:
            process.terminate()


def _raw(port: int, address: int) -> Work:
    """Return a raw socket client, which costs almost nothing itself."""
    connection = socket.create_connection(("127.0.0.1", port), timeout=20)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    request = adu(7, 1, b"\x03" + address.to_bytes(2, "big") + b"\x00\x02")

    def ask() -> None:
        connection.sendall(request)
        answer = connection.recv(300)
        assert len(answer) == 13, answer.hex()

    return lambda: _timed(ask)


def _four(port: int, address: int) -> Work:
    """Return four such clients at once, so that the server never has to wait."""
    connections = [socket.create_connection(("127.0.0.1", port), timeout=20) for _ in range(4)]
    request = adu(7, 1, b"\x03" + address.to_bytes(2, "big") + b"\x00\x02")
    for connection in connections:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def work() -> list[float]:
        start_s = perf_counter()
        for connection in connections:
            connection.sendall(request)
        for _ in range(REQUESTS // 4):
            for connection in connections:
                answer = connection.recv(300)
                assert len(answer) == 13, answer.hex()
                connection.sendall(request)
        for connection in connections:
            connection.recv(300)
        return [(perf_counter() - start_s) / REQUESTS] * REQUESTS

    return work


def _pymodbus(port: int, address: int) -> Work:
    """Return pymodbus's sync client."""
    client = ModbusTcpClient("127.0.0.1", port=port, timeout=20, retries=0)
    assert client.connect()

    def ask() -> None:
        assert len(client.read_holding_registers(address, count=2, device_id=1).registers) == 2

    return lambda: _timed(ask)


def _timed(ask: Callable[[], None]) -> list[float]:
    times_s: list[float] = []
    for _ in range(REQUESTS):
        begun_s = perf_counter()
        ask()
        times_s.append(perf_counter() - begun_s)
    return times_s


def _figures(client: Callable[[int, int], Work]) -> Iterator[tuple[float, float]]:
    """Yield (requests per second, 99th percentile [us]) of ours and of the peer.

    Both are medians of alternating rounds.
    """
    with _served() as here, _peer() as there:
        both = client(*here), client(*there)
        for work in both:
            work()
        rounds = [[work() for work in both] for _ in range(ROUNDS)]
    for some in zip(*rounds, strict=True):
        rate = statistics.median(REQUESTS / sum(times_s) for times_s in some)
        late_s = statistics.median(statistics.quantiles(times_s, n=100)[-1] for times_s in some)
        yield rate, late_s * 1e6


def rtu_cycles(count: int = 50) -> tuple[Fraction, Fraction]:
    """Return the time of an exchange in virtual time [us]: (measured mean, computed).

    Computed: 8 characters, t3.5, the reply delay of 1 ms, 9 characters, t3.5; 10 bits each (8N1).
    """
    world = World(EventQueue())
    world.add_serial_line(SerialLine("line", BAUD, "N", 1), None)
    world.add_controller("unit", Registers(1, 1_000_000), "line")
    starts_ns: list[int] = []
    request = with_crc(bytes.fromhex("010300010002"))

    def again(now_ns: int) -> None:
        starts_ns.append(now_ns)
        host.send(request)

    alarm = world.queue.alarm(again)
    silence_ns = SerialLine("other", BAUD, "N", 1).t35_ns
    host = world.add_line_host(
        "line", "host", lambda data, now_ns, sent: None if sent else alarm.set(now_ns + silence_ns)
    )
    alarm.set(1_000_000)
    while len(starts_ns) <= count:
        world.queue.run_next()
    measured = Fraction(starts_ns[-1] - starts_ns[0], 1000 * count)
    computed = Fraction((8 + 9) * 10 * 1_000_000, BAUD) + 2 * 1750 + 1000
    return measured, computed


def run() -> Iterator[tuple[str, float, str]]:
    """Yield the figures as (name, figure, unit)."""
    for name, client in (
        ("a client of bytes", _raw),
        ("four of them", _four),
        ("pymodbus's client", _pymodbus),
    ):
        (ours, our_p99), (theirs, their_p99) = _figures(client)
        yield f"Modbus/TCP, live drive, {name}", ours, "requests/s"
        yield f"pymodbus's own server, live registers, {name}", theirs, "requests/s"
        yield "  ratio", ours / theirs, "x"
        if client is not _four:
            yield "  99th percentile, live drive", our_p99, "us"
            yield "  99th percentile, pymodbus's own server", their_p99, "us"
    measured, computed = rtu_cycles()
    yield "RTU cycle at 115,200 bit/s in virtual time", float(measured), "us"
    yield "  computed from character times", float(computed), "us"
