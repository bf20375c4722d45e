"""Algorithms 1 and 2 of the paper, for a slow machine.

The program uses nodes 1 and 2. Its deadlines are longer than the defaults: it runs on the wall
clock, perhaps on a busy machine inside an emulated one. Its output does not depend on the machine's
speed.
"""

import sys

import can

from motorhil.motorapi import ControlMode, Motor, MotorGroup, MotorModel, TrapezoidalTrajectory
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor

PATIENT = HwOptions(heartbeat_timeout_ms=10_000, sdo_timeout_s=10.0, connect_timeout_s=30.0)

model = MotorModel.load(sys.argv[1])
with can.Bus() as bus:
    drives = [Cia402HwMotor(bus, node_id=node_id, options=PATIENT) for node_id in (1, 2)]
    motor1, motor2 = (Cia402Motor(drive, model=model) for drive in drives)

    motor1.set_control_mode(ControlMode.SETPOINT)
    motor1.set_setpoint(1.0)
    motor1.start()
    motor1.wait_until_done(timeout_s=60)
    print(f"{motor1.position():.3f}")

    group = MotorGroup(motor1, motor2)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(2.0))
    group.start()
    group.wait_until_done(timeout_s=60)
    print(f"{motor1.position():.3f} {motor2.position():.3f}")
    group.for_each(Motor.disable)
    for drive in drives:
        drive.close()
