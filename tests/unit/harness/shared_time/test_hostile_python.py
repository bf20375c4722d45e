"""Hostile Python programs are told by name, and another program goes on beside them."""

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.harness.shared_time.programs import run_programs

pytestmark = pytest.mark.wall

STALL_S = 0.5
RIG = """
[bus.can0]
bitrate_bit_s = 500_000
node = { listener = { silent = true } }

[program.good]
command = ["python", "good.py"]

[program.bad]
command = ["python", "bad.py"]
stall_s = """
HEAD = """
import os, signal, sys, threading, time
begun_s = time.monotonic()
def tell(*words):
    print(*words, f"at {time.monotonic() - begun_s:.2f}")
with open("pid", "w") as file:
    file.write(str(os.getpid()))
"""
GOOD = """
import time
for _ in range(6):
    time.sleep(1)
print("ends", time.monotonic())
"""
SENDER = """
import os, signal, time
time.sleep(1)
with open("pid") as file:
    pid = int(file.read())
os.kill(pid, signal.{name})
if {ends}:
    while open(f"/proc/{{pid}}/stat").read().rpartition(")")[2].split()[0] != "Z": pass
time.sleep(5)
print("ends", time.monotonic())
"""
ENDS = "good: ends 100006.000001"
KEPT = f"program bad: has kept the turn for {STALL_S} s of wall time"
LEFT = "program bad: has left the rig: its connection has ended"


@pytest.fixture
def run(tmp_path):
    """Return a function that runs a hostile program, and returns its output and its failure."""

    def run(bad, good=GOOD, stall_s=10.0):
        (tmp_path / "rig.toml").write_text(f"{RIG}{stall_s}\n")
        (tmp_path / "bad.py").write_text(HEAD + bad)
        (tmp_path / "good.py").write_text(good)
        lines = []
        with Rig.open(tmp_path / "rig.toml") as rig:
            wrong = run_programs(rig, lines.append)
        assert ENDS in lines, lines
        assert set(wrong) <= {"bad"}
        return lines, wrong.get("bad")

    return run


SPINS_IN_CALLBACK = """
import can, motorhil
rig = motorhil.join()
def spin(*_):
    while True: pass
bus = rig.bus("can0")
rig.runtime.listen(bus, spin)
bus.send(can.Message(arbitration_id=1))
rig.runtime.run_for(1)
"""
SPINS_AT_END = """
try: time.sleep(1)
finally:
    while True: pass
"""
CATCHES_ALL = """
while True:
    try:
        while True: pass
    except BaseException: pass
"""
POLLS = """
while time.monotonic() - begun_s < 2: pass
tell("over")
"""
EXECUTES = """
time.sleep(1)
os.execv(sys.executable, [sys.executable, "-c", "import time; time.sleep(0.1); print('again')"])
"""
STARTS_PROCESS_IN_C = """
os.system("echo started")
time.sleep(1)
tell("end")
"""
EXITS_IN_THREAD = """
threading.Thread(target=os._exit, args=(5,)).start()
time.sleep(2)
"""
LEAVES_IN_THREAD = """
threading.Thread(target=sys.exit, args=(5,)).start()
time.sleep(2)
tell("goes on")
"""
LEAVES_IN_PARTY = """
import motorhil
rig = motorhil.join()
rig.runtime.spawn("p", lambda: os._exit(5))
rig.runtime.run_for(1)
"""
RAISES_IN_CALLBACK = """
import motorhil
rig = motorhil.join()
rig.runtime.every(0.1, lambda: 1 / 0)
rig.runtime.run_for(1)
"""
CLOSES_ALL = """
threading.Thread(target=time.sleep, args=(1,)).start()
os.closerange(3, 256)
time.sleep(1)
"""
ENDS_BEFORE_ITS_THREAD = """
def work():
    time.sleep(2)
    tell("thread")
threading.Thread(target=work).start()
"""
MANY_THREADS = """
name = "n" * 350  # all begin in one turn, and the rig is told each name
threads = [
    threading.Thread(target=time.sleep, args=(1 + n / 200,), name=f"{n} {name}") for n in range(200)
]
for one in threads: one.start()
for one in threads: one.join()
tell("all")
"""
MANY_PARTIES = """
import motorhil
rig = motorhil.join()
parties = [rig.runtime.spawn(str(n), lambda: rig.runtime.run_for(2)) for n in range(200)]
for one in parties: one.join()
tell("all")
"""
TOO_MANY_THREADS = """
threads = [threading.Thread(target=time.sleep, args=(1,), daemon=True) for n in range(1_100)]
for one in threads: one.start()
time.sleep(1)
"""
FAULTS = "import ctypes; ctypes.string_at(0)"
KILLS_ITSELF = "time.sleep(1); os.kill(os.getpid(), signal.SIGKILL)"
STOPS_ITSELF = "time.sleep(1); os.kill(os.getpid(), signal.SIGSTOP)"


