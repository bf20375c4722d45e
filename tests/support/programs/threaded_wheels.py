"""Four threads with a logical motor each on node 1.

Each thread moves, reads, gets the end of its motion, and sometimes has low-level access. Each works
as if it were alone: each operation waits for the present owner of the motor.
"""

import sys
import threading
from contextlib import suppress

import can

from motorhil.motorapi import ControlMode, MotorBusyError, MotorModel, TrapezoidalTrajectory
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor

PATIENT = HwOptions(heartbeat_timeout_ms=10_000, sdo_timeout_s=10.0, connect_timeout_s=30.0)
WAIT_S = 120.0
ROUNDS = 3
WAY = 0.02

model = MotorModel.load(sys.argv[1])
told: list[str] = []
inside: list[str] = []
failures: list[BaseException] = []


def start(motor: Cia402Motor) -> None:
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(WAY))
    while True:
        with suppress(MotorBusyError):
            return motor.start()
        motor.runtime.wait_until(lambda: False, 0.01)


def use(motor: Cia402Motor) -> None:
    for _ in range(ROUNDS):
        start(motor)
        motor.on_done(lambda outcome: told.append(outcome.ending.value))
        motor.wait_until_done(timeout_s=WAIT_S)
        with motor.low_level(timeout_s=WAIT_S) as hardware:
            inside.append(motor.name)
            hardware.write("profile_velocity", 1)  # no later start may rely on another
            hardware.read("statusword")
            assert inside == [motor.name], inside
            inside.clear()
        with suppress(MotorBusyError):
            motor.position()


def run(motor: Cia402Motor) -> None:
    try:
        use(motor)
    except BaseException as error:
        failures.append(error)


with can.Bus() as bus:
    drive = Cia402HwMotor(bus, node_id=1, options=PATIENT)
    motors = [Cia402Motor(drive, model=model, name=f"m{place}") for place in range(4)]
    threads = [threading.Thread(target=run, args=(motor,)) for motor in motors]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for error in failures:
        raise error
    print(f"{motors[0].position():.2f} {len(told)} {sorted(set(told))}")
    motors[0].disable()
    drive.close()
