"""Third-party clients with served units, on TCP and on a pseudo-terminal.

pymodbus (for RTU it needs pyserial), mbpoll (Debian package), libmodbus (Debian libmodbus-dev and a
C compiler); Wireshark (Debian tshark) then reads their exchanges. Each missing program is skipped
with a message.
"""

import asyncio
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from pymodbus import FramerType
from pymodbus.client import (
    AsyncModbusSerialClient,
    AsyncModbusTcpClient,
    ModbusSerialClient,
    ModbusTcpClient,
)
from pymodbus.client.mixin import ModbusClientMixin

from tests.support.modbus.capture import SERVER_PORT, exchanged, to_pcap
from tests.support.modbus.libmodbus import SAID, libmodbus_client
from tests.support.modbus.served_plant import LONG_S, Server

pytestmark = pytest.mark.wall


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    there = Server(tmp_path_factory.mktemp("served"))
    try:
        yield there
    finally:
        there.stop()


def signed(words: list[int]) -> int:
    return int.from_bytes(b"".join(word.to_bytes(2, "big") for word in words), "big", signed=True)


def registers(response) -> list[int]:
    assert not response.isError(), response
    return response.registers


# ---- pymodbus ----


def moves_a_motor(client: ModbusClientMixin, target: int) -> None:
    """Set a path of a PR drive, start it, and wait for the target."""
    # Ramps of a second per 1000 rpm: half a second for observation, also on a busy machine.
    path = [1, target >> 16 & 0xFFFF, target & 0xFFFF, 600, 1000, 1000, 0]
    assert not client.write_register(0x000F, 1, device_id=1).isError()
    assert not client.write_registers(0x6200, path, device_id=1).isError()
    assert registers(client.read_holding_registers(0x6200, count=7, device_id=1)) == path
    assert not client.write_register(0x6002, 0x10, device_id=1).isError()
    positions = []
    end_s = time.monotonic() + LONG_S
    while not registers(client.read_holding_registers(0x1003, device_id=1))[0] & 0x20:
        assert time.monotonic() < end_s
        positions.append(
            signed(registers(client.read_holding_registers(0x1014, count=2, device_id=1)))
        )
    assert len(set(positions)) > 5  # live registers
    there = signed(registers(client.read_holding_registers(0x1014, count=2, device_id=1)))
    assert abs(there - target) <= 5


def says_what_it_has_not(client: ModbusClientMixin) -> None:
    assert client.read_holding_registers(0xF000, device_id=1).exception_code == 2
    assert client.read_coils(0, device_id=1).exception_code == 1
    assert client.write_register(0x1003, 0, device_id=1).exception_code == 2  # for the reader
    assert client.diag_query_data(b"\x12\x34", device_id=1).message == b"\x12\x34"
    said = client.read_device_information(read_code=1, object_id=0, device_id=1)
    assert len(said.information) == 3
    read = client.readwrite_registers(
        read_address=0x5C, read_count=2, address=0x5C, values=[0xFFFF, 0xFFF0], device_id=2
    )
    assert signed(registers(read)) == -16


def serial_client(server: Server) -> ModbusSerialClient:
    pytest.importorskip("serial", reason="pyserial is not installed")
    return ModbusSerialClient(
        str(server.link), framer=FramerType.RTU, baudrate=115_200, timeout=LONG_S, retries=0
    )


def test_pymodbus_sync_works_over_tcp(server):
    with ModbusTcpClient("127.0.0.1", port=server.port, timeout=LONG_S, retries=0) as client:
        moves_a_motor(client, 12_345)
        says_what_it_has_not(client)


def test_pymodbus_sync_works_over_pseudo_terminal(server):
    with serial_client(server) as client:
        moves_a_motor(client, -12_345)
        says_what_it_has_not(client)


def test_terminal_may_be_closed_and_opened_again(server):
    for _ in range(3):
        with serial_client(server) as client:
            assert registers(client.read_holding_registers(0x1003, device_id=1))


async def asks_two_at_once(client) -> None:
    """Query both units, as simultaneously as the client can."""
    assert await client.connect()
    try:
        for _ in range(20):
            mast, head = await asyncio.gather(
                client.read_holding_registers(0x620B, count=1, device_id=1),
                client.read_holding_registers(0x5E, count=2, device_id=2),
            )
            assert (registers(mast), signed(registers(head))) == ([60], 1000)
    finally:
        client.close()


def test_pymodbus_async_works_over_tcp(server):
    async def run() -> None:
        client = AsyncModbusTcpClient("127.0.0.1", port=server.port, timeout=LONG_S, retries=0)
        await asks_two_at_once(client)

    asyncio.run(run())


