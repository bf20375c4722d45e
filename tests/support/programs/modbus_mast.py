"""A program that moves a PR-mode drive over `tcp HOST:PORT` or `rtu LINK`."""

import sys

from motorhil.motorapi import ControlMode, MotorModel
from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.adaptations.leadshine.motor import LeadshineMotor
from motorhil.motorapi.runtime.byte_streams import SerialLine, TcpLine

MODEL = MotorModel(name="mast", velocity_max=2.0, acceleration_max=8.0, gear_ratio=100.0)


def line_of(kind: str, where: str) -> TcpLine | SerialLine:
    if kind == "tcp":
        host, _, port = where.rpartition(":")
        return TcpLine(host, int(port))
    return SerialLine(where, baud_bit_s=115_200, parity="N")


def main(kind: str, where: str) -> None:
    line = line_of(kind, where)
    hardware = LeadshineHwMotor(line, 1, runtime=line.wall, timeout_s=2.0)
    motor = LeadshineMotor(hardware, MODEL)
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(0.3)
    with motor.reserve("a look around", timeout_s=30):
        motor.start()
        motor.wait_until_done(20)
        print(f"{motor.position():.2f}", flush=True)
        motor.set_setpoint(-0.1, relative=True)
        motor.start()
        motor.wait_until_done(20)
        print(f"{motor.position():.2f}", flush=True)
    motor.close()
    hardware.close()
    line.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
