"""Python programs that a program of a rig starts by `subprocess` share the rig's time."""

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.harness.shared_time.programs import run_programs
from motorhil.traces.digest import digest

pytestmark = pytest.mark.wall

RIG = """
[bus.can0]
bitrate_bit_s = 500_000
node = { listener = { silent = true } }

[program.parent]
command = ["python", "parent.py"]
"""
HEAD = """
import signal, subprocess, sys, time
begun_s = time.monotonic()
def tell(*words):
    print(*words, f"at {time.monotonic() - begun_s:.2f}")
def python(code, *words, **keys):
    return subprocess.Popen([sys.executable, *words, "-c", code], text=True, **keys)
"""
TALKER = """
import can, sys, time
bus = can.Bus()
for number in range(3):
    bus.send(can.Message(arbitration_id=0x100 + number, is_extended_id=False))
    time.sleep(float(sys.argv[1]))
print("talked", sys.argv[1])
bus.shutdown()
"""


@pytest.fixture
def run(tmp_path):
    """Return a function that runs a parent and returns its lines of output and what was wrong."""
    (tmp_path / "talker.py").write_text(TALKER)

    def run(code, record=None, stall_s=10.0):
        (tmp_path / "rig.toml").write_text(f"{RIG}stall_s = {stall_s}\n")
        (tmp_path / "parent.py").write_text(HEAD + code)
        lines = []
        with Rig.open(tmp_path / "rig.toml", record=record) as rig:
            wrong = run_programs(rig, lines.append)
        return [line.removeprefix("parent: ") for line in lines], wrong

    return run


def test_children_send_in_the_time_of_the_rig(run, tmp_path):
    code = """
children = [subprocess.Popen([sys.executable, "talker.py", pause]) for pause in ("0.2", "0.1")]
time.sleep(0.25)
tell("meanwhile")
for child in children:
    tell(child.wait())
"""
    digests = set()
    for name in ("once", "again"):
        record = tmp_path / f"{name}.mcap"
        lines, wrong = run(code, record)
        assert wrong == {}
        assert lines == [
            *("meanwhile at 0.25", "talked 0.1", "talked 0.2", "0 at 0.60", "0 at 0.60"),
        ]
        digests.add(digest(record))
    assert len(digests) == 1


def test_pipes_of_a_child_wait_in_the_time_of_the_rig(run):
    code = """
ticks = "import time\\nfor tick in range(3): time.sleep(0.1); print('tick', tick)"
with python(ticks, stdout=subprocess.PIPE) as child:
    for line in child.stdout:
        tell(line.rstrip())
tell(child.returncode)
echo = "import sys; print(2 * input()); print(sys.stdin.read().upper(), file=sys.stderr)"
child = python(echo, stdin=-1, stdout=-1, stderr=-1)
child.stdin.write("ab\\n")
child.stdin.flush()
tell(child.stdout.readline().rstrip())
tell(child.communicate("rest"), child.returncode)
"""
    lines, wrong = run(code)
    assert wrong == {}
    assert lines == [
        *("tick 0 at 0.10", "tick 1 at 0.20", "tick 2 at 0.30", "0 at 0.30"),
        *("abab at 0.30", "('', 'REST\\n') 0 at 0.30"),
    ]


def test_more_than_a_pipe_holds_passes_both_ways(run):
    code = """
size = 300_000
child = python("import sys; sys.stdout.write(sys.stdin.read())", stdin=-1, stdout=-1)
tell([len(text or "") for text in child.communicate("x" * size)])
"""
    assert run(code) == (["[300000, 0] at 0.00"], {})


def test_child_beyond_its_timeout_is_killed_at_that_time(run):
    code = """
sleeper = "import time; time.sleep(100)"
try:
    subprocess.run([sys.executable, "-c", sleeper], timeout=2)
except subprocess.TimeoutExpired:
    tell("too long")
child = python(sleeper)
tell(child.poll())
time.sleep(1)
child.terminate()
tell(child.poll() == -signal.SIGTERM)
"""
    lines, wrong = run(code)
    assert wrong == {}
    assert [line for line in lines if " at " in line] == [
        *("too long at 2.00", "None at 2.00", "True at 3.00"),
    ]


