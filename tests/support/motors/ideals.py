"""Helpers for commanding and sampling an ideal motor."""

import pytest

from motorhil.motorapi import ControlMode, ControlVariable, MotorModel

MODEL = MotorModel(
    name="wheel",
    velocity_max=2.0,
    acceleration_max=4.0,
    deceleration_max=8.0,
    torque_max=3.0,
    current_max=2.0,
)
SETPOINT, TRAJECTORY = ControlMode.SETPOINT, ControlMode.TRAJECTORY
POSITION, VELOCITY = ControlVariable.POSITION, ControlVariable.VELOCITY
TORQUE, CURRENT = ControlVariable.TORQUE, ControlVariable.CURRENT
ROUNDING = 1e-14  # a few units in the last place of numbers about 1


def aim(motor, value, variable=POSITION, **options):
    motor.set_control_mode(SETPOINT, variable)
    motor.set_setpoint(value, **options)
    motor.start()


def follow(motor, trajectory, variable=POSITION, argument=None):
    motor.set_control_mode(TRAJECTORY, variable)
    motor.set_trajectory(trajectory, argument)
    motor.start()


def samples(runtime, motor, period_s, count):
    """Sample (position, velocity, torque) every `period_s` from now on."""
    taken = []
    for _ in range(count):
        taken.append((motor.position(), motor.velocity(), motor.torque()))
        runtime.run_for(period_s)
    return taken


def near(*expected):
    return pytest.approx(expected, abs=ROUNDING)
