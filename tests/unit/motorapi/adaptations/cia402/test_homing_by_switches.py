"""Homing on switches of the plant, by the method of the application."""

from collections.abc import Callable
from math import tau

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.motor import HomingFailed
from motorhil.motorapi.errors import DeadlineExceeded
from motorhil.motorapi.state import MotorState
from tests.support.motors.drive_rigs import drive
from tests.support.motors.wheels import WINDOW_RAD, go_to, motor_of, truth

OpenRig = Callable[..., Rig]
SWITCHES = """
objects = { "6099h:1" = 60000, "6099h:2" = 5000, "609Ah" = 600000 }
[controller.left.switches]
negative_limit_rad = -0.5
positive_limit_rad = 1.5
home_from_rad = 0.25
home_to_rad = 0.3
index_rad = 1.0
"""


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1, controller=SWITCHES, model="requires_referencing = true"))


@pytest.mark.parametrize(
    ("method", "where_rad"), [(17, -0.5), (18, 1.5), (24, 0.25), (25, 0.3), (7, 0.25), (34, 0.0)]
)
def test_homing_sets_the_origin_at_the_switch(rig: Rig, method, where_rad):
    motor = motor_of(rig)
    motor.home(method)
    assert motor.is_referenced()
    way = -0.1 if method == 18 else 0.1  # away from the switch at its present position
    go_to(motor, way)
    motor.wait_until_done(timeout_s=5)
    at = truth(rig) - way
    if 15 < method < 31:
        assert at == pytest.approx(where_rad, abs=WINDOW_RAD)
        return
    turns = (at - 1.0 / 66.0) * 66.0 / tau  # from the index pulse, 1 rad of the motor away from 0
    assert turns == pytest.approx(round(turns), abs=0.01)
    assert abs(at - where_rad) <= tau / 66.0


def test_failed_homing_raises_and_another_method_works(rig: Rig):
    motor = motor_of(rig)
    rig.controllers["left"].stimulate("home", 0)
    with pytest.raises(HomingFailed, match="method 19"):
        motor.home(19)
    assert not motor.is_referenced()
    motor.wait_until_done(timeout_s=1)  # it brakes
    motor.home(17)
    assert motor.is_referenced()


def test_homing_that_takes_too_long_is_stopped(rig: Rig):
    motor = motor_of(rig)
    with pytest.raises(DeadlineExceeded):
        motor.home(18, timeout_s=0.3)
    rig.runtime.run_for(0.5)
    at = truth(rig)
    rig.runtime.run_for(0.5)
    assert truth(rig) == pytest.approx(at, abs=1e-6)
    assert at < 1.4


def test_limit_switch_blocks_motion_towards_it_only(rig: Rig):
    motor = motor_of(rig)
    motor.home(24)
    go_to(motor, 2.0)  # the switch is 1.25 rad from home
    with pytest.raises(DeadlineExceeded):
        motor.wait_until_done(timeout_s=4)
    assert 1.5 <= truth(rig) < 1.7
    assert motor.fault() is None
    motor.stop()
    rig.runtime.run_for(0.5)
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    assert truth(rig) == pytest.approx(0.75, abs=2 * WINDOW_RAD)
    assert motor.state() is MotorState.ENABLED
