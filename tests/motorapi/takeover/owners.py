"""What owners do with motors that may be taken from them."""

from motorapi import (
    ControlMode,
    ControlVariable,
    TrapezoidalTrajectory,
)

LONG_S = 20.0


def rove(motor):
    """It goes on for ever, once it is started."""
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(0.1)


def follow(motor, way=0.01):
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(way))


def heard(motor):
    told = []
    motor._physical.ownership.listeners.append(told.append)
    return told


def elsewhere(world, action):
    """It is done, in another thread: whoever waits in this one is alive, and his leases last."""
    party = world.runtime.spawn("elsewhere", action)
    assert party.join(LONG_S)
    if party.error is not None:
        raise party.error


def actions(told, motor):
    return [event.action.name for event in told if motor.name in event.owner.split()]
