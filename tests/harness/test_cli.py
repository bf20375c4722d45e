import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from harness.cli import main
from tests.harness.test_rig import GOOD, WHEEL
from traces.digest import digest

SCRIPT = """\
import sys
import can

with can.Bus() as bus:
    bus.send(can.Message(arbitration_id=0x101, data=[42], is_extended_id=False))
    heard = [bus.recv(1.0) for _ in range(3)]
print(sys.argv[1:], __name__, heard[2].data.hex())
"""


@pytest.fixture
def rig(bench):
    (bench / "rig.toml").write_text(GOOD)
    (bench / "wheel.toml").write_text(WHEEL)
    (bench / "script.py").write_text(SCRIPT)
    return bench


@pytest.fixture
def say(capsys):
    """Runs a command line; (exit status, stdout, stderr)."""

    def run(*words):
        status = main(words)
        said = capsys.readouterr()
        return status, said.out, said.err

    return run


def environment():
    """For another process: it finds the plugins of bench.py, and bench.py itself."""
    folders = [str(Path.cwd().parent / "site"), str(Path(__file__).parents[2])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(folders)}


def in_another_process(*words, **options):
    return subprocess.run(
        [sys.executable, "-m", "harness", *words],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=30,
        **options,
    )


# --- help and version


def test_help_loads_none_of_the_big_libraries():
    code = (
        "import sys\nfrom harness.cli import main\nmain(['--help'])\n"
        "print([name for name in ('can', 'canopen', 'pymodbus', 'numpy', 'asyncio', 'mcap')"
        " if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "[]\n"
    assert "run a script, or a prompt, with a rig around it" in done.stdout


def test_help_names_only_verbs_that_exist_and_each_has_help_of_its_own(say):
    status, out, _ = say("--help")
    assert status == 0
    verbs = [line.split()[0] for line in out.splitlines() if line.startswith("    ")]
    assert {"new", "check", "run", "list"} <= set(verbs)
    for verb in verbs:
        status, out, _ = say(verb, "--help")
        assert status == 0
        assert out.startswith(f"usage: motorhil {verb}")


def test_version_says_which_cores_run_and_of_which_source(say):
    status, out, _ = say("--version")
    assert status == 0
    assert out.startswith("motorhil ")
    assert "pure Python cores, source " in out or "compiled cores, source " in out


@pytest.mark.parametrize("words", [(), ("no-such-verb",), ("-x",), ("run",), ("list", "nonsense")])
def test_wrong_usage_is_told_on_stderr_with_status_2(say, words):
    status, out, err = say(*words)
    assert (status, out) == (2, "")
    assert "usage: motorhil" in err


# --- check


def test_check_tells_what_a_rig_holds(rig, say):
    status, out, err = say("check", "rig.toml")
    assert (status, err) == (0, "")
    assert out == "rig.toml: rig: 1 bus, 2 controllers, 2 motors\n"


def test_check_answers_a_machine(rig, say):
    status, out, _ = say("check", "rig.toml", "--json")
    assert (status, out.startswith('{"right": true, "name": "rig", "buses": 1')) == (0, True)
    (rig / "rig.toml").write_text(GOOD.replace("seed", "sede"))
    assert say("check", "rig.toml", "--json") == (
        2,
        '{"right": false, "file": "rig.toml", "line": 2, "key": "rig.sede", '
        '"message": "unknown key (known: name, seed)", "remedy": "did you mean seed?"}\n',
        "",
    )


BAD_INPUT = {
    "unknown key": ("seed = 7", "sede = 7", "2: rig.sede: unknown key"),
    "wrong type": ("node_id = 2", 'node_id = "2"', "13: controller.right.node_id: must be an int"),
    "duplicate node": (
        "node_id = 2",
        "node_id = 1",
        '13: controller.right.node_id: 1 on bus "can0',
    ),
    "unknown plugin": (
        '"echo"',
        '"ecco"',
        '6: controller.left.kind: unknown controller kind "ecco"',
    ),
    "bus absent": (
        'bus = "can0"',
        'bus = "can7"',
        '7: controller.left.bus: there is no bus "can7"',
    ),
    "missing model": ("wheel.toml", "whale.toml", "23: motor.right.model: no such file"),
    "not TOML": ("[rig]", "[rig", "1: not TOML"),
}


@pytest.mark.parametrize("verb", ["check", "run"])
@pytest.mark.parametrize("what", BAD_INPUT)
def test_bad_input_is_one_line_with_file_line_key_and_remedy(rig, say, verb, what):
    old, new, told = BAD_INPUT[what]
    assert old in GOOD
    (rig / "rig.toml").write_text(GOOD.replace(old, new, 1))
    status, out, err = say(verb, "rig.toml")
    assert (status, out) == (2, "")
    assert err.startswith(f"rig.toml:{told}")
    assert err.count("\n") == 1
    assert "; " in err  # the remedy


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("check", "nope.toml"), "nope.toml: no such file; check the path, or write a new rig: "),
        (("run", "."), ".: is a folder, not a file; name the TOML file in it"),
        (("run", "rig.toml", "no.py"), "no.py: no such file; name a Python program"),
        (("run", "rig.toml", "."), ".: cannot be read: Is a directory; name a Python program"),
        (("run", "rig.toml", "--", "x"), "rig.toml: arguments, but no script to take them; name"),
        (("run", "rig.toml", "script.py", "-o", "no/x.mcap"), "no/x.mcap: "),
    ],
)
def test_missing_files_are_one_line_too(rig, say, words, told):
    status, out, err = say(*words)
    assert (status, out) == (2, "")
    assert err.startswith(told)
    assert err.count("\n") == 1


