"""Hypothesis is needed by the machines alone, and who has not got it is told how to get it."""

import subprocess
import sys

HIDE = "import sys; sys.modules['hypothesis'] = None; "


def python(code):
    command = [sys.executable, "-c", HIDE + code]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_who_lacks_hypothesis_is_told_how_to_install_it():
    done = python("import harness.sharing.machine")
    assert done.stderr.splitlines()[-1] == (
        "ImportError: harness.sharing.machine needs Hypothesis: pip install 'motorhil[test]'"
    )


def test_processes_and_evidence_do_without_it():
    modules = ("history", "linearizability", "processes", "arena", "desk", "drivers", "evidence")
    done = python("; ".join(f"import harness.sharing.{name}" for name in modules))
    assert (done.returncode, done.stderr) == (0, "")
