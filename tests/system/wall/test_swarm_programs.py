"""Campaigns of rigs whose programs share one virtual time, and are killed in some worlds."""

import json
import shutil
import subprocess
import sys

import pytest

from motorhil.harness.rig.config.scaffold import EXAMPLES
from tests.support.command_line import in_another_process

pytestmark = pytest.mark.wall

RIG = (EXAMPLES / "two_wheels.toml").read_text()
PROGRAMS = """
[program.driver]
command = ["python", "driver.py"]

[program.watcher]
command = ["python", "watcher.py"]

[swarm]
disturbances = 1

[swarm.weights]
"""
DRIVER = """
import motorhil
from motorhil.motorapi import ControlMode

rig = motorhil.join()
wheel = rig.motors["left"]
wheel.set_control_mode(ControlMode.SETPOINT)
wheel.enable()
wheel.set_setpoint(1.0)
wheel.start()
wheel.wait_until_done(timeout_s=5)
rig.runtime.run_for(0.5)
"""
KINDS = (
    *("drop", "delay", "duplicate", "error", "cut", "noise", "load", "stall", "heat", "supply"),
    *("power", "fault", "quirk", "clock", "plant", "interleaving", "lose", "truncate"),
)


@pytest.fixture
def cell(tmp_path):
    """Return a folder with a rig of two programs, whose worlds only kill."""
    (tmp_path / "cell.toml").write_text(RIG + PROGRAMS + "".join(f"{kind} = 0\n" for kind in KINDS))
    (tmp_path / "driver.py").write_text(DRIVER)
    (tmp_path / "watcher.py").write_text("import motorhil\nmotorhil.join().runtime.run_for(1.5)\n")
    shutil.copy(EXAMPLES / "wheel_model.toml", tmp_path)
    return tmp_path


def swarm(folder, *words):
    """Run the verb there; return its exit status and its document."""
    told = in_another_process("swarm", "cell.toml", "--workers", "1", "--json", *words, cwd=folder)
    return told.returncode, json.loads(told.stdout)


def rows(folder):
    return sorted((folder / "rows.jsonl").read_bytes().splitlines())


def test_programs_are_killed_at_the_same_instant_in_each_run(cell):
    status, found = swarm(cell, "--seeds", "2", "-o", "one")
    assert status == 0, found
    assert found["results"]["pass"] == 2
    assert swarm(cell, "--seeds", "2", "-o", "two")[0] == 0
    assert rows(cell / "one") == rows(cell / "two")
    killed = [json.loads(row).get("acts") for row in rows(cell / "one")]
    assert {"kill": 1} in killed


def test_an_allowed_error_may_end_the_other_program(cell):
    (cell / "watcher.py").write_text(
        "import motorhil\n"
        "from motorhil.motorapi import LinkError\n"
        "rig = motorhil.join()\n"
        "rig.runtime.run_for(1.4)\n"
        'if rig.motors["left"].position() < 0.9:\n'
        '    raise LinkError(link="can0", reason="the driver is gone")\n'
    )
    status, found = swarm(cell, "--seeds", "2", "-o", "out")
    assert status == 0, found
    assert found["ended_by"] == {"LinkError": 1}


def test_what_the_death_of_one_program_does_to_another_is_a_failure(cell):
    (cell / "watcher.py").write_text(
        "import motorhil\n"
        "rig = motorhil.join()\n"
        "rig.runtime.run_for(1.4)\n"
        'assert rig.motors["left"].position() > 0.9, "the wheel has not turned"\n'
    )
    status, found = swarm(cell, "--seeds", "2", "-o", "out")
    assert status == 1
    (kept,) = found["kept"]
    assert kept["signature"].startswith("exit | AssertionError | watcher")
    again = kept["again"].split()
    assert again[:3] == ["motorhil", "run", "cell.toml"]
    told = subprocess.run(
        [sys.executable, "-m", *again], cwd=cell, capture_output=True, text=True, check=False
    )
    assert told.returncode == 1
    assert "the wheel has not turned" in told.stdout
    assert "program watcher" in told.stderr
    assert "program driver" not in told.stderr  # its death is the world's


def test_a_fragment_kills_only_programs_that_there_are(cell):
    (cell / "world.toml").write_text('[[world.kill]]\nprogram = "drover"\nat_s = 1.0\n')
    told = in_another_process("run", "cell.toml", "--world", "world.toml", cwd=cell)
    assert told.returncode == 2
    assert 'world.toml:2: world.kill[0].program: there is no program "drover"' in told.stderr