def test_check_finds_what_only_a_motor_that_is_made_can_refuse(rig, say):
    (rig / "rig.toml").write_text(GOOD.replace('"left"\n[', '"left"\nheartbeat = 1\n[', 1))
    status, out, err = say("check", "rig.toml")
    assert (status, out) == (2, "")
    assert err.startswith("rig.toml:17: motor.left.heartbeat: ")


def test_bad_input_leaves_nothing_running_and_no_traceback(rig):
    (rig / "rig.toml").write_text(GOOD.replace("seed", "sede"))
    done = in_another_process("run", "rig.toml", "script.py")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr


# --- run


def test_a_script_joins_the_rig_with_a_plain_can_bus(rig, say):
    assert say("run", "rig.toml", "script.py") == (0, "[] __main__ 2a\n", "")


def test_a_script_leaves_no_trace_in_the_process(rig, say, monkeypatch):
    monkeypatch.setenv("CAN_INTERFACE", "socketcan")
    monkeypatch.setenv("CAN_CONFIG", '{"fd": true}')
    before = (dict(os.environ), sys.argv, sys.path.copy(), sys.modules["__main__"])
    assert say("run", "rig.toml", "script.py") == (0, "[] __main__ 2a\n", "")
    assert (dict(os.environ), sys.argv, sys.path, sys.modules["__main__"]) == before


def test_options_may_stand_anywhere_and_the_scripts_own_come_behind_two_dashes(rig, say):
    expected = (0, "['a', '--seed', '--', 'b'] __main__ 2a\n", "")
    words = ("--seed", "3", "rig.toml", "script.py", "a", "--", "--seed", "--", "b")
    assert say("run", *words) == expected
    words = ("rig.toml", "script.py", "--seed=3", "a", "--", "--seed", "--", "b")
    assert say("run", *words) == expected


@pytest.mark.parametrize(
    ("line", "status", "told"),
    [
        ("sys.exit()", 0, ""),
        ("sys.exit(3)", 3, ""),
        ("sys.exit('enough')", 1, "enough\n"),
    ],
)
def test_a_scripts_exit_status_is_ours(rig, say, line, status, told):
    (rig / "script.py").write_text(f"import sys\n{line}\n")
    again = "again: motorhil run rig.toml script.py --seed 7\n" if status else ""
    assert say("run", "rig.toml", "script.py") == (status, "", told + again)


def test_a_scripts_exception_is_told_from_the_scripts_first_line_on(rig, say):
    (rig / "helper.py").write_text("def divide(a, b):\n    return a / b\n")
    (rig / "script.py").write_text("import helper\n\nhelper.divide(1, 0)\n")
    status, out, err = say("run", "rig.toml", "script.py", "-o", "x.mcap", "--", "a b")
    assert (status, out) == (1, "")
    assert err == (
        "Traceback (most recent call last):\n"
        '  File "script.py", line 3, in <module>\n'
        "    helper.divide(1, 0)\n"
        f'  File "{rig}/helper.py", line 2, in divide\n'
        "    return a / b\n"
        "           ~~^~~\n"
        "ZeroDivisionError: division by zero\n"
        "again: motorhil run rig.toml script.py --seed 7 -o x.mcap -- 'a b'\n"
    )


