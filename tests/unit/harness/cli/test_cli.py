import gc
import json
import os
import re
import resource
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from motorhil.__main__ import ALLOCATIONS, start
from tests.support.checkout import CHECKOUT
from tests.support.command_line import environment, in_another_process
from tests.support.plugin_rigs import GOOD

# --- help and version


def test_help_imports_no_large_library():
    code = (
        "import sys\nfrom motorhil.harness.cli.main import main\nmain(['--help'])\n"
        "print([name for name in ('can', 'canopen', 'pymodbus', 'numpy', 'asyncio', 'mcap')"
        " if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "[]\n"
    assert "run a script, or a prompt, with a rig around it" in done.stdout


def test_command_collects_garbage_less_often(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["python -m motorhil", "--version"])
    usual = gc.get_threshold()
    try:
        gc.set_threshold(700)
        assert start() == 0
        assert gc.get_threshold()[0] == ALLOCATIONS > 700
    finally:
        gc.set_threshold(*usual)


def test_help_lists_verbs_and_each_verb_has_help(say):
    status, out, _ = say("--help")
    assert status == 0
    verbs = re.findall(r"^ {4}(\w+)", out, re.MULTILINE)
    assert {"new", "check", "run", "list"} <= set(verbs)
    for verb in verbs:
        status, out, _ = say(verb, "--help")
        assert status == 0
        assert out.startswith(f"usage: motorhil {verb}")


def test_version_names_cores_and_source(say):
    status, out, _ = say("--version")
    assert status == 0
    assert out.startswith("motorhil ")
    assert "pure Python cores, source " in out or "compiled cores, source " in out


@pytest.mark.parametrize("words", [(), ("-x",), ("run",), ("list", "nonsense")])
def test_wrong_usage_is_reported_on_stderr_with_status_2(say, words):
    status, out, err = say(*words)
    assert (status, out) == (2, "")
    assert "usage: motorhil" in err


# --- check


def test_check_prints_contents_of_rig(rig, say):
    status, out, err = say("check", "rig.toml")
    assert (status, err) == (0, "")
    assert out == "rig.toml: rig: 1 bus, 2 controllers, 2 motors\n"


def test_check_prints_json(rig, say):
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
def test_bad_input_is_reported_with_line_key_and_remedy(rig, say, verb, what):
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
        (
            ("run", "rig.toml", "-o", "script.py"),
            "script.py: is not a recording, and would be overwritten;",
        ),
    ],
)
def test_missing_file_is_reported_in_one_line(rig, say, words, told):
    status, out, err = say(*words)
    assert (status, out) == (2, "")
    assert err.startswith(told)
    assert err.count("\n") == 1


def test_missing_argument_is_named_alone(say):
    assert say("run")[2].endswith("error: the following arguments are required: RIG\n")


def test_check_reports_errors_of_motor_builders(rig, say):
    (rig / "rig.toml").write_text(GOOD.replace('"left"\n[', '"left"\nheartbeat = 1\n[', 1))
    status, out, err = say("check", "rig.toml")
    assert (status, out) == (2, "")
    assert err.startswith("rig.toml:17: motor.left.heartbeat: ")


def test_bad_input_leaves_no_threads_and_no_traceback(rig):
    (rig / "rig.toml").write_text(GOOD.replace("seed", "sede"))
    done = in_another_process("run", "rig.toml", "script.py")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr


# --- new, and the examples


def test_new_writes_valid_rig_and_running_script(bench, say):
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


def test_new_script_names_files_beside_it(bench, say):
    assert say("new", "wheels")[0] == 0
    script = (bench / "wheels" / "drive.py").read_text()
    assert "motorhil run rig.toml drive.py" in script
    assert "two_wheels" not in script


def test_new_overwrites_no_file(bench, say):
    (bench / "drive.py").write_text("mine")
    assert say("new", ".") == (
        2,
        "",
        "drive.py: already exists; name another folder: motorhil new DIR\n",
    )
    assert [path.name for path in bench.iterdir()] == ["drive.py"]
    status, _, err = say("new", "drive.py/below")
    assert (status, err.count("\n")) == (2, 1)
    assert err.startswith("drive.py/below: cannot be written: ")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("", "an empty name; name a folder, or . for this one"),
        ("a\nb", "is not the name of a folder; use printable characters only"),
        ("a" * 300, "cannot be written: File name too long; name another folder"),
        ("\0", "is not the name of a folder; use printable characters only"),
        ("file", "file: cannot be written: File exists; name another folder"),
        ("file/inner", "file/inner: cannot be written: Not a directory; name another folder"),
        ("/proc/none", "/proc/none: cannot be written: No such file or directory; name another"),
    ],
)
def test_new_refuses_a_bad_name_in_one_line(bench, say, name, told):
    Path("file").write_text("")
    status, out, err = say("new", name)
    assert (status, out) == (2, "")
    assert told in err.splitlines()[-1]
    assert "Traceback" not in err