IDS = [
    "spins in callback",
    "spins at end",
    "catches all",
    "stops itself",
    "kills itself",
    "faults",
    "polls",
    "forks",
    "executes",
    "starts process in c",
    "exits in thread",
    "leaves in thread",
    "leaves in party",
    "raises in callback",
    "closes all",
    "ends before its thread",
    "many threads",
    "many parties",
    "too many threads",
]


@pytest.mark.parametrize(
    ("bad", "end", "told"),
    [
        (SPINS_IN_CALLBACK, "ended by SIGKILL", [KEPT, LEFT]),
        (SPINS_AT_END, "ended by SIGKILL", [KEPT, LEFT]),
        (CATCHES_ALL, "ended by SIGKILL", [KEPT, LEFT]),
        (STOPS_ITSELF, "ended by SIGKILL", [KEPT, LEFT]),
        (KILLS_ITSELF, "ended by SIGKILL", [LEFT]),
        (FAULTS, "ended by SIGSEGV", [LEFT]),
        (POLLS, None, ["polls without sleeping; each poll takes 10 us", "bad: over at 2.00"]),
        ("os.fork()", "exit status 1", ["os.fork in virtual time: the new process would have"]),
        (EXECUTES, "its connection has ended", ["bad: again", LEFT]),
        (STARTS_PROCESS_IN_C, None, ["bad: started", "bad: end at 1.00"]),
        (EXITS_IN_THREAD, "exit status 5", [LEFT]),
        (LEAVES_IN_THREAD, None, ["bad: goes on at 2.00"]),
        (LEAVES_IN_PARTY, "exit status 5", [LEFT]),
        (RAISES_IN_CALLBACK, "exit status 1", ["bad: ZeroDivisionError: division by zero"]),
        (CLOSES_ALL, "exit status 1", ["the rig has ended, and with it the time of this", LEFT]),
        (ENDS_BEFORE_ITS_THREAD, None, ["bad: thread at 2.00"]),
        (MANY_THREADS, None, ["bad: all at 2.00"]),
        (MANY_PARTIES, None, ["bad: all at 2.00"]),
        (TOO_MANY_THREADS, "exit status 1", ["party 1024: expected 0 to 1023"]),
    ],
    ids=IDS,
)
def test_hostile_program_is_told_by_name_and_ends(run, bad, end, told):
    lines, wrong = run(bad, stall_s=STALL_S if KEPT in told else 10.0)
    assert wrong == end, lines
    for part in told:
        assert any(part in line for line in lines), lines


def test_program_that_closes_its_connection_has_one_error(run):
    lines, wrong = run("os.closerange(3, 256)\ntime.sleep(1)")
    assert wrong == "exit status 1"
    assert sum("Traceback" in line for line in lines) == 1, lines


HANDLER = """
def handle(*_):
    time.sleep(0.5)
    tell("handled")
signal.signal(signal.SIGUSR1, handle)
time.sleep(3)
tell("slept")
"""
HANDLER_BESIDE_THREAD = """
log = []
def handle(*_):
    log.append("handler")
    time.sleep(0.5)
    log.append("handled")
def work():
    for _ in range(40): time.sleep(0.1)
signal.signal(signal.SIGUSR1, handle)
thread = threading.Thread(target=work)
thread.start()
thread.join()
tell(*log)
"""
RAISING_HANDLER = """
def handle(*_):
    raise LookupError("of the handler")
signal.signal(signal.SIGUSR1, handle)
try: time.sleep(3)
except LookupError as error: tell(error)
time.sleep(1)
tell("end")
"""
INTERRUPTED = """
try: time.sleep(3)
except KeyboardInterrupt: tell("interrupted")
time.sleep(1)
tell("end")
"""


@pytest.mark.parametrize(
    ("bad", "name", "told"),
    [
        (HANDLER, "SIGUSR1", ["handled at 3.50", "slept at 3.50"]),
        (RAISING_HANDLER, "SIGUSR1", ["of the handler at 3.00", "end at 4.00"]),
        (INTERRUPTED, "SIGINT", ["interrupted at 3.00", "end at 4.00"]),
    ],
    ids=["waits", "raises", "interrupt"],
)
def test_signal_of_other_program_is_handled_in_a_turn(run, bad, name, told):
    lines, wrong = run(bad, SENDER.format(name=name, ends=False))
    assert wrong is None, lines
    assert [line for line in lines if line.startswith("bad")] == [f"bad: {line}" for line in told]


def test_signal_beside_a_thread_is_handled_in_a_turn(run):
    """Check the order only: a signal reaches the main thread on the clock of the wall."""
    lines, wrong = run(HANDLER_BESIDE_THREAD, SENDER.format(name="SIGUSR1", ends=False))
    assert wrong is None, lines
    assert [line.partition(" at ")[0] for line in lines if line.startswith("bad")] == [
        "bad: handler handled"
    ]


def test_program_killed_in_its_wait_is_told_at_that_time(run):
    lines, wrong = run("time.sleep(3600)", SENDER.format(name="SIGKILL", ends=True))
    assert wrong == "ended by SIGKILL"
    assert lines == [LEFT, ENDS]