def test_what_the_motor_interface_refuses_is_told_without_its_insides(rig, say):
    (rig / "script.py").write_text(
        "import can\nfrom motorapi import runtime_of\nbus = can.Bus()\n"
        "runtime_of(bus).wait_until(lambda: False, -1.0)\n"
    )
    status, _, err = say("run", "rig.toml", "script.py")
    assert status == 1
    assert err.splitlines()[:3] == [
        "Traceback (most recent call last):",
        '  File "script.py", line 4, in <module>',
        "    runtime_of(bus).wait_until(lambda: False, -1.0)",
    ]
    assert err.splitlines()[3].startswith("motorapi.errors.UsageError: timeout_s = -1.0")


def test_what_a_party_raised_and_nobody_asked_for_is_the_scripts_failure(rig, say):
    (rig / "script.py").write_text(
        "import can\nfrom motorapi import runtime_of\nwith can.Bus() as bus:\n"
        "    runtime = runtime_of(bus)\n    runtime.spawn('second', lambda: 1 / 0)\n"
        "    runtime.wait_until(lambda: False, 1.0)\n"
    )
    status, _, err = say("run", "rig.toml", "script.py")
    assert status == 1
    lines = err.splitlines()
    assert lines[:2] == [
        "Traceback (most recent call last):",
        '  File "script.py", line 5, in <lambda>',
    ]
    assert "ZeroDivisionError: division by zero" in lines
    assert lines[-1].startswith("again: motorhil run")


def test_one_seed_is_one_record_whatever_the_hash_seed(bench, say):
    say("new", ".")
    digests = []
    for hash_seed in ("0", "1"):
        target = f"{hash_seed}.mcap"
        done = subprocess.run(
            [sys.executable, "-m", "harness", "run", "rig.toml", "drive.py", "-o", target],
            env={**environment(), "PYTHONHASHSEED": hash_seed},
            capture_output=True,
            timeout=30,
            check=True,
        )
        assert b"right is at 3.1416" in done.stdout
        digests.append(digest(target))
    assert digests[0] == digests[1]


def test_a_script_that_is_no_python_is_told_like_python_does(rig, say):
    (rig / "script.py").write_text("a = = 1\n")
    status, _, err = say("run", "rig.toml", "script.py")
    assert status == 1
    assert err.startswith('  File "script.py", line 1\n')
    assert "SyntaxError: invalid syntax" in err


def test_errors_a_script_chains_are_all_told(rig, say):
    (rig / "script.py").write_text("try:\n    1/0\nexcept Exception as e:\n    raise KeyError(1)\n")
    _, _, err = say("run", "rig.toml", "script.py")
    assert err.index("ZeroDivisionError") < err.index("During handling") < err.index("KeyError: 1")
    assert "harness" not in err


def test_a_script_can_come_from_standard_input(rig):
    done = in_another_process("run", "rig.toml", "-", "a", input=SCRIPT)
    assert (done.returncode, done.stdout) == (0, "['a'] __main__ 2a\n")
    done = in_another_process("run", "rig.toml", "-", input="x = 1\nx / 0\n")
    assert done.returncode == 1
    assert '  File "<stdin>", line 2, in <module>\n    x / 0\n' in done.stderr


def test_without_a_script_there_is_a_prompt_with_the_rig(rig):
    lines = "rig.seed + 35\nrig.runtime.run_for(2.5); rig.runtime.now_ns()\nexit(3)\n"
    done = in_another_process("run", "rig.toml", input=lines)
    assert done.returncode == 3
    assert "42" in done.stdout
    assert "2500000000" in done.stdout
    assert "rig: motors left, right; time passes while you wait" in done.stderr
    assert in_another_process("run", "rig.toml", input="").returncode == 0


