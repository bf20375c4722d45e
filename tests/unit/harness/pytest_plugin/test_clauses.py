"""`pytest --adaptation NAME --rig RIG`: every clause as a test."""

import json
import re
import shlex

import pytest

import motorhil.harness.pytest_plugin.clauses  # noqa: F401 -- stays loaded between the runs below
from motorhil.harness.cli.main import main
from motorhil.harness.rig.config.scaffold import write_new_rig
from motorhil.traces.digest import digest

pytest_plugins = ["pytester"]
TESTS = """
import pytest
from motorhil.motorapi import ControlMode

@pytest.mark.parametrize("place_rad", [0.1, 0.2, 0.3], ids=["a/b", "a:b", "c"])
def test_it(motor, place_rad):
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(place_rad)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    assert motor.position() > 9.0
"""
LEVEL = ("--level", "L0")
ONE = ["--adaptation=cia402", "--rig=wheels/rig.toml"]


@pytest.fixture
def project(pytester, monkeypatch):
    """Return a project with two wheels and an unrelated test."""
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)
    write_new_rig(pytester.path / "wheels")
    pytester.makeini("[pytest]\naddopts = -W error -p no:hypothesispytest\n")
    pytester.makepyfile("def test_of_its_own():\n    pass\n")
    return pytester


@pytest.fixture
def tight_window(project):
    """Declare a position window that no motor can keep, for clauses that fail."""
    with (project.path / "wheels/rig.toml").open("a") as rig:
        rig.write("\n[conformance]\nwindow_rad = 1e-9\n")


def results_of(document):
    """Return pytest's outcome of each clause from the output of `motorhil conform`."""
    words = {"passed": "PASSED", "failed": "FAILED", "not applicable": "SKIPPED"}
    return {one["id"]: words[one["result"]] for one in json.loads(document)["clauses"]}


@pytest.mark.usefixtures("tight_window")
def test_several_workers_find_the_same_as_one_process(project):
    """Compare clauses and tests with rigs; each failure leaves its own record."""
    words = ["--adaptation", "cia402", "--rig", "wheels/rig.toml"]
    file = project.makepyfile(test_own=TESTS).name
    result = project.runpytest_inprocess(*words, *LEVEL, file, "-v", "-n", "2", "-rs")
    result.stdout.fnmatch_lines(["SKIPPED * wheels/rig.toml:1: *model has no torque_max"])
    told = re.findall(r"^\[gw\d\].* (\w+) (\S+?)::(\S+) *$", result.stdout.str(), re.MULTILINE)
    clauses = {clause: outcome for outcome, place, clause in told if place == "wheels/rig.toml"}
    assert sorted(outcome for outcome, place, _ in told if place == file) == ["FAILED"] * 3

    assert main(["conform", *words, *LEVEL, "--json", "found.json", "-o", "alone"]) == 1
    assert clauses == results_of((project.path / "found.json").read_text())
    assert {"PASSED", "FAILED", "SKIPPED"} == set(clauses.values())
    alone = project.runpytest_inprocess("--rig=wheels/rig.toml", "--record-dir=alone", file)
    alone.assert_outcomes(failed=3)
    records = [
        {path.name: digest(path) for path in (project.path / folder).glob("*")}
        for folder in ("out", "alone")
    ]
    assert records[0] == records[1]
    assert len(set(records[0].values())) == len(records[0]) > 3


@pytest.mark.parametrize("ci", ["", "true"])  # if set, pytest does not shorten its summary
@pytest.mark.usefixtures("tight_window")
def test_failed_clause_reports_promise_result_and_command(project, capsys, monkeypatch, ci):
    monkeypatch.setenv("CI", ci)
    result = project.runpytest_inprocess(*ONE, "wheels/rig.toml::UNIT-01", "--seed=5")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            "failed: left: commanded * rad, moved * rad; *",
            "promise: Each motor moves, and reports, *",
            "source: paper 3.2, *",
            "record: out/UNIT-01.mcap",
            "again: motorhil conform * --clause UNIT-01 --seed 5",
            "FAILED wheels/rig.toml::UNIT-01 - failed: left: commanded *",
        ]
    )
    record = project.path / "out/UNIT-01.mcap"
    before = digest(record)
    (again,) = set(re.findall(r"^again: motorhil (.*)$", result.stdout.str(), re.MULTILINE))
    capsys.readouterr()
    assert main([*shlex.split(again), "-o", "again"]) == 1
    assert "UNIT-01   failed" in capsys.readouterr().out
    assert digest(project.path / "again/UNIT-01.mcap") == before
    assert main(["show", str(record), "--last", "1"]) == 0


def test_session_without_applicable_clause_fails(project):
    result = project.runpytest_inprocess(*ONE, *LEVEL, "-k", "MEAS-03 or test_of_its_own")
    result.assert_outcomes(skipped=1)  # the project's own tests were not named
    assert result.ret == 1
    result.stdout.fnmatch_lines(["motorhil: no clause was applicable, so nothing was shown"])


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--adaptation=cia40", "--rig=wheels/rig.toml"], "*cia40: is not installed *did you mean"),
        (["--adaptation=cia402"], "*--adaptation cia402: no rig given; say --rig=FILE, *"),
        ([*ONE, "--level=L9"], "*invalid level 'L9'; use L0 to L5"),
    ],
)
def test_wrong_usage_is_reported_in_one_line(project, words, told):
    result = project.runpytest_inprocess(*words)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines([f"{told}*"])
    assert "Traceback" not in result.stderr.str() + result.stdout.str()
