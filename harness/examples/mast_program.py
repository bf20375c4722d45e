"""A mast program: takes one panorama after another until it is ended.

This program shares the pan motor with the driving program (`driving_program.py`) without knowing
it. The mast is reserved during a panorama, so that no other program turns it between two pictures.
After each panorama, waiting programs have their turn.
"""

import sys
from itertools import count

from motorhil.harness.examples.rover_hardware import rover_motors
from motorhil.motorapi import ControlMode, Motor, MotorError, MotorGroup, TrapezoidalTrajectory

PICTURES_RAD = (-0.8, 0.0, 0.8)
TILT_RAD = -0.15
EXPOSURE_S = 0.1
PATIENCE_S = 60.0


def take_panorama(mast: MotorGroup) -> None:
    """Point the mast in each direction, and stand still for each picture."""
    for pan_rad in PICTURES_RAD:
        mast.set_trajectory(
            *(
                TrapezoidalTrajectory(target_rad, initial=motor.position())
                for motor, target_rad in zip(mast, (pan_rad, TILT_RAD), strict=True)
            )
        )
        mast.start()
        mast.wait_until_done(PATIENCE_S)
        mast[0].runtime.wait_until(lambda: False, EXPOSURE_S)


def main() -> int:
    """Take panoramas for ever; return 1 if a motor failed."""
    try:
        with rover_motors("pan", "tilt") as motors:
            mast = MotorGroup(*motors)
            mast.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
            for number in count(1):
                with mast.reserve(f"panorama {number}", timeout_s=PATIENCE_S):
                    print(f"panorama {number}", flush=True)
                    take_panorama(mast)
    except MotorError as error:
        print(error, file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