@pytest.mark.wall
def test_ctrl_c_ends_a_script_with_130_and_one_line(rig):
    (rig / "script.py").write_text(
        "from motorapi import runtime_of\nimport can\nwith can.Bus() as bus:\n"
        "    print('up', flush=True)\n    runtime_of(bus).wait_until(lambda: False, 3600.0)\n"
    )
    command = [sys.executable, "-m", "harness", "run", "--realtime", "rig.toml", "script.py"]
    with subprocess.Popen(
        command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "up\n"
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=10)
    assert process.returncode == 130
    assert err == "motorhil: interrupted\n"


def test_output_that_nobody_reads_is_no_error(rig):
    (rig / "script.py").write_text("for n in range(100_000): print('line', n)\n")
    command = f"{sys.executable} -m harness run rig.toml script.py | head -n 1"
    done = subprocess.run(
        command, shell=True, env=environment(), capture_output=True, text=True, timeout=30
    )
    assert (done.stdout, done.stderr) == ("line 0\n", "")


def test_a_record_that_cannot_be_finished_is_one_line_and_not_the_scripts_fault(rig):
    (rig / "script.py").write_text(
        "from motorapi import runtime_of\nimport can\nwith can.Bus() as bus:\n"
        "    task = bus.send_periodic(can.Message(arbitration_id=1), 0.0005)\n"
        "    runtime_of(bus).wait_until(lambda: False, 10.0)\n"
    )
    command = f"ulimit -f 8; {sys.executable} -m harness run rig.toml script.py -o x.mcap"
    done = subprocess.run(
        ["bash", "-c", command], env=environment(), capture_output=True, text=True, timeout=30
    )
    assert done.returncode == 2
    assert done.stderr.startswith("x.mcap: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.wall
def test_realtime_takes_its_time(rig, say):
    (rig / "script.py").write_text(
        "from motorapi import runtime_of\nimport can\n"
        "runtime_of(can.Bus()).wait_until(lambda: False, 0.1)\n"
    )
    start_s = time.monotonic()
    assert say("run", "--realtime", "rig.toml", "script.py") == (0, "", "")
    assert time.monotonic() - start_s >= 0.1


# --- new, and the examples


def test_new_writes_a_rig_that_is_right_and_a_script_that_runs(bench, say):
    status, out, err = say("new", "wheels")
    assert (status, err) == (0, "next: motorhil run wheels/rig.toml wheels/drive.py\n")
    assert out.splitlines() == [
        "wheels/rig.toml",
        "wheels/wheel_model.toml",
        "wheels/drive.py",
        "wheels/rig.schema.json",
    ]
    assert say("check", "wheels/rig.toml")[0] == 0
    status, out, _ = say("run", "wheels/rig.toml", "wheels/drive.py")
    assert (status, out) == (
        0,
        "left is at 6.2832 rad\nleft is at 0.0000 rad\nright is at 3.1416 rad\n",
    )
    assert "#:schema ./rig.schema.json" in (bench / "wheels/rig.toml").read_text()


def test_new_writes_over_nothing(bench, say):
    (bench / "drive.py").write_text("mine")
    assert say("new", ".") == (
        2,
        "",
        "drive.py: is there already; name another folder: motorhil new DIR\n",
    )
    assert [path.name for path in bench.iterdir()] == ["drive.py"]
    status, _, err = say("new", "drive.py/below")
    assert (status, err.count("\n")) == (2, 1)
    assert err.startswith("drive.py/below: cannot be written: ")


def test_every_example_is_listed_and_right(bench, say):
    status, out, _ = say("list", "examples", "--json")
    examples = json.loads(out)
    assert [example["name"] for example in examples] == ["rover", "two_wheels"]
    for example in examples:
        status, _, err = say("check", example["path"])
        assert (status, err) == (0, "")
        assert example["about"]


# --- list


def test_list_shows_what_is_installed_and_where_our_own_eds_is(bench, say):
    status, out, _ = say("list", "controllers")
    assert status == 0
    lines = {line.split()[0]: line for line in out.splitlines()}
    assert list(lines) == ["broken", "cia402", "echo"]
    assert "bench 1.0" in lines["echo"]
    eds = Path(lines["cia402"].split()[-1])
    assert eds.name == "motorhil_cia402.eds"
    assert eds.is_file()
    assert say("list", "adaptations", "--json")[1].startswith(
        '[{"name": "bare", "builder": "tests.'
    )