def test_child_that_keeps_the_turn_is_named_and_killed(run):
    code = """
child = python("while True: pass")
tell(child.wait())
grandparent = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'while True: pass'])"
tell(python(grandparent).wait())
"""
    lines, wrong = run(code, stall_s=0.6)
    assert wrong == {}
    assert [line for line in lines if line.startswith("program ")] == [
        f"program parent/{name}: {what}"
        for name, waiting in (("1", ("parent",)), ("2/1", ("parent", "parent/2")))
        for what in (
            "has kept the turn for 0.6 s of wall time, and no virtual time passes; expected a wait;"
            " it is killed; waiting: " + ", ".join(f"{one} without a timeout" for one in waiting),
            "has left the rig: its connection has ended",
        )
    ]
    assert [line for line in lines if " at " in line] == ["-9 at 0.00", "0 at 0.00"]


def test_child_that_does_not_join_runs_on_the_wall_clock(run, tmp_path):
    fake = tmp_path / "python3"
    fake.write_text("#!/bin/sh\necho $1 $2\n")
    fake.chmod(0o755)
    code = """
tell(subprocess.check_output(["echo", "other"]))
tell(python("print(1)", "-I", stdout=-1).communicate())
tell(subprocess.check_output(["./python3", "-c", "2"]))
"""
    lines, wrong = run(code)
    assert wrong == {}
    assert lines == [
        *("b'other\\n' at 0.00", "('1\\n', None) at 0.00"),
        "motorhil: child ./python3 -c 2: ended before it joined the rig's time",
        "b'-c 2\\n' at 0.00",
    ]


def test_orphan_goes_on_and_is_awaited(run, tmp_path):
    code = """
python("import time; time.sleep(3); print('late')")
"""
    lines, wrong = run(code)
    assert (lines, wrong) == (["late"], {})


WORKERS = """
import multiprocessing, time
from concurrent.futures import ProcessPoolExecutor

def work(queue, lock, name, pause_s):
    for number in range(2):
        with lock:
            time.sleep(pause_s)
            queue.put((name, number))

def square(number):
    time.sleep(0.1 * number)
    return number * number

def answer(pipe):
    while (asked := pipe.recv()) is not None:
        time.sleep(0.1)
        pipe.send(asked[::-1])

if __name__ == "__main__":
    begun_s = time.monotonic()
    spawn = multiprocessing.get_context("spawn")
"""


def in_main(*lines):
    """Return a program with these lines below its functions."""
    return HEAD + WORKERS + "".join(f"    {line}\n" for line in lines)


def test_spawned_processes_share_queue_and_lock(run, tmp_path):
    code = in_main(
        "queue, lock = spawn.Queue(), spawn.Lock()",
        'facts = (("a", 0.1), ("b", 0.2))',
        "processes = [spawn.Process(target=work, args=(queue, lock, *one)) for one in facts]",
        "for process in processes: process.start()",
        "for _ in range(4): tell(*queue.get())",
        "for process in processes: process.join()",
        "tell([process.exitcode for process in processes])",
    )
    lines, wrong = run(code)
    assert wrong == {}
    assert lines == [
        *("a 0 at 0.10", "a 1 at 0.20", "b 0 at 0.40", "b 1 at 0.60", "[0, 0] at 0.60"),
    ]


def test_spawned_pools_and_pipes_wait_in_the_time_of_the_rig(run):
    code = in_main(
        "with ProcessPoolExecutor(2, mp_context=spawn) as pool:",
        "    tell(list(pool.map(square, [3, 1, 2])))",
        "with spawn.Pool(2) as pool:",
        "    tell(pool.map(square, [2, 1]))",
        "own, other = spawn.Pipe()",
        "process = spawn.Process(target=answer, args=(other,))",
        "process.start()",
        "tell(own.poll(0.5))",
        "own.send('x' * 200_000)",
        "tell(len(own.recv()))",
        "process.join(0.25)",
        "tell(process.exitcode)",
        "own.send(None)",
        "process.join()",
        "tell(process.exitcode)",
        "tell(spawn.Event().wait(0.5))",
    )
    lines, wrong = run(code)
    assert wrong == {}
    assert lines == [
        *("[9, 1, 4] at 0.30", "[4, 1] at 0.50", "False at 1.00", "200000 at 1.10"),
        *("None at 1.35", "0 at 1.35", "False at 1.85"),
    ]


