"""Issue 2, item 10: the hot cores as machine code are the same cores.

`make compiled` builds them into .venv-compiled, unless what is there is of these very sources. What
Hypothesis draws is drawn less often than of the pure cores, which run just these tests at length.
"""

import contextlib
import fcntl
import os
import shutil
import signal
import subprocess
import sys

import pytest

from harness.build_info import cores_are_compiled, source_digest
from tests.architecture.checkout import CHECKOUT

pytestmark = [pytest.mark.compiled, pytest.mark.timeout(1800)]

COMPILED = CHECKOUT / ".venv-compiled" / "bin"
LEVEL = "OPTIMISE=0"  # of gcc's -O; 2, as shipped, takes it 80 s longer and rounds the same
FOLDERS = ("determinism", "emulators", "traces", "harness", "motorapi")
# What is in there is interpreted in both builds, or runs long over what others cover: without it
# every compiled function that any of these folders calls is still called (seen by sys.settrace).
LEFT_OUT = (
    *("motorapi/functions", "motorapi/generation", "motorapi/takeover", "motorapi/test_*lock*.py"),
    *("motorapi/test_sharing.py", "motorapi/test_wall_*.py", "motorapi/test_skew*.py"),
    *("harness/sharing", "harness/recording", "harness/report", "harness/test_cli*.py"),
    "harness/test_demo*.py",  # whose digests determinism/test_demo.py compares
    *("harness/replay/test_replay_verb.py", "harness/replay/test_hostile_use.py"),
    *("harness/replay/test_traffic.py", "harness/replay/test_imported.py"),
    *("traces/test_formats*.py", "traces/test_recovery.py", "traces/test_*tape*.py"),
    *("traces/test_*cap*.py", "traces/test_asc.py", "traces/test_blf.py", "traces/test_trc.py"),
    *("traces/test_candump.py", "traces/test_csv_traffic.py", "traces/test_modbus*.py"),
    *("traces/test_real_traffic.py", "traces/test_decode*.py", "traces/test_tcp_streams.py"),
    "traces/test_damaged_lines.py",
    *("harness/test_pytest*.py", "harness/test_new_ci.py"),  # they run pytest as a program
)


@pytest.fixture(scope="module")
def built():
    """The environment is of these sources; nobody rebuilds it meanwhile."""
    if cores_are_compiled():
        pytest.skip("these tests themselves run in the compiled build")
    compiler = os.environ.get("CC", "cc").split()[0]
    for program in (compiler, "make"):
        if shutil.which(program) is None:
            pytest.skip(f"no {program!r} here: the compiled cores are not built")
    (CHECKOUT / "build").mkdir(exist_ok=True)
    with (CHECKOUT / "build" / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        status, printed = make("compiled", LEVEL)
        assert status == 0, printed[-6000:]
        yield


def make(*words):
    """(exit status, what it printed); nothing of it goes on when these tests are interrupted."""
    # The program that runs, by itself: an environment made by make would be taken for ready.
    variables = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    variables.setdefault("MOTORHIL_HYPOTHESIS", "brief")
    with subprocess.Popen(
        ["make", "--no-print-directory", *words, f"PYTHON={sys._base_executable}"],
        cwd=CHECKOUT,
        env=variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as made:
        try:
            printed = made.communicate()[0]
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(made.pid, signal.SIGKILL)
    return made.returncode, printed


def run(program, folder, hash_seed, *words):
    folder.mkdir()
    return subprocess.run(
        [program, *words],
        cwd=folder,
        env={**os.environ, "PYTHONHASHSEED": str(hash_seed)},
        capture_output=True,
        text=True,
        check=True,
    ).stdout


def test_the_version_says_that_it_is_compiled_and_of_which_source(built, tmp_path):
    said = run(COMPILED / "motorhil", tmp_path / "here", 0, "--version")
    assert "compiled cores" in said
    assert f"source {source_digest()} in {CHECKOUT / '.venv-compiled'}" in said


def test_what_is_hot_is_machine_code_and_nothing_compiled_lies_beside_the_sources(built, tmp_path):
    names = (
        "emulators.event_queue emulators.world emulators.media.can_bus emulators.firmware.servo "
        "emulators.plant.dc_motor emulators.canopen.node emulators.cia402.drive "
        "harness.virtual_time traces.fields"
    )
    code = f"from importlib import import_module\nfor n in {names.split()}:\n"
    code += "    print(import_module(n).__file__)"
    files = run(COMPILED / "python", tmp_path / "here", 0, "-c", code).split()
    assert len(files) == len(names.split())
    assert [file for file in files if not file.endswith(".so")] == []
    assert [
        path for name in ("emulators", "harness") for path in CHECKOUT.glob(f"{name}/**/*.so")
    ] == []


def test_the_compiled_cores_pass_the_same_tests(built):
    words = [f"tests/{folder}" for folder in FOLDERS]
    words += [f"--ignore-glob=tests/{place}" for place in LEFT_OUT]
    status, printed = make("test-compiled", LEVEL, "TESTS=" + " ".join(words))
    assert status == 0, printed[-7000:]
    assert " passed" in printed
