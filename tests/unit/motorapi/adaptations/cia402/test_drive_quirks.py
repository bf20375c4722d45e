"""Drives that deviate like real ones: the host continues or reports it."""

import pytest

from motorhil.emulators.cia402.settings import CATALOGUE
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import DeadlineExceeded
from motorhil.motorapi.trajectory import ComplexTrajectory
from tests.support.motors.drive_rigs import drive
from tests.support.motors.streaming import quintic
from tests.support.motors.wheels import WINDOW_RAD, go_to, motor_of, truth

SURVIVED = {
    **{quirk.name: "true" for quirk in CATALOGUE},
    "stale_target_reached": "{ for_s = 0.2 }",
    "slow_sdo": "{ mean_s = 0.05, spread_s = 0.04 }",
    "late_boot_up": "{ by_s = 1.0 }",
    "heartbeat_jitter": "{ max_s = 0.19 }",  # every 100 ms; lost after 300
}

NOT_SURVIVED = [
    ("slow_sdo", "{ mean_s = 1.0 }", "answer to SDO .*: did not happen within 0.3 s"),
    ("late_boot_up", "true", "any answer: did not happen within 3 s"),
    ("deaf_after_boot_up", "{ for_s = 20 }", "any answer: did not happen within 3 s"),
]


@pytest.mark.parametrize(("name", "value"), SURVIVED.items())
def test_host_tolerates_the_quirk(open_rig, name, value):
    rig = open_rig(drive("left", 2, controller=f"quirks.{name} = {value}"))
    motor = motor_of(rig)
    for target in (0.3, 0.6):
        go_to(motor, target)
        motor.wait_until_done(timeout_s=5)
        assert truth(rig) == pytest.approx(target, abs=WINDOW_RAD)  # position window
    rig.controllers["left"].stimulate("fault", 0x7121)
    rig.runtime.run_for(0.3)
    fault = motor.fault()
    assert fault is not None
    assert fault.code == 0x7121
    motor.reset_fault()
    assert motor.fault() is None
    motor.home(37)


@pytest.mark.parametrize(("name", "value", "told"), NOT_SURVIVED)
def test_host_reports_the_quirk(open_rig, name, value, told):
    rig = open_rig(drive("left", 2, controller=f"quirks.{name} = {value}"))
    motor = motor_of(rig)
    with pytest.raises(DeadlineExceeded, match=told):
        go_to(motor, 0.3)
    assert truth(rig) == pytest.approx(0.0, abs=1e-4)  # an increment; nothing has moved


def test_emcy_of_another_drive_ends_no_motion(open_rig):
    rig = open_rig(drive("left", 1), drive("right", 2, controller='quirks = ["stray_emcy"]'))
    left, right = motor_of(rig, "left"), motor_of(rig, "right")
    go_to(right, 0.1)
    go_to(left, 1.0)
    rig.controllers["right"].stimulate("fault", 0x7121)
    left.wait_until_done(timeout_s=5)
    assert left.fault() is None
    fault = right.fault()
    assert fault is not None
    assert fault.code == 0x7121


def test_inverted_acknowledge_is_learnt_once(open_rig):
    rig = open_rig(drive("left", 2, controller="quirks.inverted_set_point_acknowledge = true"))
    motor = motor_of(rig)
    for target, longest_s in ((0.3, 1.5), (0.6, 0.1), (0.3, 0.1)):
        begun_ns = rig.runtime.now_ns()
        go_to(motor, target)
        assert (rig.runtime.now_ns() - begun_ns) / 1e9 < longest_s
        motor.wait_until_done(timeout_s=5)
        assert truth(rig) == pytest.approx(target, abs=WINDOW_RAD)


def test_mode_held_under_halt_is_changed_without_a_motion(open_rig):
    """Drives of ros2_canopen's users ignore 6060h under halt."""
    rig = open_rig(drive("left", 2, controller="quirks.halt_holds_mode = true"))
    motor = motor_of(rig)

    def stopped() -> float:
        rig.runtime.run_for(0.3)
        motor.stop()
        motor.wait_until_done(timeout_s=5)
        return truth(rig)

    for speed in (1.0, -1.0):
        go_to(motor, 2.0 * speed)
        at = stopped()
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        motor.set_setpoint(-speed)
        motor.start()  # not on to the target first
        assert truth(rig) == pytest.approx(at, abs=0.01)
        at = stopped()
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(ComplexTrajectory(quintic(speed, 2.0), relative=True))
        motor.start()
        rig.runtime.run_for(0.2)
        assert truth(rig) == pytest.approx(at, abs=0.02)
        stopped()
        motor.home(37)


def test_mode_held_under_halt_is_changed_to_torque_and_back(open_rig):
    quirk = "quirks.halt_holds_mode = true"
    rig = open_rig(drive("left", 2, controller=quirk, model="gear_ratio = 66.0"))
    motor = motor_of(rig)
    for target in (0.3, 0.6):
        go_to(motor, target)
        motor.stop()
        motor.wait_until_done(timeout_s=5)
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.TORQUE)
        motor.set_setpoint(0.5)
        motor.start()
        rig.runtime.run_for(0.1)
        assert motor.torque() == pytest.approx(0.5, abs=0.05)
        motor.stop()
        motor.wait_until_done(timeout_s=5)
