"""Fixture: two drives that stream at 1 kHz."""

import pytest

from motorhil.harness.rig.rig import Rig
from tests.support.motors.drive_rigs import drive
from tests.support.motors.streaming import EVERY_MS, OpenRig


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1, motor=EVERY_MS), drive("right", 2, motor=EVERY_MS))
