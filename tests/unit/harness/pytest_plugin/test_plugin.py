"""The pytest plugin in a project that has motorhil installed."""

import json
import re
import shlex
import subprocess
import sys

import pytest

import motorhil.harness.pytest_plugin.rigs  # noqa: F401 -- stays loaded between the runs below
from motorhil.harness.cli.main import main
from motorhil.harness.rig.config.scaffold import write_new_rig
from motorhil.traces.digest import digest

pytest_plugins = ["pytester"]
TURN = """
import pytest
from motorhil.motorapi import ControlMode

def turn(motor, place_rad):
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(place_rad)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    return motor.position()

"""
SHORT = """
def test_short(motor):
    assert turn(motor, 0.2) > 0.3
"""


@pytest.fixture
def project(pytester, monkeypatch):
    """Return a project with two wheels and pytest settings of its own."""
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)
    write_new_rig(pytester.path / "wheels")
    pytester.makeini("[pytest]\naddopts = -W error -p no:cacheprovider -p no:hypothesispytest\n")
    return pytester


@pytest.fixture
def run(project):
    """Return a function that writes tests, if any, and returns the result of pytest."""

    def write_and_run(tests, *words):
        if tests:
            project.makepyfile(TURN + tests)
        return project.runpytest_inprocess(*words)

    return write_and_run


def records(project, folder="out"):
    return sorted(path.name for path in (project.path / folder).glob("*"))


def again(result):
    """Return the words of the only command after "again:", without pytest."""
    (command,) = re.findall(r"^again:  (.*)$", result.stdout.str(), re.MULTILINE)
    program, *words = shlex.split(command)
    assert program == "pytest"
    return words


# --- records


def test_failed_test_leaves_a_record_and_passed_one_does_not(project, run):
    result = run(
        """
def test_passes(motor, rig):
    assert abs(turn(motor, 0.2) - 0.2) < 0.001

def test_fails(motor):
    assert turn(motor, 0.2) > 0.3

@pytest.mark.xfail(strict=True)
def test_fails_as_expected(rig):
    assert False

def test_skips(rig):
    pytest.skip("not today")

def test_is_kept(motor, recording):
    motor.enable()
    recording.keep()
    assert recording.complete().stat().st_size > 1000

@pytest.fixture
def broken(rig):
    raise ValueError("no such jig")

def test_is_never_begun(broken):
    pass

@pytest.fixture
def breaks(rig):
    yield
    raise ValueError("the jig fell over")

def test_ends_badly(breaks):
    pass
""",
        *("--rig", "wheels/rig.toml"),
    )
    result.assert_outcomes(passed=3, failed=1, xfailed=1, skipped=1, errors=2)
    names = ["test_ends_badly", "test_fails", "test_is_kept", "test_is_never_begun"]
    assert [re.sub(r"^.*\.py-(.*)-\w{6}\.mcap$", r"\1", name) for name in records(project)] == names
    told = re.findall(r"^record: (\S+), seed 1, failed at", result.stdout.str(), re.MULTILINE)
    assert sorted(told) == [f"out/{name}" for name in records(project) if "kept" not in name]


def test_session_without_failures_leaves_no_record_folder(project, run):
    run("def test_it(rig):\n    pass\n", "--rig=wheels/rig.toml").assert_outcomes(passed=1)
    assert not (project.path / "out").exists()


def test_repeat_command_gives_an_identical_record(project, run, capsys):
    tests = (
        "class TestWheel:\n    def test_it(self, motor):\n        assert turn(motor, 0.2) > 0.3\n"
    )
    first = run(tests, "--rig=wheels/rig.toml", "--seed=77", "--record-dir=kept here")
    first.assert_outcomes(failed=1)
    (record,) = (project.path / "kept here").glob("*")
    digests = [digest(record)]
    record.unlink()
    second = run(None, *again(first))
    second.assert_outcomes(failed=1)
    for result in (first, second):
        result.stdout.fnmatch_lines(["record: 'kept here/*', seed 77, failed at *"])
    digests.append(digest(record))
    assert digests[0] == digests[1]

    capsys.readouterr()
    assert main(["show", str(record), "--last", "1"]) == 0  # the command that the report suggests
    assert "left" in capsys.readouterr().out
    assert f"look:   motorhil show '{record.relative_to(project.path)}'" in first.stdout.str()


def test_repeat_command_works_in_the_folder_of_the_call(project, run, monkeypatch):
    project.makepyfile(TURN + SHORT)
    (project.path / "elsewhere").mkdir()
    monkeypatch.chdir(project.path / "elsewhere")
    rig = str(project.path / "wheels/rig.toml")
    words = ["-c", "../tox.ini", f"--rig={rig}", "-o", "console_output_style=count", ".."]
    result = project.runpytest_inprocess(*words)
    result.assert_outcomes(failed=1)
    told = again(result)
    assert told[-1] == "../test_repeat_command_works_in_the_folder_of_the_call.py::test_short"
    assert told[:4] == ["-c", "../tox.ini", "-o", "console_output_style=count"]
    project.runpytest_inprocess(*told).assert_outcomes(failed=1)
    assert len(records(project)) == 1  # beside the ini file


