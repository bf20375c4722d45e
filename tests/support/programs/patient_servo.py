"""A user's program with a central servo, and its death.

With "victim" as its argument it holds a motor until it is killed. Without, it starts such a victim,
finds the node taken, kills the victim, sees the node switch its amplifier off, and moves the motor
itself. Then it releases the node for the next run. The servo is slow on purpose (50 cycles a
second), and allows misses: the machine may be busy.
"""

import signal
import subprocess
import sys

import can

from motorhil.motorapi import (
    ControlMode,
    MotorBusyError,
    MotorModel,
    TrapezoidalTrajectory,
)
from motorhil.motorapi.adaptations.host_servo.hardware import AmplifierHwMotor
from motorhil.motorapi.adaptations.host_servo.motor import ServoParameters, SoftwareMotor
from motorhil.motorapi.adaptations.host_servo.settings import IoOptions, PidGains

PATIENT = IoOptions(
    cycle_ms=20,
    misses_max=1_000_000,
    heartbeat_timeout_ms=2000,
    sdo_timeout_s=10.0,
    connect_timeout_s=30.0,
)
GAINS = PidGains.tuned(3.0, 0.038, friction_a=0.154)
COARSE = ServoParameters(position_window=0.005)  # such a slow integral needs minutes to be finer
MODEL = MotorModel(
    name="wheel",
    velocity_max=2.0,
    acceleration_max=2.0,
    gear_ratio=66.0,
    encoder_increments_rev=2000,
)


def as_victim(motor: SoftwareMotor) -> None:
    motor.enable()
    print("holding", flush=True)
    motor.runtime.wait_until(lambda: False, 120.0)


def as_heir(motor: SoftwareMotor) -> None:
    hardware = motor.hardware
    hardware.connect()
    words = [sys.executable, __file__, "victim"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as victim:
        assert victim.stdout is not None
        print(victim.stdout.readline().strip())
        motor.runtime.wait_until(lambda: hardware.io.status(1) == 1, 30.0)
        try:
            motor.enable()
        except MotorBusyError as error:
            print("taken by the victim" if error.pid == victim.pid else f"taken by {error.pid}")
        victim.send_signal(signal.SIGKILL)
    node = hardware.node
    missed = motor.runtime.wait_until(lambda: node.error_code == 0x8130 and not node.is_up, 30.0)
    print("missed" if missed else "not missed", hardware.read(0x6000, 1, "u8"), "inputs")
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(0.5))
    motor.enable()
    begin = motor.position()
    motor.start()
    motor.wait_until_done(timeout_s=60)
    print(f"{motor.position() - begin:.2f}", flush=True)
    motor.disable()
    subprocess.run([sys.executable, __file__, "next"], check=True)


def as_next(motor: SoftwareMotor) -> None:
    motor.enable()
    print("next", flush=True)
    motor.disable()


with can.Bus() as bus:
    amplifier = AmplifierHwMotor(bus, node_id=1, current_per_volt_a_v=0.8, options=PATIENT)
    servo = SoftwareMotor(amplifier, MODEL, GAINS, parameters=COARSE)
    {"victim": as_victim, "next": as_next}.get(sys.argv[-1], as_heir)(servo)
    amplifier.close()
