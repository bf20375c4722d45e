"""Third-party binaries on lines of a rig in virtual time: the exchanges are those of real time.

libmodbus (Debian libmodbus-dev and a C compiler) and mbpoll (Debian package); each missing program
is skipped with a message.
"""

import shutil
import subprocess
from pathlib import Path

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.harness.shared_time.programs import run_programs
from motorhil.traces.digest import digest
from tests.support.modbus.capture import exchanged
from tests.support.modbus.libmodbus import SAID, libmodbus_client
from tests.support.modbus.served_plant import LONG_S, RIG, Server

pytestmark = pytest.mark.wall

HOST, PORT, DEVICE = "127.0.0.1", "1502", "/dev/ttyUSB0"
TOPICS = {"tcp": "/modbus/plant", "rtu": "/modbus/rs485"}


def run(folder: Path, words: list[str]) -> tuple[list[str], dict[str, str]]:
    """Run a program in virtual time; return its lines and what was wrong with it."""
    rig_text = RIG.replace("latency_s = 0", f'latency_s = 0, address = "{HOST}:{PORT}"')
    rig_text = rig_text.replace('parity = "N"', f'parity = "N", address = "{DEVICE}"')
    command = ", ".join(f"'{word}'" for word in words)
    (folder / "rig.toml").write_text(f"{rig_text}\n[program.a]\ncommand = [{command}]\n")
    lines: list[str] = []
    with Rig.open(folder / "rig.toml", record=folder / "run.mcap") as rig:
        wrong = run_programs(rig, lines.append)
    return lines, wrong


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> str:
    return libmodbus_client(tmp_path_factory.mktemp("libmodbus"))


@pytest.mark.parametrize("kind", ["tcp", "rtu"])
def test_libmodbus_has_the_exchanges_of_real_time(client, tmp_path, kind):
    virtual = [client, kind, *((HOST, PORT) if kind == "tcp" else (DEVICE, "115200"))]
    digests = set()
    for _ in range(2):
        lines, wrong = run(tmp_path, virtual)
        assert ([line.removeprefix("a: ") for line in lines], wrong) == (SAID, {})
        digests.add(digest(tmp_path / "run.mcap"))
    assert len(digests) == 1
    (tmp_path / "wall").mkdir()
    server = Server(tmp_path / "wall")
    try:
        real = [HOST, str(server.port)] if kind == "tcp" else [str(server.link), "115200"]
        subprocess.run([client, kind, *real], timeout=LONG_S, check=True, capture_output=True)
    finally:
        server.stop()
    exchanges = [
        [adu[1:] for adu in exchanged(record, TOPICS[kind])]
        for record in (tmp_path / "run.mcap", server.record)
    ]
    assert [adu[1:] for adu in exchanges[0]] == [adu[1:] for adu in exchanges[1]]
    assert len(exchanges[0]) == 16  # eight requests, each answered


@pytest.mark.parametrize("kind", ["tcp", "rtu"])
def test_mbpoll_polls_in_virtual_time(tmp_path, kind):
    if shutil.which("mbpoll") is None:
        pytest.skip("mbpoll is not installed: apt-get install mbpoll")
    how = (
        ["-m", "tcp", "-p", PORT] if kind == "tcp" else ["-m", "rtu", "-b", "115200", "-P", "none"]
    )
    common = ["mbpoll", *how, "-0", "-a", "1", "-o", "10", "-1", "-t", "4"]
    lines, wrong = run(
        tmp_path, [*common, "-r", "25124", HOST if kind == "tcp" else DEVICE, "2", "77"]
    )
    assert wrong == {}, lines
    assert any("Written 2 references." in line for line in lines)
