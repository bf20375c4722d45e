"""Programs of a rig in processes of their own, started by `motorhil run RIG`."""

from pathlib import Path

import pytest

from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig
from motorhil.harness.shared_time.programs import run_programs
from motorhil.traces.digest import digest
from tests.support.modbus.rigs import text
from tests.support.motors.wheels import frames_on

pytestmark = pytest.mark.wall

PROGRAMS = Path(__file__).parents[3] / "support" / "programs"
RIG = """
[bus.can0]
bitrate_bit_s = 500_000
node = { listener = { silent = true } }
"""
TALKER = """
import sys, time, can
name, count = sys.argv[1], int(sys.argv[2])
bus = can.Bus()
for number in range(count):
    bus.send(can.Message(arbitration_id=0x100 + number, data=name.encode(), is_extended_id=False))
    time.sleep(0.01)
    print(name, number, f"{time.monotonic() % 1000:.3f}")
bus.shutdown()
"""
OWNER = """
import os, sys, motorhil
from motorhil.motorapi import ControlMode
rig = motorhil.join()
wheel = rig.motors["left"]
for number in range(3):
    with wheel.reserve(timeout_s=30):
        wheel.set_control_mode(ControlMode.SETPOINT)
        wheel.set_setpoint(float(sys.argv[1]) * (number + 1))
        wheel.start()
        wheel.wait_until_done(timeout_s=5)
        if sys.argv[2] == str(number):
            os.kill(os.getpid(), 9)
        print(number, f"{wheel.position():.3f}")
    rig.runtime.run_for(0.001)
"""


TURNER = """
import sys, motorhil
from motorhil.motorapi import ControlMode
rig = motorhil.join()
for turn, name in enumerate(sys.argv[1:], 1):
    motor = rig.motors[name]
    with motor.reserve(timeout_s=30):
        motor.enable()
        motor.set_control_mode(ControlMode.SETPOINT)
        motor.set_setpoint(0.2 * turn)
        motor.start()
        motor.wait_until_done(timeout_s=5)
        print(name, f"{motor.position():.3f}")
"""


def program(name, *words, **keys):
    command = ", ".join(f'"{word}"' for word in words)
    extra = "".join(f"{key} = {value}\n" for key, value in keys.items())
    return f"[program.{name}]\ncommand = [{command}]\n{extra}"


@pytest.fixture
def run(tmp_path):
    """Return a function that runs programs and returns (output, failures, rig)."""
    (tmp_path / "talker.py").write_text(TALKER)
    (tmp_path / "owner.py").write_text(OWNER)

    def run(*programs, base=RIG, record=None):
        (tmp_path / "rig.toml").write_text(base + "".join(programs))
        lines = []
        with Rig.open(tmp_path / "rig.toml", record=record) as rig:
            wrong = run_programs(rig, lines.append)
        return lines, wrong

    return run


def test_output_is_named_and_in_order_of_virtual_time(run):
    lines, wrong = run(
        program("slow", "python", "talker.py", "s", "2"),
        program("fast", "python", "talker.py", "f", "3"),
    )
    assert wrong == {}
    assert [line.rpartition(" ")[0] for line in lines] == [
        *("slow: s 0", "fast: f 0", "slow: s 1", "fast: f 1", "fast: f 2"),
    ]


LAST = """
import can
with can.Bus() as bus:
    for number in range(3):
        bus.send(can.Message(arbitration_id=0x100 + number, is_extended_id=False))
"""


def test_frames_sent_at_the_end_of_the_last_program_are_on_the_bus(tmp_path):
    """As the kernel sends what a program has left in the queue of an interface."""
    (tmp_path / "last.py").write_text(LAST)
    (tmp_path / "rig.toml").write_text(RIG + program("a", "python", "last.py"))
    with Rig.open(tmp_path / "rig.toml") as rig:
        heard = frames_on(rig)
        assert run_programs(rig, print) == {}
        assert [can_id for _, _, can_id, _ in heard] == [0x100, 0x101, 0x102]
        assert rig.runtime.now_ns() < 1_000_000


def test_two_runs_of_programs_that_share_motor_make_one_record(run, tmp_path):
    base = (EXAMPLES / "two_wheels.toml").read_text()
    base = base.replace('"wheel_model.toml"', f'"{EXAMPLES / "wheel_model.toml"}"')
    programs = [
        program("one", "python", "owner.py", "0.3", "-"),
        program("two", "python", "owner.py", "-0.3", "-"),
    ]
    digests = set()
    for name in ("first", "second"):
        lines, wrong = run(*programs, base=base, record=tmp_path / f"{name}.mcap")
        assert wrong == {}
        assert lines == [
            *("one: 0 0.300", "two: 0 -0.300", "one: 1 0.600"),
            *("two: 1 -0.600", "one: 2 0.900", "two: 2 -0.900"),
        ]
        digests.add(digest(tmp_path / f"{name}.mcap"))
    assert len(digests) == 1


