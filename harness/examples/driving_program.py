"""A driving program: looks along each leg, then drives it.

This program shares the pan motor with the mast's program (`mast_program.py`), and waits for its
turn, first come, first served. If the program that has the motor dies, the motor is free at once. A
motor that is still moving is then brought to rest before its next command.
"""

import sys

from motorhil.harness.examples.rover import Rover
from motorhil.harness.examples.rover_hardware import rover_motors
from motorhil.harness.examples.rover_kinematics import WHEELS, Leg
from motorhil.motorapi import ControlMode, Motor, MotorError, MotorGroup

LEGS = (Leg.arc(1.5, 0.3), Leg.crab(0.3, -0.5), Leg.turn(-0.4))
PATIENCE_S = 60.0


def look_ahead(rover: Rover, leg: Leg) -> None:
    """Look along the leg with the camera."""
    (pan,) = rover.mast
    with pan.reserve(f"a look along the {leg.name}", timeout_s=PATIENCE_S):
        print(f"looks along the {leg.name}", flush=True)
        rover.turn_to(rover.mast, [leg.way_ahead_rad()])


def main() -> int:
    """Drive the manoeuvre; return 0, or 1 if a motor failed or was not available."""
    names = [*(f"drive_{name}" for name in WHEELS), *(f"steer_{name}" for name in WHEELS), "pan"]
    try:
        with rover_motors(*names) as motors:
            wheels, steering = MotorGroup(*motors[:6]), MotorGroup(*motors[6:12])
            rover = Rover(wheels, steering, MotorGroup(motors[12]))
            for group in (rover.wheels, rover.steering, rover.mast):
                group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
            for leg in LEGS:
                look_ahead(rover, leg)
                print(f"drives the {leg.name}", flush=True)
                rover.drive(leg)
            for group in (rover.wheels, rover.steering):
                group.for_each(Motor.disable)
    except MotorError as error:
        print(error, file=sys.stderr)
        return 1
    print("has driven the manoeuvre", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
