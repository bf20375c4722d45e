"""The client program on libmodbus, and what it says."""

import shutil
import subprocess
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[2] / "crosscheck" / "modbus" / "libmodbus_client.c"
SAID = ["0", "123", "1", "1", "1", "-10"]


def libmodbus_client(folder: Path) -> str:
    """Return the path of the compiled client, in this folder; skip without libmodbus."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("there is no C compiler (cc)")
    program = folder / "client"
    built = subprocess.run(
        [compiler, "-I/usr/include/modbus", str(SOURCE), "-o", str(program), "-lmodbus"],
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    if built.returncode and ("modbus.h" in built.stderr or "-lmodbus" in built.stderr):
        pytest.skip("libmodbus is not installed: apt-get install libmodbus-dev")
    assert built.returncode == 0, built.stderr
    return str(program)
