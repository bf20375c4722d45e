"""Builds of compiled cores through the Makefile, one at a time."""

import contextlib
import fcntl
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.checkout import CHECKOUT

LEVEL = "OPTIMISE=0"  # lowest -O level of gcc; 2, as shipped, compiles longer and rounds the same


@contextlib.contextmanager
def nobody_else_builds():
    """Lock the compiled build against other builds; skip if nothing can be compiled here."""
    compiler = os.environ.get("CC", "cc").split()[0]
    for program in (compiler, "make"):
        if shutil.which(program) is None:
            pytest.skip(f"no {program!r} here: the compiled cores are not built")
    (CHECKOUT / "build").mkdir(exist_ok=True)
    with (CHECKOUT / "build" / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def make(*words, folder=CHECKOUT, **environment):
    """Run make; return (exit status, output). Kill its processes if the tests are interrupted."""
    # The base interpreter, because an environment made by make would count as ready.
    variables = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    variables.setdefault("MOTORHIL_HYPOTHESIS", "brief")
    with subprocess.Popen(
        ["make", "--no-print-directory", *words, f"PYTHON={sys._base_executable}"],
        cwd=folder,
        env={**variables, **environment},
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


def clone(folder, *packages):
    """Return a folder with these packages that make treats as the checkout."""
    for name in (*packages, "setup.py", "pyproject.toml", "requirements.lock", "Makefile"):
        copy = shutil.copytree if (CHECKOUT / name).is_dir() else shutil.copy2
        copy(CHECKOUT / name, folder / name)
    for name in ("README.md", "LICENSE"):
        shutil.copy2(CHECKOUT / name, folder / name)
    (folder / ".venv").mkdir()
    for path in Path(sys.prefix).iterdir():
        (folder / ".venv" / path.name).symlink_to(path)
    (folder / ".venv" / ".ready").unlink(missing_ok=True)
    (folder / ".venv" / ".ready").touch()  # nothing has to be installed
    return folder


def demo(folder, *words, **environment):
    status, printed = make("demo", *words, folder=folder, **environment)
    assert status == 0, printed
    return printed


def digest_in(said):
    return re.search(r"digest ([0-9a-f]{64})", said)[1]