def test_pymodbus_async_works_over_pseudo_terminal(server):
    pytest.importorskip("serial", reason="pyserial is not installed")

    async def run() -> None:
        client = AsyncModbusSerialClient(
            str(server.link), framer=FramerType.RTU, baudrate=115_200, timeout=LONG_S, retries=0
        )
        await asks_two_at_once(client)

    asyncio.run(run())


# ---- mbpoll ----


@pytest.fixture(scope="module")
def mbpoll() -> str:
    found = shutil.which("mbpoll")
    if found is None:
        pytest.skip("mbpoll is not installed: apt-get install mbpoll")
    return found


@pytest.fixture(params=["tcp", "rtu"])
def place(request, server) -> tuple[str, list[str]]:
    if request.param == "tcp":
        return "127.0.0.1", ["-m", "tcp", "-p", str(server.port)]
    return str(server.link), ["-m", "rtu", "-b", "115200", "-P", "none"]


def test_mbpoll_reads_and_writes(mbpoll, place):
    where, how = place
    common = [mbpoll, *how, "-0", "-a", "1", "-o", "10", "-1", "-t", "4"]
    wrote = subprocess.run(
        [*common, "-r", "25124", where, "2", "77"],  # 6224h: path 4, mode and position
        capture_output=True,
        text=True,
        timeout=LONG_S,
        check=False,
    )
    assert wrote.returncode == 0, wrote.stdout + wrote.stderr
    assert "Written 2 references." in wrote.stdout
    read = subprocess.run(
        [*common, "-r", "25124", "-c", "2", where],
        capture_output=True,
        text=True,
        timeout=LONG_S,
        check=False,
    )
    assert read.returncode == 0, read.stdout + read.stderr
    assert [line.split() for line in read.stdout.splitlines() if line.startswith("[")] == [
        ["[25124]:", "2"],
        ["[25125]:", "77"],
    ]


# ---- libmodbus ----


@pytest.fixture(scope="module")
def libmodbus(tmp_path_factory: pytest.TempPathFactory) -> str:
    return libmodbus_client(tmp_path_factory.mktemp("libmodbus"))


@pytest.mark.parametrize("kind", ["tcp", "rtu"])
def test_libmodbus_reads_and_writes(libmodbus, server, kind):
    words = ["127.0.0.1", str(server.port)] if kind == "tcp" else [str(server.link), "115200"]
    done = subprocess.run(
        [libmodbus, kind, *words], capture_output=True, text=True, timeout=200, check=False
    )
    assert done.stdout.split() == SAID, done.stderr
    assert done.returncode == 0


# ---- Wireshark ----


@pytest.fixture(scope="module")
def tshark() -> str:
    found = shutil.which("tshark")
    if found is None:
        pytest.skip("tshark is not installed: apt-get install tshark")
    return found


# The request of libmodbus for the server ID on the serial line: Wireshark 4.0 does not accept RTU
# frames shorter than 5 bytes (nor 0107E222, read exception status).
REPORT_SERVER_ID = bytes.fromhex("0111C02C")


def dissected(tshark: str, path: Path, protocol: str) -> list[list[str]]:
    fields = ("frame.protocols", "_ws.malformed", "_ws.expert.message", "modbus.func_code")
    command = [tshark, "-n", "-r", str(path), "-d", f"tcp.port=={SERVER_PORT},{protocol}"]
    command += ["-o", "mbrtu.crc_verification:TRUE", "-T", "fields"]
    for field in fields:
        command += ["-e", field]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=True)
    return [line.split("\t") for line in done.stdout.splitlines()]


def test_wireshark_reads_every_exchange_without_error(tshark, server, tmp_path):
    with ModbusTcpClient("127.0.0.1", port=server.port, timeout=LONG_S, retries=0) as client:
        says_what_it_has_not(client)  # to have an exchange if this test runs alone
    server.stop()
    for topic, protocol in (("/modbus/plant", "mbtcp"), ("/modbus/rs485", "mbrtu")):
        adus = exchanged(server.record, topic)
        to_pcap(adus, tmp_path / f"{protocol}.pcap")
        rows = dissected(tshark, tmp_path / f"{protocol}.pcap", protocol)
        assert len(rows) == len(adus)
        wrong = [
            (row, adu[3].hex())
            for row, adu in zip(rows, adus, strict=True)
            if (protocol not in row[0] or "modbus" not in row[0] or row[1] or not row[3])
            and adu[3] != REPORT_SERVER_ID
        ]
        assert wrong == []
        assert {row[2] for row in rows} <= {"", "Exception returned"}
    assert len(exchanged(server.record, "/modbus/plant")) > 10


def test_wireshark_detects_planted_wrong_crc(tshark, tmp_path):
    to_pcap([(0, "host", True, bytes.fromhex("010300000001840B"))], tmp_path / "crc.pcap")
    ((_, malformed, message, _),) = dissected(tshark, tmp_path / "crc.pcap", "mbrtu")
    assert malformed or "CRC" in message