def test_record_of_an_interrupted_test_is_kept(project):
    project.makepyfile("def test_it(motor):\n    motor.enable()\n    raise KeyboardInterrupt\n")
    result = project.runpytest_inprocess("--rig=wheels/rig.toml", no_reraise_ctrlc=True)
    result.stdout.re_match_lines([r"motorhil: interrupted: record: out/\S+\.mcap, seed 1, .*"])
    (name,) = records(project)
    assert main(["show", str(project.path / "out" / name), "--last", "1"]) == 0


def test_recording_that_cannot_answer_fails_the_test(project, run):
    run(
        "def test_it(motor, recording):\n    turn(motor, 0.2)\n    recording.keep()\n",
        "--rig=wheels/rig.toml",
    ).assert_outcomes(passed=1)
    record = f"--rig=out/{records(project)[0]}"
    same = run("def test_it(motor):\n    assert abs(turn(motor, 0.2) - 0.2) < 0.001\n", record)
    same.assert_outcomes(passed=1)
    other = run("def test_it(motor):\n    turn(motor, 0.4)\n", record)
    other.assert_outcomes(failed=1, errors=1)
    other.stdout.fnmatch_lines(["*commands not in the recording; first:"])


# --- choice of rig, motor, group, seed


def test_innermost_mark_precedes_command_line_and_ini_file(project, run):
    project.makeini("[pytest]\nmotorhil_rig = wheels/rig.toml\n")
    text = (project.path / "wheels/rig.toml").read_text()
    for name in ("marked", "told"):
        named = text.replace('name = "two wheels"', f'name = "{name}"')
        (project.path / f"wheels/{name}.toml").write_text(named)
    tests = """
@pytest.mark.rig("wheels/marked.toml", seed=3, motor="left")
class TestMarked:
    @pytest.mark.rig(motor="right")
    def test_innermost(self, rig, motor):
        said(rig, motor)

    def test_outer(self, rig, motor):
        said(rig, motor)

def test_plain(rig, motor, group):
    assert len(group) == 2
    said(rig, motor)

@pytest.mark.parametrize("motor", ["left", "right"], indirect=True)
@pytest.mark.parametrize("rig", ["wheels/told.toml"], indirect=True)
def test_parameters(rig, motor):
    said(rig, motor)

def said(rig, motor):
    print(f"said {rig.description.name} {motor.name} {rig.seed}")
"""

    def said(*words):
        result = run(tests, "-s", "-v", *words)
        result.assert_outcomes(passed=5)
        return re.findall(r"said (.*) (\w+) (\d+)$", result.stdout.str(), re.MULTILINE)

    marked = [("marked", "right", "3"), ("marked", "left", "3")]
    by_parameter = [("told", "left", "1"), ("told", "right", "1")]
    assert said() == [*marked, ("two wheels", "left", "1"), *by_parameter]
    on_line = said("--rig", "wheels/told.toml", "--seed", "0x10")
    assert on_line[2] == ("told", "left", "16")
    assert [name for name, _, _ in on_line] == ["marked", "marked", "told", "told", "told"]
    assert {seed for _, _, seed in on_line} == {"16"}


def test_code_for_hardware_runs_in_the_rigs_time(project):
    project.makepyfile(
        """
import threading, time
import can, pytest

@pytest.fixture
def bus():
    with can.Bus() as bus:
        yield bus

def test_a_drive_boots(bus):
    heard = []
    listener = threading.Thread(target=lambda: heard.append(bus.recv(3600.0)))
    listener.start()
    begin = time.monotonic()
    time.sleep(1000.0)
    assert time.monotonic() - begin == pytest.approx(1000.0, abs=0.01)
    listener.join()
    assert heard[0].arbitration_id == 0x701
"""
    )
    words = ["--rig=wheels/rig.toml", "-o", "usefixtures=virtual_time"]
    project.runpytest_inprocess(*words).assert_outcomes(passed=1)


# --- errors, without a traceback of ours


def test_wrong_rig_on_the_command_line_is_wrong_usage(project, run):
    with (project.path / "wheels/rig.toml").open("a") as file:
        file.write("\n[moter.left]\n")
    result = run("def test_it():\n    pass\n", "--rig=wheels/rig.toml")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    (told,) = [line for line in result.stderr.lines if line]
    assert re.match(r"ERROR: wheels/rig\.toml:\d+: moter: .*did you mean motor", told)
    result = run(None, "--seed=-1")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    assert "is not a seed (0 to 4294967295)" in result.stderr.str()


