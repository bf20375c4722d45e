"""Faults of a moving drive: the error for the application, and recovery."""

import pytest

from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.errors import DeviceFault, MotionInterrupted
from motorhil.motorapi.state import MotorState
from tests.support.motors.drive_rigs import drive
from tests.support.motors.wheels import go_to, motor_of

STIMULUS = '[[stimulus]]\ncontroller = "left"\nname = "{}"\nvalue = {}\nat_s = {}\n'

FAULTS = [
    ("short_circuit", 1, 0, 0x2320, "short circuit or earth leakage"),
    ("mains_under_voltage", 1, 0, 0x3120, "mains under-voltage"),
    ("power", 0, 1, 0x3220, "DC link under-voltage"),
    ("device_temperature_c", 90, 20, 0x4210, "device temperature"),
    ("encoder", 0, 1, 0x7305, "incremental sensor 1"),
    ("load_torque_n_m", 40, 0, 0x8611, "following error"),  # 8 A hold 13.7 N m: it stalls
]


@pytest.mark.parametrize(("name", "bad", "good", "code", "text"), FAULTS)
def test_motion_ends_with_the_fault_planned_in_the_rig_file(open_rig, name, bad, good, code, text):
    rig = open_rig(
        drive("left", 1), STIMULUS.format(name, bad, 0.9), STIMULUS.format(name, good, 1.4)
    )
    motor = motor_of(rig)
    go_to(motor, 3.0)
    with pytest.raises(DeviceFault, match=f"{code:04X}h.*{text}"):
        motor.wait_until_done(timeout_s=5)
    assert rig.runtime.now_ns() < 1_500_000_000
    fault = motor.fault()
    assert fault is not None
    assert (fault.code, fault.text) == (code, text)
    if name != "load_torque_n_m":
        with pytest.raises(DeviceFault, match=f"{code:04X}h"):
            motor.reset_fault()  # its cause persists
    rig.runtime.run_for(30.0)  # without power it coasts to rest
    motor.reset_fault()
    assert motor.fault() is None
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(0.1, relative=True)
    motor.start()
    motor.wait_until_done(timeout_s=5)


PHYSICS = [
    ("i2t_continuous_a = 2.0\ni2t_peak_a = 8.0\ni2t_peak_s = 0.3", 0x2310, "continuous over-curr"),
    (
        "thermal_resistance_winding_housing_k_w = 1.7\n"
        "thermal_resistance_housing_ambient_k_w = 6.0\n"
        "thermal_time_constant_winding_s = 0.2\nthermal_time_constant_motor_s = 20.0",
        *(0x4310, "drive temperature"),
    ),
]


@pytest.mark.parametrize(("plant", "code", "text"), PHYSICS)
def test_motor_against_a_wall_ends_with_the_first_fault(open_rig, plant, code, text):
    wall = f'[controller.left.plant]\npreset = "wheel_60w"\nstop_high_rad = 0.5\n{plant}'
    rig = open_rig(drive("left", 1, controller='objects = { "6065h" = 0 }\n' + wall))
    motor = motor_of(rig)
    go_to(motor, 3.0)
    with pytest.raises(DeviceFault, match=f"{code:04X}h.*{text}"):
        motor.wait_until_done(timeout_s=10)
    assert motor.position() == pytest.approx(0.5, abs=0.01)  # at the wall
    rig.runtime.run_for(5.0)
    motor.reset_fault()
    assert motor.fault() is None


def test_safe_torque_off_prevents_motion_until_released(open_rig):
    rig = open_rig(drive("left", 1), STIMULUS.format("sto", 1, 0.9))
    motor = motor_of(rig)
    go_to(motor, 3.0)
    with pytest.raises(MotionInterrupted):
        motor.wait_until_done(timeout_s=5)
    assert motor.fault() is None
    assert motor.state() is MotorState.DISABLED
    rig.runtime.run_for(5.0)
    position = motor.position()
    rig.controllers["left"].stimulate("sto", 0)
    rig.runtime.run_for(1.0)
    assert motor.position() == position
    go_to(motor, 3.0)
    motor.wait_until_done(timeout_s=5)
