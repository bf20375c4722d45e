"""Programs in processes of their own, on gateways and serial ports of a rig."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.harness.shared_time import records
from motorhil.harness.shared_time.participant import Participant
from motorhil.harness.shared_time.programs import run_programs
from motorhil.traces.digest import digest
from tests.support.modbus.rigs import text
from tests.support.programs.c_programs import compiled, needs_compiler

pytestmark = pytest.mark.wall

UNMODIFIED = Path(__file__).parents[3] / "support" / "programs" / "unmodified"
WHERE = {"tcp": ("tcp", "line", "502"), "rtu": ("rtu", "/dev/line", "115200")}
MOVED = {  # as in one process: tests/unit/harness/virtual_time/stdlib/test_lines.py
    "tcp": ["move: 0.1021 s: 4940", "move: 0.2042 s: 5000"],
    "rtu": ["move: 0.1070 s: 4990", "move: 0.2140 s: 5000"],
}
PLANT = 'address = "plant:'
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

    def run(line="", rig_text="", **commands):
        rig_text = rig_text or text(line=line, names=("mast", "head"))
        for name, command in commands.items():
            words = ", ".join(f"'{word}'" for word in command)
            rig_text += f"\n[program.{name}]\ncommand = [{words}]\n"
        (tmp_path / "rig.toml").write_text(rig_text)
        lines = []
        with Rig.open(tmp_path / "rig.toml", record=tmp_path / "run.mcap") as rig:
            wrong = run_programs(rig, lines.append)
        return lines, wrong, digest(tmp_path / "run.mcap")

    return run


def sent_bytes(monkeypatch):
    """Return a list that gets the number of characters in each record of a program."""
    sent = []
    submit = Participant._submit

    def counted(participant, record):
        sent.append(len(record) - records.NUMBERED.size)
        submit(participant, record)

    monkeypatch.setattr(Participant, "_submit", counted)
    return sent


def test_many_characters_of_a_python_program_arrive(run, tmp_path, monkeypatch):
    sent = sent_bytes(monkeypatch)
    (tmp_path / "many.py").write_text(
        'import os\nfd = os.open("/dev/line", os.O_RDWR)\nprint(os.write(fd, bytes(70_000)))\n'
    )
    lines, wrong, _ = run("rtu", many=["python", "many.py"])
    assert (lines, wrong) == (["many: 70000"], {})
    assert sum(sent) == 70_000


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


# ---- binaries ------------------------------------------------------------------------------------

ANSWER = {  # read register 1003h of unit 1, a drive at rest: see test_lines.py
    "tcp": "00 07 00 00 00 05 01 03 02 00 30 after",
    "rtu": "01 03 02 00 30 B8 50 after",
}
# Latencies and reply_s; 15 characters, t3.5 and reply_s. Clocks add a microsecond a look.
TIMES_US = {"tcp": 50 + 2_000 + 50, "rtu": 15 * 10**7 // 115_200 + 1_750 + 2_000}


def time_of(line):
    return int(re.search(r"after (\d+) us", line)[1])


@needs_compiler
@pytest.mark.parametrize("line", ["tcp", "rtu"])
@pytest.mark.parametrize(
    "act",
    [
        *("block", "poll", "select", "epoll", "timeout", "limited", "vtime", "drain", "reopen"),
        "early",
    ],
)
def test_plain_c_client_has_answer_of_drive_after_its_times(run, tmp_path, line, act):
    if act in {"tcp": ("vtime", "drain"), "rtu": ("timeout", "limited", "early")}[line]:
        pytest.skip("of the other kind of line")
    lines, wrong, _ = run(line, a=[compiled("line_client", tmp_path), act, *WHERE[line]])
    assert wrong == {}, lines
    if act == "drain":
        sent_us = 8 * 10**7 // 115_200
        assert lines[0].startswith("a: 8 characters sent after")
        assert sent_us <= time_of(lines[0]) < sent_us + 10
        assert time_of(lines[1]) == pytest.approx(TIMES_US[line] - sent_us, abs=10)
        return
    assert lines[0].startswith(f"a: {ANSWER[line]}")
    assert TIMES_US[line] <= time_of(lines[0]) < TIMES_US[line] + 10
    if act == "vtime":  # 0.2 s
        assert lines[1].startswith("a: read: 0 after")
        assert 200_000 <= time_of(lines[1]) < 200_010
    if act in ("timeout", "limited"):
        assert lines[1].startswith("a: recv: -1, 1 after")
        assert 200_000 <= time_of(lines[1]) < 200_010


@needs_compiler
@pytest.mark.parametrize(
    ("act", "line", "where", "end", "told"),
    [
        ("foreign", "tcp", None, None, ["a: read: 0, write: -1, Broken pipe"]),
        ("kill", "tcp", None, "ended by SIGKILL", ["has left the rig: its connection has ended"]),
        (
            "flood",
            "tcp",
            None,
            "exit status 3",
            ["has left the rig", "characters wait"],
        ),
        (
            *("block", "tcp", ("tcp", "127.0.0.1", "502"), "exit status 4"),
            ["hardware cannot be reached", "(its lines: line at line:502)", "connect: No route"],
        ),
        (
            *("block", "rtu", ("rtu", "/dev/ttyUSB7", "0"), "exit status 4"),
            [
                "hardware cannot be reached",
                "(its lines: line at /dev/line)",
                "open: No such",
            ],
        ),
        ("slow", "rtu", None, None, ["opened with 9600 bit/s, 8N1; line line has 115200 bit/s"]),
    ],
)
def test_hostile_c_client_is_told_by_name(run, tmp_path, act, line, where, end, told):
    program = compiled("line_client", tmp_path)
    lines, wrong, _ = run(line, a=[program, act, *(where or WHERE[line])])
    assert wrong == ({} if end is None else {"a": end}), lines
    for part in told:
        assert any(part in one for one in lines), lines


@needs_compiler
def test_request_of_a_c_client_before_its_close_is_carried_out(run, tmp_path):
    program = compiled("line_client", tmp_path)
    lines, wrong, _ = run("tcp", a=[program, "close", *WHERE["tcp"]])
    assert wrong == {}, lines
    assert lines == ["a: 11 bytes, speed 123, write: -1, Broken pipe"]


@needs_compiler
def test_characters_in_the_turn_of_a_new_thread_arrive(run, tmp_path, monkeypatch):
    sent = sent_bytes(monkeypatch)
    lines, wrong, _ = run("rtu", a=[compiled("line_client", tmp_path), "thread", *WHERE["rtu"]])
    assert wrong == {}, lines
    assert lines == ["a: written: 5000"]
    assert sum(sent) == 5000


@needs_compiler
@pytest.mark.parametrize("port", ["502", "503"])
def test_gateways_of_one_host_have_a_port_each(run, tmp_path, port):
    program = compiled("line_client", tmp_path)
    rig_text = text(line="tcp").replace("[bus.line]", f'[bus.line]\n{PLANT}{port}"')
    other = f'[bus.other]\nkind = "modbus_tcp"\n{PLANT}{1005 - int(port)}"\n'
    lines, wrong, _ = run(rig_text=other + rig_text, a=[program, "block", "tcp", "plant", port])
    assert wrong == {}, lines
    assert lines[0].startswith(f"a: {ANSWER['tcp']}")


@needs_compiler
def test_socket_that_connects_elsewhere_is_told_once_connected(run, tmp_path):
    lines, wrong, _ = run("tcp", a=[compiled("line_client", tmp_path), "elsewhere", *WHERE["tcp"]])
    assert wrong == {}, lines
    assert lines[0] == "a: in a set"
    assert "a socket of the network, which has the time of the wall" in lines[1]


@needs_compiler
def test_c_and_python_clients_share_a_gateway_twice_the_same(run, tmp_path):
    client = [compiled("line_client", tmp_path), "poll", *WHERE["tcp"]]
    runs = [run("tcp", a=client, b=client, move=python("modbus_move", "tcp")) for _ in range(2)]
    lines, wrong, _ = runs[0]
    assert wrong == {}
    assert [one for one in lines if one.startswith("move")] == MOVED["tcp"]
    assert sum(ANSWER["tcp"] in one for one in lines) == 2
    assert runs[1] == runs[0]
