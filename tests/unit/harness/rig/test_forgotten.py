"""Mistakes of the first hours: a missing start, a sleep without effect, an endless loop."""

import io
import re
import subprocess
import sys
import warnings

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.rig.rig import Rig
from motorhil.harness.virtual_time.stdlib.install import in_virtual_time
from motorhil.motorapi import ControlMode, ControlVariable

RIG = """\
[motor.wheel]
adaptation = "ideal"
[motor.wheel.model]
velocity_max_rad_s = 6.0
acceleration_max_rad_s2 = 20.0
[group.all]
motors = ["wheel"]
"""
EMPTY_BUS = """\
[bus.can0]
bitrate_bit_s = 1_000_000
"""
SCRIPT = """\
from time import sleep
from motorhil import Rig
with Rig.open("rig.toml") as rig:
    sleep(0.001)
    sleep(0.001)
"""
# A program's own lines; nothing here waits for longer than a microsecond of the wall.
PAUSES = compile("import time\ndef pause(s): time.sleep(s)\n", "program.py", "exec")
PROGRAM = {"__name__": "program"}
exec(PAUSES, PROGRAM)
pause = PROGRAM["pause"]
FORGOTTEN = "wheel: its set-point was set, but not started; start() begins it"


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    return path


def prepared(rig):
    wheel = rig.motors["wheel"]
    wheel.set_control_mode(ControlMode.SETPOINT, ControlVariable.POSITION)
    wheel.set_setpoint(1.0)
    return wheel


@pytest.mark.parametrize("waits", [lambda rig: rig.motors["wheel"], lambda rig: rig.groups["all"]])
def test_wait_without_a_start_names_the_motor(path, waits):
    rig = Rig.open(path)
    with rig:
        prepared(rig)
        with pytest.warns(UserWarning, match="wheel: .* start.. begins it, and this wait") as told:
            waits(rig).wait_until_done()
        assert told[0].filename == __file__
        rig.motors["wheel"].start()
        rig.motors["wheel"].wait_until_done()


def test_next_target_during_a_motion_is_no_mistake(path):
    with Rig.open(path) as rig:
        wheel = prepared(rig)
        wheel.start()
        wheel.set_setpoint(2.0)
        wheel.wait_until_done()
        wheel.start()


def test_end_of_a_rig_names_commands_never_started(path, monkeypatch):
    monkeypatch.delenv("PYTEST_CURRENT_TEST")
    told = pytest.warns(UserWarning, match=re.escape(FORGOTTEN) + "$")
    with told, Rig.open(path) as rig:
        prepared(rig)


def test_end_of_a_failed_program_names_its_error_only(path, monkeypatch):
    monkeypatch.delenv("PYTEST_CURRENT_TEST")

    def fail():
        with Rig.open(path) as rig:
            prepared(rig)
            raise KeyError

    with warnings.catch_warnings(record=True) as told, pytest.raises(KeyError):
        fail()
    assert told == []


def test_prompt_names_commands_never_started(path, capsys, monkeypatch):
    lines = (
        "from motorhil.motorapi import ControlMode",
        "wheel = rig.motors['wheel']",
        "wheel.set_control_mode(ControlMode.SETPOINT)",
        "wheel.set_setpoint(1.0)",
    )
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(lines) + "\n"))
    assert main(["run", str(path)]) == 0
    assert f"motorhil run: {FORGOTTEN}\n" in capsys.readouterr().err


def test_sleep_beside_virtual_time_is_told_once(path):
    with warnings.catch_warnings(record=True) as told, Rig.open(path) as rig:
        warnings.simplefilter("always")
        for _ in range(2):
            pause(1e-6)
        assert rig.runtime.now_ns() == 0
    (one,) = told
    assert "lets no virtual time pass in the open rig; write rig.runtime.run_for(1e-06)" in str(
        one.message
    )
    assert one.filename == "program.py"


def test_imported_name_of_sleep_is_told_in_a_program(path):
    words = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(words, cwd=path.parent, capture_output=True, text=True, check=True)
    assert done.stderr.count("UserWarning") == 1
    assert "run_for(0.001)" in done.stderr


def test_sleep_of_paced_and_replaced_time_is_no_mistake(path):
    original = PROGRAM["time"].sleep
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with Rig.open(path, realtime=True):
            pause(1e-6)
        with Rig.open(path) as rig, in_virtual_time(rig):
            pause(2.0)
            assert rig.runtime.now_ns() == 2_000_000_000
        pause(1e-6)
    assert PROGRAM["time"].sleep is original


def test_endless_loop_over_messages_is_told_once(path):
    path.write_text(RIG + EMPTY_BUS)
    with Rig.open(path) as rig:
        stop = rig.runtime.queue.alarm(lambda now_ns: rig.runtime.interrupt())
        stop.set(1300 * 10**9)
        with (
            pytest.warns(UserWarning, match="for message in can0: the loop has run") as told,
            pytest.raises(KeyboardInterrupt),
        ):
            for _ in rig.bus("can0"):
                pass
    assert len(told) == 1