@pytest.mark.parametrize("line", ["rtu", "tcp"])
def test_programs_share_line_and_make_one_record(run, tmp_path, line):
    """Each program drives both motors: on RTU a request once followed an answer at once."""
    base = text(line=line, names=("one", "two"))
    programs = [
        program("first", "python", "turner.py", "one", "two"),
        program("second", "python", "turner.py", "two", "one"),
    ]
    (tmp_path / "turner.py").write_text(TURNER)
    digests = set()
    for name in ("once", "again"):
        record = tmp_path / f"{name}.mcap"
        lines, wrong = run(*programs, base=base, record=record)
        assert wrong == {}
        assert sorted(lines) == [
            *("first: one 0.200", "first: two 0.400", "second: one 0.400", "second: two 0.200"),
        ]
        digests.add(digest(record))
    assert len(digests) == 1


def test_event_loops_of_two_programs_make_one_record(run, tmp_path):
    base = (EXAMPLES / "two_wheels.toml").read_text()
    base = base.replace('"wheel_model.toml"', f'"{EXAMPLES / "wheel_model.toml"}"')
    command = ("python", str(PROGRAMS / "unmodified" / "asyncio_listening.py"))
    digests = set()
    for name in ("first", "second"):
        lines, wrong = run(
            *(program(one, *command) for one in ("one", "two")),
            base=base,
            record=tmp_path / f"{name}.mcap",
        )
        assert wrong == {}
        told = ["{'581': 10, '601': 8, '701': 1, '702': 1} 0.0 s late", "TimeoutError; 1.70 s"]
        assert lines == [f"{one}: {line}" for one in ("two", "one") for line in told]
        digests.add(digest(tmp_path / f"{name}.mcap"))
    assert len(digests) == 1


def test_motor_of_killed_program_passes_to_the_next(run):
    base = (EXAMPLES / "two_wheels.toml").read_text()
    base = base.replace('"wheel_model.toml"', f'"{EXAMPLES / "wheel_model.toml"}"')
    lines, wrong = run(
        program("one", "python", "owner.py", "0.3", "1"),
        program("two", "python", "owner.py", "-0.3", "-"),
        base=base,
    )
    assert wrong == {"one": "ended by SIGKILL"}
    assert "program one: has left the rig: its connection has ended" in lines
    assert lines[-1] == "two: 2 -0.900"


KEEPER = """
import sys, motorhil
from motorhil.motorapi.locking.process_lock import ProcessLock
rig = motorhil.join()
lock = ProcessLock("it", "it", runtime=rig.runtime)
rig.runtime.run_for(float(sys.argv[1]))
hold = lock.acquire(rig.runtime, "a test", 100.0)
print("has it at", rig.runtime.now_ns())
rig.runtime.run_for(1.0)
rig.close()
for _ in range(10_000_000): pass
"""


def test_lock_of_program_that_has_left_is_free_at_that_time(run, tmp_path):
    """A drive's SDO channel is kept after a timeout, beyond the end of the program, too."""
    (tmp_path / "keeper.py").write_text(KEEPER)
    lines, wrong = run(
        program("one", "python", "keeper.py", "0.0"),
        program("two", "python", "keeper.py", "0.5"),
    )
    assert wrong == {}
    assert lines == ["one: has it at 0", "two: has it at 1000000000"]


VICTIM = """
import os, motorhil
from motorhil.motorapi.locking.process_lock import ProcessLock
rig = motorhil.join()
hold = ProcessLock("it", "it", runtime=rig.runtime).acquire(rig.runtime, "a test", 100.0)
with open("pid", "w") as file:
    file.write(str(os.getpid()))
rig.runtime.run_for(10.0)
"""
KILLER = """
import os, motorhil
from motorhil.motorapi.locking.process_lock import ProcessLock
rig = motorhil.join()
rig.runtime.run_for(1.0)
victim = int(open("pid").read())
os.kill(victim, 9)
while open(f"/proc/{victim}/stat").read().rpartition(")")[2].split()[0] != "Z":
    pass
hold = ProcessLock("it", "it", runtime=rig.runtime).acquire(rig.runtime, "a test", 100.0)
print("has it at", rig.runtime.now_ns(), flush=True)
rig.runtime.run_for(1.0)
print("goes on")
"""


def test_death_of_a_waiting_program_is_noted_at_that_time(run, tmp_path):
    (tmp_path / "victim.py").write_text(VICTIM)
    (tmp_path / "killer.py").write_text(KILLER)
    lines, wrong = run(program("one", "python", "victim.py"), program("two", "python", "killer.py"))
    assert wrong == {"one": "ended by SIGKILL"}
    left = "program one: has left the rig: its connection has ended"
    assert lines == ["two: has it at 1000000000", left, "two: goes on"]


