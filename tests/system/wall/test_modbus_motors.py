"""Modbus motors on the wall clock, served and recorded."""

import socket
import sys
from pathlib import Path

import pytest

from motorhil.motorapi.errors import LinkError, UsageError
from motorhil.motorapi.runtime.byte_streams import SerialLine, TcpLine
from motorhil.traces.mcap.reader import read_trace
from tests.system.wall.test_serve import motorhil

pytestmark = pytest.mark.wall

PROGRAM = str(Path(__file__).parents[2] / "support" / "programs" / "modbus_mast.py")
RIG = """
[rig]
[bus.line]
kind = "modbus_{kind}"
{settings}
[controller.mast]
kind = "leadshine_pr"
bus = "line"
unit = 1
plant = {{ preset = "mast_20w" }}
"""
SETTINGS = {"tcp": "", "rtu": 'baud_bit_s = 115_200\nparity = "N"'}


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@pytest.mark.parametrize("kind", ["tcp", "rtu"])
def test_program_moves_a_served_drive_and_all_adus_are_recorded(tmp_path, kind):
    rig, record = tmp_path / "rig.toml", tmp_path / "out.mcap"
    rig.write_text(RIG.format(kind=kind, settings=SETTINGS[kind]))
    where = f"127.0.0.1:{free_port()}" if kind == "tcp" else str(tmp_path / "tty")
    words = ["serve", str(rig), f"--modbus-{kind}", f"line={where}", "-o", str(record)]
    done = motorhil(*words, "--", sys.executable, PROGRAM, kind, where)
    assert (done.stderr, done.returncode) == ("", 0)
    assert done.stdout.split() == ["0.30", "0.20"]
    with read_trace(record) as trace:
        adus = sum(channel.topic == "/modbus/line" for channel, _, _ in trace.messages())
    assert adus > 20
    assert not Path(where).exists()


def test_missing_peer_is_named(tmp_path):
    port = free_port()
    with pytest.raises(LinkError, match=f"127.0.0.1:{port}: no connection"):
        TcpLine("127.0.0.1", port)
    with pytest.raises(LinkError, match="cannot be opened"):
        SerialLine(str(tmp_path / "tty"))
    with pytest.raises(UsageError, match="invalid setting"):
        SerialLine("/dev/null", parity="X")
