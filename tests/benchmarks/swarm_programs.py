"""Programs of the swarm's benchmark, called with an open rig."""

from motorhil.harness.examples.rover import Rover, manoeuvre
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, Motor, TrapezoidalTrajectory

_POINT_M = (3.0, 0.6, 0.2)


def turn(rig: Rig) -> None:
    """Turn both wheels once."""
    both = rig.groups["both"]
    both.for_each(Motor.enable)
    both.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    both.set_trajectory(TrapezoidalTrajectory(-2.0), TrapezoidalTrajectory(1.0))
    both.start()
    both.wait_until_done(10.0)
    both.for_each(Motor.disable)


def drive(rig: Rig) -> None:
    """Drive the rover's manoeuvre."""
    rover = Rover(rig.groups["wheels"], rig.groups["steering"], rig.groups["mast"])
    manoeuvre(rover, rig.runtime, _POINT_M, lambda text: None)
