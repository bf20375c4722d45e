"""The class of the hardware object, as a type checker knows it."""

import subprocess
import sys

import pytest

from tests.support.checkout import CHECKOUT

PROGRAM = """
from typing import Any, assert_type

from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.host_servo.hardware import AmplifierHwMotor
from motorhil.motorapi.adaptations.host_servo.motor import SoftwareMotor
from motorhil.motorapi.adaptations.ideal.hardware import IdealHwMotor
from motorhil.motorapi.adaptations.ideal.motor import IdealMotor
from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.adaptations.leadshine.motor import LeadshineMotor
from motorhil.motorapi.adaptations.oriental_az.hardware import OrientalAzHwMotor
from motorhil.motorapi.adaptations.oriental_az.motor import OrientalAzMotor
from motorhil.motorapi.motor import Motor


def use(a: Cia402Motor, b: SoftwareMotor, c: IdealMotor, d: LeadshineMotor) -> None:
    with a.low_level() as hardware_a:
        assert_type(hardware_a, Cia402HwMotor)
    with b.low_level(timeout_s=1) as hardware_b:
        assert_type(hardware_b, AmplifierHwMotor)
    with c.low_level() as hardware_c:
        assert_type(hardware_c, IdealHwMotor)
    with d.low_level() as hardware_d:
        assert_type(hardware_d, LeadshineHwMotor)


def use_too(e: OrientalAzMotor, any_one: Motor) -> None:
    with e.low_level() as hardware_e:
        assert_type(hardware_e, OrientalAzHwMotor)
        hardware_e.no_such_attribute
    with any_one.low_level() as hardware:
        assert_type(hardware, Any)
"""


@pytest.mark.pure("types are those of the sources")
def test_low_level_has_the_class_of_the_adaptation(tmp_path):
    (tmp_path / "program.py").write_text(PROGRAM)
    words = [sys.executable, "-m", "mypy", "--strict", "--no-color-output", "program.py"]
    cache = f"--cache-dir={CHECKOUT / '.mypy_cache'}"
    done = subprocess.run(
        [*words, cache], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.stdout.splitlines() == [
        'program.py:31: error: "OrientalAzHwMotor" has no attribute "no_such_attribute"'
        "  [attr-defined]",
        "Found 1 error in 1 file (checked 1 source file)",
    ]
