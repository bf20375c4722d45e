"""Programs in processes of their own, on gateways and serial ports of a rig."""

import subprocess
import sys
from pathlib import Path

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.harness.shared_time.programs import run_programs
from motorhil.traces.digest import digest
from tests.support.modbus.rigs import text

pytestmark = pytest.mark.wall

UNMODIFIED = Path(__file__).parents[3] / "support" / "programs" / "unmodified"
WHERE = {"tcp": ("tcp", "line", "502"), "rtu": ("rtu", "/dev/line", "115200")}
MOVED = {  # as in one process: tests/unit/harness/virtual_time/stdlib/test_lines.py
    "tcp": ["move: 0.1021 s: 4940", "move: 0.2042 s: 5000"],
    "rtu": ["move: 0.1070 s: 4990", "move: 0.2140 s: 5000"],
}
VICTIM = """
import os, sys, time
from pymodbus.client import ModbusTcpClient
client = ModbusTcpClient("line")
time.sleep(1.0)
client.connect()
print(client.read_holding_registers(0x1003, device_id=1).registers)
client.socket.send(bytes.fromhex("0001 0000 0006 01 03 1003 0001"))
os.kill(os.getpid(), 9)
"""


@pytest.fixture
def run(tmp_path):
    """Return a function that runs programs, by name, and returns (output, failures, digest)."""

    def run(line, **commands):
        rig_text = text(line=line, names=("mast", "head"))
        for name, command in commands.items():
            words = ", ".join(f"'{word}'" for word in command)
            rig_text += f"\n[program.{name}]\ncommand = [{words}]\n"
        (tmp_path / "rig.toml").write_text(rig_text)
        lines = []
        with Rig.open(tmp_path / "rig.toml", record=tmp_path / "run.mcap") as rig:
            wrong = run_programs(rig, lines.append)
        return lines, wrong, digest(tmp_path / "run.mcap")

    return run


def python(name, line):
    return ["python", UNMODIFIED / f"{name}.py", *WHERE[line]]


@pytest.mark.parametrize("line", ["tcp", "rtu"])
def test_program_makes_the_record_of_one_in_the_rigs_process(run, tmp_path, line):
    lines, wrong, record = run(line, move=python("modbus_move", line))
    assert (lines, wrong) == (MOVED[line], {})
    (tmp_path / "alone.toml").write_text(text(line=line, names=("mast", "head")))
    words = ["run", "alone.toml", UNMODIFIED / "modbus_move.py", "-o", "alone.mcap", "--"]
    command = [sys.executable, "-m", "motorhil", *words, *WHERE[line]]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    assert digest(tmp_path / "alone.mcap") == record


def test_two_programs_on_one_gateway_make_one_record(run):
    commands = {name: python(f"modbus_{name}", "tcp") for name in ("move", "async")}
    runs = [run("tcp", **commands) for _ in range(2)]
    lines, wrong, _ = runs[0]
    assert wrong == {}
    assert [one for one in lines if one.startswith("move")] == MOVED["tcp"]
    assert [one for one in lines if one.startswith("async")][-1] == "async: 11"
    assert runs[1] == runs[0]


def test_killed_client_is_told_and_the_other_goes_on(run, tmp_path):
    (tmp_path / "victim.py").write_text(VICTIM)
    commands = {"victim": ["python", "victim.py"], "move": python("modbus_move", "tcp")}
    runs = [run("tcp", **commands) for _ in range(2)]
    lines, wrong, _ = runs[0]
    assert wrong == {"victim": "ended by SIGKILL"}
    assert lines == [
        *("victim: [48]", "program victim: has left the rig: its connection has ended"),
        *MOVED["tcp"],
    ]
    assert runs[1] == runs[0]