def test_new_prints_a_next_step_that_runs(bench, say):
    _, _, err = say("new", "my rig")
    words = shlex.split(err.removeprefix("next: "))
    assert words[0] == "motorhil"
    status, out, _ = say(*words[1:])
    assert (status, out.count("rad\n")) == (0, 3)


def test_new_leaves_no_partial_files(bench, say, monkeypatch):
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, limit[1]))  # the schema is larger
    try:
        status, out, err = say("new", "wheels")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert (status, out) == (2, "")
    assert err == "wheels: cannot be written: File too large; name another folder\n"
    assert list(bench.iterdir()) == []
    assert say("new", "wheels")[0] == 0


def test_every_example_is_listed_and_valid(bench, say):
    status, out, _ = say("list", "examples", "--json")
    examples = json.loads(out)
    assert [example["name"] for example in examples] == [
        *("fido", "four_protocols", "ideal_wheels", "rocky8", "rover", "two_wheels")
    ]
    for example in examples:
        status, _, err = say("check", example["path"])
        assert (status, err) == (0, "")
        assert example["about"]


# --- list


def test_list_prints_plugins_and_own_eds_files(bench, say):
    status, out, _ = say("list", "controllers")
    assert status == 0
    lines = {line.split()[0]: line for line in out.splitlines()}
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    own = project["entry-points"]["motorhil.controllers"]
    assert list(lines) == sorted([*own, "broken", "echo"])
    assert "bench 1.0" in lines["echo"]
    eds = Path(lines["cia402"].split()[-1])
    assert eds.name == "motorhil_cia402.eds"
    assert eds.is_file()
    assert say("list", "adaptations", "--json")[1].startswith(
        '[{"name": "bare", "builder": "tests.'
    )


# --- interrupts, and output that cannot be written


