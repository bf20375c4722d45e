"""Two wheels turn together. The same program runs on emulated drives and on real ones.

motorhil run two_wheels.toml two_wheels.py                         emulated, in virtual time
CAN_INTERFACE=socketcan CAN_CHANNEL=can0 python two_wheels.py      on the drives on can0
"""

from contextlib import closing
from math import pi
from pathlib import Path

import can

from motorhil.motorapi import ControlMode, Motor, MotorGroup, MotorModel, TrapezoidalTrajectory
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor

MODEL = MotorModel.load(Path(__file__).parent / "wheel_model.toml")


def main() -> None:
    """Turn one wheel, then move both so that they start and end together."""
    with (
        can.Bus() as bus,
        closing(Cia402HwMotor(bus, node_id=1)) as left_drive,
        closing(Cia402HwMotor(bus, node_id=2)) as right_drive,
    ):
        left = Cia402Motor(left_drive, MODEL, name="left")
        right = Cia402Motor(right_drive, MODEL, name="right")

        left.enable()
        left.set_control_mode(ControlMode.SETPOINT)
        left.set_setpoint(2.0 * pi)  # rad; absolute, from the position at power-on
        left.start()
        left.wait_until_done(timeout_s=10.0)
        print(f"left is at {left.position():.4f} rad")

        both = MotorGroup(left, right)
        both.for_each(Motor.enable)
        both.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        both.set_trajectory(TrapezoidalTrajectory(-2.0 * pi), TrapezoidalTrajectory(pi))
        both.start()
        both.wait_until_done(timeout_s=10.0)
        for motor in both:
            print(f"{motor.name} is at {motor.position():.4f} rad")
        both.for_each(Motor.disable)


if __name__ == "__main__":
    main()
