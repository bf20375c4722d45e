"""Fixtures: an ideal motor in virtual time."""

import pytest

from motorhil.motorapi.adaptations.ideal.hardware import IdealHwMotor
from motorhil.motorapi.adaptations.ideal.motor import IdealMotor
from tests.support.motors.ideals import MODEL


@pytest.fixture
def hw(runtime):
    return IdealHwMotor(runtime, "axis 1", position=0.25, torque_constant=0.5)


@pytest.fixture
def motor(hw):
    return IdealMotor(hw, MODEL, name="m")
