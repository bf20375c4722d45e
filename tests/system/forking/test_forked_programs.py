"""Programs that tests start by fork behave like programs that Python starts."""

import json
import os
import signal
import subprocess
import sys
from contextlib import nullcontext

import pytest

from motorhil.harness.version import cores_are_compiled
from tests.support.command_line import in_another_process
from tests.support.forking.client import executing

pytestmark = pytest.mark.wall

TELLS = """
import json, os, signal, sys
signals = (signal.SIGINT, signal.SIGTERM, signal.SIGPIPE)
facts = {
    "argv": sys.argv,
    "orig": sys.orig_argv[1:],
    "path": sys.path[:3],
    "file": __file__,
    "name": __name__,
    "main": vars(sys.modules["__main__"]) is globals(),
    "cwd": os.getcwd(),
    "environment": dict(os.environ),
    "parent": os.getppid(),
    "fds": sorted(os.listdir("/proc/self/fd")),
    "group": os.getpgid(0) == os.getpid(),
    "session": os.getsid(0) == os.getpid(),
    "signals": [str(signal.getsignal(one)) for one in signals],
    "streams": [
        (one.name, one.mode, one.encoding, one.errors, one.line_buffering, one.write_through)
        for one in (sys.stdin, sys.stdout, sys.stderr)
    ],
    "flags": [sys.flags.safe_path, sys.flags.dont_write_bytecode],
    "input": sys.stdin.read(),
    "sibling": __import__("sibling").__name__,
}
print(json.dumps(facts))
"""


@pytest.fixture(params=["executed", "forked"])
def started(request):
    """Start programs in either way."""
    with executing() if request.param == "executed" else nullcontext():
        yield request.param


def told(folder, *words, **options):
    usual = {"input": "in", "text": True, "cwd": folder, "check": True}
    done = subprocess.run(
        [sys.executable, *words], **usual | options, stdout=subprocess.PIPE, timeout=60
    )
    return json.loads(done.stdout)


@pytest.fixture
def script(tmp_path):
    (tmp_path / "tells.py").write_text(TELLS)
    (tmp_path / "sibling.py").touch()
    return tmp_path


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"start_new_session": True},
        {"process_group": 0},
        {"env": {**os.environ, "PYTHONUNBUFFERED": "1", "ONE": "1"}},
    ],
)
def test_program_finds_the_same_in_either_way(script, options):
    words = ("tells.py", "a", "b c")
    options = {"env": dict(os.environ), **options}  # readline adds LINES behind Python's back
    forked = told(script, *words, **options)
    with executing():
        assert told(script, *words, **options) == forked
    assert forked["parent"] == os.getpid()
    assert forked["argv"] == list(words)


def test_open_files_are_passed_on_and_no_others(script, started):
    reading, writing = os.pipe()
    other = os.dup(writing)
    os.set_inheritable(other, True)
    (script / "writes.py").write_text(f"import os; os.write({writing}, b'told')")
    words = [sys.executable, "writes.py"]
    subprocess.run(words, cwd=script, pass_fds=[writing], check=True)
    assert os.read(reading, 9) == b"told"
    (script / "writes.py").write_text(f"import os; os.write({other}, b'told')")
    done = subprocess.run(words, cwd=script, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 1
    assert "Bad file descriptor" in done.stderr
    for fd in (reading, writing, other):
        os.close(fd)


@pytest.mark.parametrize(
    ("code", "status", "error"),
    [
        ("raise SystemExit(7)", 7, ""),
        ("raise SystemExit('words')", 1, "words\n"),
        ("import os; os._exit(9)", 9, ""),
        ("import os; os.kill(os.getpid(), 9)", -9, ""),
        ("import os, signal; os.kill(os.getpid(), signal.SIGTERM)", -15, ""),
        ("import atexit; atexit.register(print, 'late')", 0, ""),
        ("1 / 0", 1, None),
        ("def f(): return g()\ndef g(): raise OSError from KeyError()\nf()", 1, None),
        ("a b", 1, None),
        ("raise KeyboardInterrupt", -2, None),
    ],
)
def test_program_ends_in_the_same_way(tmp_path, code, status, error):
    (tmp_path / "ends.py").write_text(code)

    def end():
        words = [sys.executable, "ends.py"]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
        return done.returncode, done.stdout, done.stderr

    ended = end()
    with executing():
        assert end() == ended
    assert ended[0] == status
    assert error is None or ended[2] == error


def test_program_has_its_group_from_the_start(tmp_path, started):
    (tmp_path / "waits.py").write_text("import signal; signal.pause()")
    words = [sys.executable, "waits.py"]
    for options in ({"start_new_session": True}, {"process_group": 0}):
        with subprocess.Popen(words, cwd=tmp_path, **options) as program:
            assert os.getpgid(program.pid) == program.pid
            os.killpg(program.pid, signal.SIGKILL)


def test_program_is_paused_and_killed_by_its_process_id(tmp_path, started):
    (tmp_path / "waits.py").write_text("print('up', flush=True)\nimport signal; signal.pause()")
    words = [sys.executable, "waits.py"]
    with subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout.readline() == "up\n"
        program.send_signal(signal.SIGSTOP)
        assert os.WIFSTOPPED(os.waitpid(program.pid, os.WUNTRACED)[1])
        program.kill()
        assert program.wait(60) == -signal.SIGKILL


def test_program_runs_on_the_cores_of_this_process(started):
    assert ("compiled cores" in in_another_process("--version").stdout) == cores_are_compiled()


@pytest.mark.parametrize("name", ["numpy", "can", "motorhil"])
def test_program_that_would_import_another_module_imports_it(tmp_path, name):
    (tmp_path / f"{name}.py").write_text("OTHER = True")
    (tmp_path / "imports.py").write_text(f"import {name}; print({name}.OTHER)")
    words = [sys.executable, "imports.py"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "True\n", done.stderr


def test_hash_seed_of_its_environment_is_the_programs(tmp_path):
    (tmp_path / "hashes.py").write_text("print(hash('one'))")
    words = [sys.executable, "hashes.py"]

    def hashed(seed):
        env = {**os.environ, "PYTHONHASHSEED": seed}
        return subprocess.run(words, cwd=tmp_path, env=env, capture_output=True, text=True).stdout

    assert hashed("1") == hashed("1") != hashed("2")
