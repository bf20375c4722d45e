"""Selection of the drive's error from its EMCYs (CiA 301, 7.2.7)."""

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.canopen.emcy import Emergency, standing_error
from tests.support.motors.bus_errors import ACTIVE, PASSIVE, tell
from tests.support.motors.drive_rigs import drive
from tests.support.motors.wheels import go_to, motor_of


@pytest.mark.parametrize(
    ("told", "standing"),
    [
        ([(0x8611, 0x21), (0x8120, 0x31)], 0x8611),  # an error of the bus yields
        ([(0x8120, 0x11), (0x8611, 0x31)], 0x8611),
        ([(0x8611, 0x21), (0x8120, 0x31), (0x0000, 0x21)], 0x8611),  # the bus has recovered
        ([(0x8611, 0x21), (0x8120, 0x31), (0x0000, 0x11)], None),  # the fault is reset
        ([(0x8120, 0x11), (0x0000, 0x11)], 0x8120),
        ([(0x8120, 0x11), (0x0000, 0x00)], None),
        ([(0x8140, 0x11), (0x0000, 0x00)], None),
        ([(0x8130, 0x11), (0x0000, 0x11)], 0x8130),
        ([(0x8210, 0x11), (0x8130, 0x11)], 0x8130),
        ([(0x8130, 0x11), (0x8220, 0x11)], 0x8130),
    ],
)
def test_bus_error_yields_to_a_drive_error(told, standing):
    error = None
    for code, register in told:
        error = standing_error(error, Emergency(code, register, bytes(5), 0))
    assert (None if error is None else error.code) == standing


def test_error_passive_drive_moves_and_reports_the_error(open_rig):
    rig: Rig = open_rig(drive("left", 1))
    motor = motor_of(rig)
    motor.enable()
    tell(rig, PASSIVE, "left")
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    assert motor.fault() is None
    assert "after EMCY 8120h at 0." in repr(motor.hardware)
    rig.controllers["left"].stimulate("fault", 0x3210)
    rig.runtime.run_for(0.1)
    assert motor.fault().code == 0x3210
    tell(rig, ACTIVE, "left")
    rig.runtime.run_for(0.1)
    motor.reset_fault()
    assert "EMCY" not in repr(motor.hardware)
