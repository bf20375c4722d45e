"""Activities of owners whose motors may be taken over."""

from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    TrapezoidalTrajectory,
)

LONG_S = 20.0


def rove(motor):
    """Start a motion that does not end by itself."""
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(0.1)


def follow(motor, way=0.01):
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(way))


def heard(motor):
    told = []
    motor.ownership.listeners.append(told.append)
    return told


def elsewhere(world, action):
    """Run it in another thread while this one waits, so that its leases are renewed."""
    party = world.runtime.spawn("elsewhere", action)
    assert party.join(LONG_S)
    if party.error is not None:
        raise party.error


def actions(told, motor):
    return [event.action.name for event in told if motor.name in event.owner.split()]
