"""Sharing suites without Hypothesis: only the machines need it."""

import subprocess
import sys

HIDE = "import sys; sys.modules['hypothesis'] = None; "


def python(code):
    command = [sys.executable, "-c", HIDE + code]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_machine_without_hypothesis_names_the_remedy():
    done = python("import motorhil.harness.sharing_tests.state_machine")
    assert done.stderr.splitlines()[-1] == (
        "ImportError: this module needs Hypothesis: pip install 'motorhil[test]'"
    )


def test_other_modules_work_without_hypothesis():
    modules = ("history", "linearizability", "processes", "arena", "workers", "bus_evidence")
    done = python("; ".join(f"import motorhil.harness.sharing_tests.{name}" for name in modules))
    assert (done.returncode, done.stderr) == (0, "")
