"""A program with a servo that loses its motor.

python -m tests.support.programs.fenced_servo CHANNEL HOW

The motor is on channel 1 of node 1. The program prints "holding"; then, for each line it reads, the
state of its servo: "holds", or "ended: WHY". HOW is "fenced", or "unfenced": then its frames are
sent without regard to the owner of the node.
"""

import sys
from math import inf

import can

from motorhil.motorapi import MotorModel
from motorhil.motorapi.adaptations.host_servo.hardware import AmplifierHwMotor
from motorhil.motorapi.adaptations.host_servo.motor import ServoParameters, SoftwareMotor
from motorhil.motorapi.adaptations.host_servo.settings import IoOptions, PidGains
from motorhil.motorapi.ownership.fencing import BoundFence, NodeFence

PATIENT = IoOptions(
    cycle_ms=20,
    misses_max=1_000_000,
    heartbeat_timeout_ms=20_000,
    sdo_timeout_s=10.0,
    connect_timeout_s=30.0,
)
MODEL = MotorModel(
    name="wheel",
    velocity_max=2.0,
    acceleration_max=2.0,
    gear_ratio=66.0,
    encoder_increments_rev=2000,
)


def servo_on(bus, name, runtime=None):
    hardware = AmplifierHwMotor(
        bus, node_id=1, current_per_volt_a_v=0.8, options=PATIENT, runtime=runtime
    )
    gains = PidGains.tuned(3.0, 0.038, friction_a=0.154)
    # Late cycles of a busy machine are no fault here: what counts is who sends.
    coarse = ServoParameters(position_window=0.02, following_error_window=inf)
    return SoftwareMotor(hardware, MODEL, gains, parameters=coarse, name=name)


def main():
    channel, how = sys.argv[1:]
    with can.Bus(interface="emulated", channel=channel) as bus:
        if how == "unfenced":
            BoundFence.send = NodeFence.send = lambda fence, frame: bus.transmit(frame)
        motor = servo_on(bus, "owner")
        with motor.reserve("survey"):
            motor.enable()
            print("holding", flush=True)
            axis = motor.hardware.axis
            for line in sys.stdin:
                if line.strip() == "wait":
                    motor.runtime.wait_until(lambda: axis.failure is not None, 30.0)
                holds = axis.failure is None
                print("holds" if holds else f"ended: {axis.failure}", flush=True)


if __name__ == "__main__":
    main()