def test_program_that_may_leave_is_no_failure(run):
    source = "import os, time; time.sleep(0.01); os.kill(os.getpid(), 9)"
    _, wrong = run(
        program("one", "python", "-c", source, may_leave="true"),
        program("two", "python", "talker.py", "t", "3"),
    )
    assert wrong == {}


def test_program_that_keeps_the_turn_is_named_and_killed(run):
    source = "import time; time.sleep(0.01)\nwhile True: pass".replace("\n", "\\n")
    lines, wrong = run(
        program("spins", "python", "-c", source, stall_s=0.5),
        program("two", "python", "talker.py", "t", "3"),
    )
    assert wrong == {"spins": "ended by SIGKILL"}
    (told,) = [line for line in lines if "has kept the turn for 0.5 s" in line]
    assert told.startswith("program spins: ")
    assert lines[-1].startswith("two: t 2")


def test_exit_status_and_exception_are_failures(run):
    lines, wrong = run(
        program("exits", "python", "-c", "raise SystemExit(3)"),
        program("raises", "python", "-c", "1 / 0"),
    )
    assert wrong == {"exits": "exit status 3", "raises": "exit status 1"}
    assert "raises: ZeroDivisionError: division by zero" in lines


def test_program_that_does_not_join_ends_the_run_with_its_name(run):
    with pytest.raises(RigError, match=r"program shell: ended before it joined; expected"):
        run(
            program("shell", "true"),
            program("two", "python", "talker.py", "t", "3"),
        )


def test_program_beside_the_rig_runs_on_the_wall(run):
    lines, wrong = run(
        program("shell", "sh", "-c", "echo here", joins="false"),
        program("two", "python", "talker.py", "t", "1"),
    )
    assert wrong == {}
    assert "shell: here" in lines


def test_rig_of_programs_beside_it_is_refused(run):
    with pytest.raises(RigError, match="none of the programs joins the rig"):
        run(program("shell", "true", joins="false"))


def test_missing_command_is_named_with_its_line(run):
    with pytest.raises(RigError, match=r'rig.toml:\d+: .*"no-such-program" cannot be started'):
        run(program("one", "no-such-program"))


def test_programs_of_recorded_rig_are_not_started(run, tmp_path):
    run(program("one", "python", "talker.py", "t", "1"), record=tmp_path / "run.mcap")
    with Rig.open(tmp_path / "run.mcap") as rig:
        assert rig.description.programs == {}


OPENER = """
import can, time
for _ in range(300):
    can.Bus().shutdown()
time.sleep(0.01)
print("all opened")
"""
STARTER = """
import threading, time
for _ in range(1_100):
    thread = threading.Thread(target=time.sleep, args=(0.001,))
    thread.start()
    thread.join()
print("all ended")
"""


@pytest.mark.parametrize(("source", "last"), [(OPENER, "all opened"), (STARTER, "all ended")])
def test_buses_and_threads_of_program_come_and_go_without_end(run, tmp_path, source, last):
    (tmp_path / "many.py").write_text(source)
    lines, wrong = run(program("one", "python", "many.py"))
    assert wrong == {}
    assert lines == [f"one: {last}"]


def test_output_after_the_last_turn_is_printed_whole(run, tmp_path):
    """A pipe takes 64 KiB: a program whose output is not read cannot end."""
    source = "import motorhil; motorhil.join().close(); print(*range(40_000), sep=chr(10))"
    (tmp_path / "prints.py").write_text(source)
    lines, wrong = run(program("one", "python", "prints.py"))
    assert wrong == {}
    assert lines == [f"one: {number}" for number in range(40_000)]


def test_program_that_keeps_the_turn_with_records_is_killed(run, tmp_path):
    source = "import motorhil; rig = motorhil.join()\n"
    source += "while True: rig.runtime.every(1.0, print).cancel()\n"
    (tmp_path / "cancels.py").write_text(source)
    lines, wrong = run(
        program("cancels", "python", "cancels.py", stall_s=0.5),
        program("two", "python", "talker.py", "t", "3"),
    )
    assert wrong == {"cancels": "ended by SIGKILL"}
    assert any("has kept the turn for 0.5 s" in line for line in lines)
    assert lines[-1].startswith("two: t 2")


def test_endless_output_beside_the_rig_does_not_hold_it_up(run):
    lines, wrong = run(
        program("noise", "yes", joins="false"),
        program("zeros", "cat", "/dev/zero", joins="false"),
        program("two", "python", "talker.py", "t", "3"),
    )
    assert wrong == {}
    assert any(line.startswith("two: t 2") for line in lines)
    assert max(map(len, lines)) < 2 << 20
