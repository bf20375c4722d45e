"""Runs `tests/system/vcan/inside` on real vcan interfaces, or skips with the reason."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.system.vcan import runner

CHECKOUT = Path(__file__).parents[3]


@pytest.mark.vcan
@pytest.mark.timeout(300)
def test_on_real_socketcan(capfd, record_property):
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider"]
    inside = str(Path(__file__).parent / "inside")
    try:
        status = runner.run([*command, "--override-ini", "python_files=on_*.py", inside])
    except (runner.NoWayError, subprocess.CalledProcessError) as reason:
        pytest.skip(f"no vcan here: {reason}")
    output = capfd.readouterr().out
    assert status == 0, output
    assert " passed" in output, output
    record_property("on real vcan", output.strip().splitlines()[-1])
