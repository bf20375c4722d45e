"""Programs in processes of their own: the cost of a wait, against a message between processes.

The peer is the least that a wait can cost: a message to another process and its answer, by the same
kind of socket. Starts of processes are left out: each figure is the difference of two runs.
"""

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.support.programs.c_programs import COMPILER, compiled

_SHORT_S, _LONG_S = 0.5, 3.5
_WAITS_PER_S = 1_000
_MESSAGES = 20_000
_RIG = """
[bus.can0]
bitrate_bit_s = 1_000_000
node = {{ listener = {{ silent = true }} }}

[program.one]
command = [{one}]

[program.two]
command = [{two}]
"""
_JOINED = """
import motorhil
rig = motorhil.join()
for _ in range(int(DURATION_S * 1000)):
    rig.runtime.run_for(0.001)
"""
_SLEEPING = """
import time
for _ in range(int(DURATION_S * 1000)):
    time.sleep(0.001)
"""
_FRAMES = """
import sys
import time

import can

bus = can.Bus(interface="socketcan", channel="can0")
message = can.Message(arbitration_id=1 + len(sys.argv), data=bytes(8), is_extended_id=False)
next_s = time.monotonic()
end_s = next_s + DURATION_S
while next_s < end_s:
    bus.send(message)
    next_s += 0.001
    while (left_s := next_s - time.monotonic()) > 0:
        bus.recv(left_s)
"""


def run() -> Iterator[tuple[str, float, str]]:
    """Yield (name, figure, unit) of each tier."""
    message_us = _message_us()
    yield "a message to another process and its answer", message_us, "us"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        programs = {"runtime.run_for": _JOINED, "time.sleep": _SLEEPING}
        for what, text in programs.items():
            yield from _told(f"two programs, {what} at 1 kHz", _python(folder, text), message_us)
        if shutil.which(COMPILER):
            binary = compiled("ticker", folder)
            commands = {s: [f"'{binary}', '{int(s * 1000)}'"] * 2 for s in (_SHORT_S, _LONG_S)}
            yield from _told(
                "two C programs, nanosleep at 1 kHz", _times(folder, commands), message_us
            )
        per_s = _python(folder, _FRAMES)
        yield "two programs, a frame each at 1 kHz, hears the other's", 1.0 / per_s, "x real time"


def _told(name: str, per_s: float, message_us: float) -> Iterator[tuple[str, float, str]]:
    wait_us = 1e6 * per_s / (2 * _WAITS_PER_S)
    yield name, 1.0 / per_s, "x real time"
    yield "  a wait", wait_us, "us"
    yield "  in messages", wait_us / message_us, "x"


def _python(folder: Path, text: str) -> float:
    """Return the wall time for a second of the rig, with two programs of this text [s]."""
    commands = {}
    for duration_s in (_SHORT_S, _LONG_S):
        path = folder / f"program_{duration_s}.py"
        path.write_text(text.replace("DURATION_S", str(duration_s)))
        commands[duration_s] = [f"'python', '{path}'", f"'python', '{path}', 'second'"]
    return _times(folder, commands)


def _times(folder: Path, commands: dict[float, list[str]]) -> float:
    best = dict.fromkeys(commands, float("inf"))
    for _ in range(2):
        for duration_s, (one, two) in commands.items():
            rig = folder / "rig.toml"
            rig.write_text(_RIG.format(one=one, two=two))
            begin_s = time.perf_counter()
            subprocess.run([sys.executable, "-m", "motorhil", "run", str(rig)], check=True)
            best[duration_s] = min(best[duration_s], time.perf_counter() - begin_s)
    return (best[_LONG_S] - best[_SHORT_S]) / (_LONG_S - _SHORT_S)


def _message_us() -> float:
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    child = os.fork()
    if child == 0:
        here.close()
        while there.recv(64):
            there.send(b"answer")
        os._exit(0)
    there.close()
    begin_s = time.perf_counter()
    for _ in range(_MESSAGES):
        here.send(b"message")
        here.recv(64)
    end_s = time.perf_counter()
    here.close()
    os.waitpid(child, 0)
    return 1e6 * (end_s - begin_s) / _MESSAGES
