"""C programs of the tests, each compiled once in a process, on first use."""

import atexit
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import pytest

SOURCES = Path(__file__).parent / "binaries"
COMPILER = os.environ.get("CC", "cc")

needs_compiler = pytest.mark.skipif(
    shutil.which(COMPILER) is None, reason=f"needs a C compiler ({COMPILER})"
)


def compiled(name, folder, *flags):
    """Return the path of a compiled program of tests/support/programs/binaries."""
    return Path(shutil.copy2(_built(name, flags), folder / name))


@cache
def _built(name, flags):
    folder = Path(tempfile.mkdtemp(prefix="motorhil-binaries-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    source = next(SOURCES.glob(f"{name}.c*"))
    target = folder / name
    compiler = COMPILER if source.suffix == ".c" else os.environ.get("CXX", "c++")
    if shutil.which(compiler) is None:
        pytest.skip(f"needs a C++ compiler ({compiler})")
    command = [compiler, "-O1", "-Wall", "-Wextra", "-Werror", *flags, str(source)]
    done = subprocess.run([*command, "-o", str(target), "-lpthread"], check=False, timeout=120)
    if done.returncode and "-static" in flags:
        pytest.skip("needs a static C library")
    done.check_returncode()
    return target
