"""Representations at a prompt."""

import pickle

import pytest

from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    Fault,
    Measurement,
    Motion,
    MotionKind,
    MotorModel,
    MotorState,
    Setpoint,
    TrapezoidalTrajectory,
    errors,
)
from tests.support.motors.plain import PlainMotor, fault_now

NAMES = {
    "DerivativeLimits": DerivativeLimits,
    "MotionKind": MotionKind,
    "MotorModel": MotorModel,
    "Setpoint": Setpoint,
}
VALUES = [
    (Setpoint(1.0), "Setpoint(value=1.0)"),
    (
        Setpoint(-0.5, True, DerivativeLimits(first=0.25)),
        "Setpoint(value=-0.5, relative=True, limits=DerivativeLimits(first=(-0.25, 0.25)))",
    ),
    (DerivativeLimits(), "DerivativeLimits()"),
    (
        DerivativeLimits(value=(0.0, 2.0), second=(-1.0, 3.0)),
        "DerivativeLimits(value=(0.0, 2.0), second=(-1.0, 3.0))",
    ),
    (
        MotorModel(name="lift", kind=MotionKind.LINEAR, velocity_max=0.1, acceleration_max=0.5),
        "MotorModel(name='lift', kind=MotionKind.LINEAR, velocity_max=0.1, acceleration_max=0.5)",
    ),
]


@pytest.mark.parametrize(("value", "shown"), VALUES, ids=lambda value: type(value).__name__)
def test_value_repr_is_the_call_that_creates_it(value, shown):
    assert repr(value) == shown
    assert eval(shown, NAMES) == value
    assert pickle.loads(pickle.dumps(value)) == value


def test_measurement_repr_shows_time_and_known_values():
    heard = Measurement(1_500_000_000, MotorState.ENABLED, 0.25, None, -1.5)
    assert repr(heard) == "<Measurement at 1.500000 s: enabled, position 0.25, torque -1.5>"
    fault = Fault(0x8611, "following error", 2_000_000)
    assert repr(fault) == "<Fault 8611h (following error) since 0.002000 s>"


def test_motion_repr_shows_its_relevant_fields():
    motion = Motion(ControlMode.TRAJECTORY, ControlVariable.POSITION, 0.0, 1.0, 2.0, 4.0, 3.0)
    assert repr(motion) == (
        "<Motion trajectory of position: 0 to 1, velocity up to 2, acceleration 4, deceleration 3>"
    )
    torque = Motion(
        ControlMode.SETPOINT, ControlVariable.TORQUE, 0.0, 0.5, 1.0, 1.0, 1.0, slope=2.0
    )
    assert repr(torque) == "<Motion setpoint of torque: 0 to 0.5, 2 per s>"


def test_motor_repr_shows_its_state_and_activity(runtime, hw, motor):
    other = PlainMotor(hw, name="other")
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(3.0))
    assert repr(motor) == "<PlainMotor 'm1' on bus0 node 1: disabled, 0 rad>"
    motor.start()
    runtime.run_for(0.5)
    told = "on bus0 node 1: enabled, 0.5 rad; start() of m1 is active>"
    assert (repr(motor), repr(other)) == (f"<PlainMotor 'm1' {told}", f"<PlainMotor 'other' {told}")
    assert repr(motor.logical.physical) == "<PhysicalMotor bus0 node 1: start() of m1>"
    assert repr(motor.logical.run) == (
        "<Run start() of m1 since 0.000000 s: not known to have ended>"
    )
    assert repr(motor.progress()) == (
        "<Progress of start() of m1: 0.500 s of 2.000 s, 16.7%, at 0.5 on the way to 3>"
    )
    told = []
    motor.on_done(told.append)
    other.stop()
    assert repr(told[0]) == (
        "<Outcome of start() of m1: interrupted at 0.500000 s: m1: the motion was ended by"
        " stop() of other at 0.500000 s>"
    )
    assert repr(motor) == "<PlainMotor 'm1' on bus0 node 1: enabled, 0.5 rad>"
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(1.0)
    motor.start()
    assert repr(other).endswith("; start() of m1 is active>")
    fault_now(hw)
    assert repr(other).endswith("on bus0 node 1: fault, 0.5 rad>")


def test_error_repr_shows_class_and_message():
    error = errors.StateError(motor="left", operation="start", state="x", remedy="y")
    assert repr(error) == "StateError('left: start refused, x; y')"
