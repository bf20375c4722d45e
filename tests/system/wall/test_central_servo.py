"""Central servo on the wall clock between processes: exclusion, supervision."""

import sys
from pathlib import Path

import pytest

from tests.system.wall.test_serve import motorhil

pytestmark = pytest.mark.wall

SCRIPT = str(Path(__file__).parents[2] / "support" / "programs" / "patient_servo.py")
RIG = """
[rig]
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.io]
kind = "cia401"
bus = "can0"
node_id = 1
"""


def test_killed_servo_is_detected_and_another_takes_over(tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    done = motorhil("serve", str(rig), "--", sys.executable, SCRIPT)
    assert (done.stderr, done.returncode) == ("", 0)
    assert done.stdout.split("\n")[:-1] == [
        "holding",
        "taken by the victim",
        "missed 0 inputs",  # neither ready nor fault: switched off
        "0.50",
        "next",
    ]
