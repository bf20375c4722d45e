"""Fixtures: one drive, and logical motors of it."""

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from tests.support.motors.drive_rigs import drive
from tests.support.motors.low_level import OpenRig


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1))


@pytest.fixture
def motor(rig: Rig) -> Cia402Motor:
    """Return a motor whose drive is up."""
    motor = rig.motors["left"]
    assert isinstance(motor, Cia402Motor)
    motor.hardware.connect()
    return motor


@pytest.fixture
def fresh(rig: Rig) -> Cia402Motor:
    """Return a motor whose drive is still booting."""
    motor = rig.motors["left"]
    assert isinstance(motor, Cia402Motor)
    return motor


@pytest.fixture
def other(motor: Cia402Motor) -> Cia402Motor:
    return Cia402Motor(motor.hardware, motor.model, name="other")