def test_interrupt_while_loading_is_reported_in_one_line():
    code = (
        "import sys\nfrom motorhil.__main__ import start\n"
        "class Interrupt:\n    def find_spec(self, name, *_):\n"
        "        if name == 'argparse':\n            raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Interrupt())\nsys.exit(start())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "motorhil: interrupted\n")


@pytest.mark.parametrize("words", [("--version",), ("list", "examples")])
def test_full_disk_behind_stdout_is_reported_in_one_line(bench, words):
    with open("/dev/full", "w") as full:
        done = in_another_process(*words, stdout=full)
    assert done.returncode == 2
    assert done.stderr == (
        "motorhil: standard output cannot be written: No space left on device; free space there, "
        "or send it elsewhere\n"
    )


def test_closed_standard_streams_do_no_harm(rig):
    for close in (">&-", "2>&-", "<&- >&- 2>&-"):
        command = ["sh", "-c", f'exec "$@" {close}', "sh", sys.executable, "-m", "motorhil"]
        done = subprocess.run(
            [*command, "run", "rig.toml", "script.py", "-o", "x.mcap"],
            env=environment(),
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert (done.returncode, done.stderr) == (0, "")
        done = subprocess.run([*command, "check", "x"], env=environment(), timeout=120)
        assert done.returncode == 2


def test_results_without_a_reader_end_as_of_sigpipe(bench):
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as pipe:
        done = in_another_process("list", "examples", stdout=pipe)
    assert (done.returncode, done.stderr) == (141, "")


def test_results_for_a_closed_stdout_are_told(bench):
    command = ["sh", "-c", 'exec "$@" >&-', "sh", sys.executable, "-m", "motorhil"]
    for words in (["list", "examples"], ["--help"]):
        done = subprocess.run(
            [*command, *words], env=environment(), capture_output=True, text=True, timeout=120
        )
        told = "motorhil: standard output is closed, and its results are lost; send it to a file"
        assert (done.returncode, done.stderr) == (2, f"{told} or a pipe\n")


@pytest.fixture
def plugin(rig, monkeypatch):
    """A function that writes a plug-in `broken` for the left controller, in this module."""

    def write(module, text):
        (rig / f"{module}.py").write_text(text)
        listing = rig.parent / "site" / "bench-1.0.dist-info" / "entry_points.txt"
        listing.write_text(listing.read_text().replace("tests.unit.harness.no_such_module", module))
        (rig / "rig.toml").write_text(GOOD.replace('"echo"', '"broken"', 1))
        monkeypatch.syspath_prepend(rig)
        return rig / f"{module}.py"

    return write


LEFT_KIND = 'rig.toml:6: controller.left.kind: plugin "broken" '


@pytest.mark.parametrize("name", ["vesc", "cia401"])
def test_new_drive_of_installed_name_is_refused(bench, say, name):
    """Installed, the new package was hidden by the one of motorhil."""
    status, out, err = say("new", "package", "--drive", name)
    assert (status, out) == (2, "")
    assert err.startswith(f"package: {name!r} is a kind of motorhil ")
    assert err.endswith(
        "which is installed; use another name; the new package would not be found\n"
    )
    assert not (bench / "package").exists()


@pytest.mark.parametrize("name", ["", "2wheels", "Acme", "acme-2", "a" * 33, "../acme"])
def test_new_drive_of_impossible_name_is_refused(bench, say, name):
    told = f"{name!r} is not the name of a drive; use up to 32 of a-z, 0-9 and _, a letter first"
    assert say("new", "package", "--drive", name) == (2, "", f"package: {told}\n")
    assert not (bench / "package").exists()


def test_plugin_that_exits_when_imported_is_reported(plugin, say):
    plugin("leaving_plugin", "import sys\nsys.exit(0)\n")
    assert say("check", "rig.toml") == (
        2,
        "",
        f"{LEFT_KIND}cannot be loaded from leaving_plugin:controller: SystemExit: 0; "
        "reinstall bench 1.0\n",
    )


@pytest.mark.parametrize(
    ("version", "remedy"), [(2, "upgrade motorhil"), (0, "install a newer release of the plugin")]
)
def test_plugin_for_another_api_version_is_refused(plugin, say, version, remedy):
    text = f"from motorhil.emulators.api import controller as mark\n@mark(api={version})\n"
    plugin(
        f"plugin_for_{version}",
        text + "def controller(settings, context):\n    raise AssertionError\n",
    )
    assert say("check", "rig.toml") == (
        2,
        "",
        f"{LEFT_KIND}(plugin_for_{version}:controller) was written for version {version} of"
        f" motorhil.emulators.api; this motorhil has version 1; {remedy}\n",
    )


STARTER = """\
class controller:
    wants_sent = lambda self: False
    identifiers = next_deadline_ns = lambda self: None
    identifiers_revision = lambda self: 0
    __init__ = lambda self, settings, context: None

    def start(self, now_ns):
        raise RuntimeError("no power")
"""
FAILING_PLUGINS = {
    "raising": (
        "def controller(settings, context):\n    return settings['gone']\n",
        "KeyError: 'gone' ({path}:2)",
    ),
    "leaving": (
        "import sys\n\ncontroller = lambda settings, context: sys.exit(1)\n",
        "SystemExit: 1 ({path}:3)",
    ),
    "empty": (
        "controller = lambda settings, context: None\n",
        "TypeError: it built None, which is",
    ),
    "starting": (STARTER, "RuntimeError: no power ({path}:8)"),
}


@pytest.mark.parametrize("name", FAILING_PLUGINS)
def test_failing_plugin_is_reported_with_line(plugin, say, name):
    text, told = FAILING_PLUGINS[name]
    path = plugin(f"{name}_plugin", text)
    status, out, err = say("check", "rig.toml")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"{LEFT_KIND}failed: {told.format(path=path)}")
    assert err.endswith("; fix it, or report it to the author of bench 1.0\n")


def test_group_of_two_motors_on_one_drive_is_reported(bench, say):
    say("new", ".")
    text = (bench / "rig.toml").read_text().replace('controller = "right"', 'controller = "left"')
    (bench / "rig.toml").write_text(text)
    line = text[: text.index("motors = [")].count("\n") + 1
    status, out, err = say("check", "rig.toml")
    assert (status, out) == (2, "")
    assert err == (
        f"rig.toml:{line}: group.both.motors[1]: right and left are the same physical motor, "
        "can0 node 1: a group can move it only once; remove one of them\n"
    )


@pytest.mark.parametrize("words", [("help",), ("--help",)])
def test_help_lists_the_verbs(say, words):
    status, out, _ = say(*words)
    assert status == 0
    assert "judge" in out


def test_help_of_a_verb_is_that_verbs(say):
    assert say("help", "show") == say("show", "--help")


@pytest.mark.parametrize(
    ("word", "hint"),
    [
        ("jugde", "did you mean 'motorhil judge'?"),
        ("reply", "did you mean 'motorhil replay'?"),
        ("xyzzy", "see 'motorhil help'"),
    ],
)
def test_unknown_verb_is_one_line_with_the_nearest(say, word, hint):
    assert say(word) == (2, "", f"motorhil: {word!r} is not a verb; {hint}\n")