def test_process_that_is_ended_is_dead_at_that_time(run):
    code = in_main(
        "process = spawn.Process(target=time.sleep, args=(100,))",
        "process.start()",
        "time.sleep(0.5)",
        "process.terminate()",
        "process.join()",
        "tell(process.exitcode)",
        "spawn.Process(target=time.sleep, args=(100,), daemon=True).start()",
    )
    lines, wrong = run(code)
    assert wrong == {}
    assert lines[0] == "-15 at 0.50"
    assert all("has left the rig: its connection has ended" in line for line in lines[1:])


def test_child_in_a_callback_is_refused(run):
    code = """
import can
import motorhil
rig = motorhil.join()
def start(*facts):
    subprocess.run([sys.executable, "-c", "print(1)"])
bus = rig.bus("can0")
rig.runtime.listen(bus, start)
bus.send(can.Message(arbitration_id=1))
try:
    rig.runtime.run_for(0.1)
except Exception as error:
    print(error)
"""
    lines, _ = run(code)
    assert "starts a child in a callback; expected a turn of the program" in lines[0]


def test_children_may_come_and_go_without_end(run, monkeypatch):
    monkeypatch.setattr("motorhil.harness.shared_time.shared_clock._CHILDREN_MAX", 2)
    code = """
for _ in range(3):
    tell(subprocess.check_output([sys.executable, "-c", "print(1)"]))
children = [python("import time; time.sleep(1)") for _ in range(3)]
tell([child.wait() for child in children])
"""
    lines, wrong = run(code)
    assert wrong == {}
    assert lines[:3] == ["b'1\\n' at 0.00"] * 3
    assert "not awaited; expected one of none, as it has as many as it takes" in lines[3]
    assert "was refused: the rig has 2 children at once; wait for one" in lines[4]
    assert lines[5] == "[0, 0, 3] at 1.00"


def test_forked_process_is_refused(run):
    code = in_main(
        'try: multiprocessing.get_context("fork").Process(target=square).start()',
        "except Exception as error: print(error)",
        "try: multiprocessing.Manager()",
        "except Exception as error: print(error)",
    )
    lines, wrong = run(code)
    assert wrong == {}
    assert 'use multiprocessing.get_context("spawn")' in lines[0]
    assert "use a Queue of a spawn context" in lines[1]


def test_event_loop_starts_children_in_the_time_of_the_rig(run):
    code = (
        HEAD
        + """
import asyncio
from asyncio.subprocess import PIPE
ECHO = "import time\\nwhile line := input(): time.sleep(0.1); print(line[::-1])"

async def ask(words):
    child = await asyncio.create_subprocess_exec(
        sys.executable, "-c", ECHO, stdin=PIPE, stdout=PIPE
    )
    for word in words:
        child.stdin.write(word.encode() + b"\\n")
        tell(await child.stdout.readline())
    child.stdin.write(b"\\n")
    tell(await child.wait())

async def main():
    await asyncio.gather(ask(["ab", "cd"]), asyncio.sleep(0.15))
    child = await asyncio.create_subprocess_exec(
        sys.executable, "-c", "print(input() * 2)", stdin=PIPE, stdout=PIPE
    )
    tell(await child.communicate(b"ab"))
    for start in (asyncio.create_subprocess_exec, asyncio.create_subprocess_shell):
        try:
            await start("true")
        except Exception as error:
            print(error)

asyncio.run(main())
"""
    )
    lines, wrong = run(code)
    assert wrong == {}
    assert lines[:4] == [
        *("b'ba\\n' at 0.10", "b'dc\\n' at 0.20", "0 at 0.20", "(b'abab\\n', None) at 0.20"),
    ]
    assert [line[:24] for line in lines[4:]] == [
        "asyncio.subprocess_exec ",
        "asyncio.subprocess_shell",
    ]


def test_parent_and_child_that_wait_for_each_other_are_told(run):
    code = """
try:
    child = python("import sys; print(sys.stdin.read())", stdin=subprocess.PIPE)
    child.wait()
except Exception as error:
    print(error)
"""
    lines, wrong = run(code)
    assert wrong == {}
    waits = (
        "waits without a timeout, but nothing can end the wait: no event is due in the whole rig"
    )
    assert any(line.startswith(f"party 'parent' {waits}") for line in lines)
    assert any(f"party 'parent/1' {waits}" in line for line in lines)