def test_wrong_name_in_a_test_is_reported_in_one_line(project, run):
    (project.path / "file").write_text("")
    result = run(
        """
def test_a(rig):
    pass

@pytest.mark.rig("wheels/none.toml")
def test_b(rig):
    pass

@pytest.mark.rig("wheels/rig.toml", sed=1)
def test_c(rig):
    pass

@pytest.mark.rig("wheels/rig.toml", motor="middle")
def test_d(motor):
    pass
""",
        "--record-dir=records",
    )
    result.assert_outcomes(errors=4)
    result.stdout.fnmatch_lines(
        [
            "*::test_a: no rig given; say --rig=FILE, *",
            "wheels/none.toml: no such file; *",
            "*::test_c: @pytest.mark.rig takes one file, and seed, motor, group; not sed; *",
            "this rig has no motor 'middle' (known: left, right)",
        ]
    )
    assert "harness" not in result.stdout.str()
    assert "Traceback" not in result.stdout.str()
    result = run(None, "--record-dir=file", "--rig=wheels/rig.toml", "-k", "test_a")
    result.stdout.fnmatch_lines(["file: cannot be created: *; name another with --record-dir"])


def test_deliberate_error_traceback_ends_in_the_test(project, run):
    tests = "def test_it(motor):\n    motor.set_setpoint(1.0)\n"
    shown = run(tests, "--rig=wheels/rig.toml").stdout.str()
    assert "motorhil.motorapi.errors.StateError: left: set_setpoint refused" in shown
    assert "motorapi/motor.py" not in shown
    shown = run(None, "--rig=wheels/rig.toml", "--full-trace").stdout.str()
    assert "motorapi/motor.py" in shown


# --- with other plugins


def test_option_of_another_plugin_stays_theirs(project, run):
    project.makeconftest(
        """
def pytest_addoption(parser):
    parser.addoption("--seed", default="theirs")
    parser.addoption("--mine", action="store_true")

def pytest_report_header(config):
    return f"seed of theirs: {config.getoption('--seed')}"
"""
    )
    (project.path / "wheels/conftest.py").write_text("raise ValueError('not asked for')\n")
    words = ["--rig", "wheels/rig.toml", "--motorhil-seed=9", "--seed", "x", "--mine"]
    result = run(SHORT, *words, "--ignore=wheels")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            "motorhil: --seed belongs to another plugin; use --motorhil-seed",
            "seed of theirs: x",
            "record: *, seed 9, failed at * s",
        ]
    )
    assert again(result)[:2] == ["--rig=wheels/rig.toml", "--motorhil-seed=9"]


def test_session_without_a_rig_imports_only_the_plugin(project):
    program = """
import json, sys, pytest
pytest.main(["-q", "--collect-only", "-p", "no:hypothesispytest"])
print(json.dumps([name for name in sys.modules]))
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=project.path,
        capture_output=True,
        text=True,
        check=True,
    )
    loaded = json.loads(done.stdout.splitlines()[-1])
    ours = [one for one in loaded if one.split(".")[0] == "motorhil"]
    plugin = "motorhil.harness.pytest_plugin"
    parts = [f"{plugin}.options", f"{plugin}.plugin"]
    assert ours == ["motorhil", "motorhil.harness", plugin, *parts]
    assert not {"can", "numpy", "mcap", "hypothesis", "motorhil.traces"} & set(loaded)


EXAMPLES = """
from hypothesis import Phase, assume, given, settings, strategies as st

SHORT = [Phase.generate, Phase.shrink]

@settings(derandomize=True, max_examples=8, deadline=None, database=None, phases=SHORT)
@given(tenths=st.integers(1, 10))
def test_places(open_rig, tenths):
    place_rad = tenths / 10
    with open_rig({seed}) as rig:
        assert rig.runtime.now_ns() == 0
        assume(tenths < 9)
        assert turn(rig.motors["right"], place_rad) < {limit}
"""


def test_failing_example_of_hypothesis_is_named_with_its_record(project, run):
    failed = run(EXAMPLES.format(seed="seed=5", limit=0.4), "--rig=wheels/rig.toml")
    failed.assert_outcomes(failed=1)
    (record,) = records(project)
    text = failed.stdout.str()
    assert "tenths=5" in text
    assert f"record: out/{record}, seed 5, failed at " in text
    assert f"look:   motorhil show out/{record} --last 1" in text
    assert main(["show", str(project.path / "out" / record), "--motor", "right"]) == 0


def test_passing_examples_of_hypothesis_leave_no_record(project, run):
    run(EXAMPLES.format(seed="", limit=1.1), "--rig=wheels/rig.toml").assert_outcomes(passed=1)
    assert records(project) == []
