"""A program that starts drives of a hub, commanded line by line.

python -m tests.support.programs.sync_program CHANNEL NODE_ID...

    group TARGET        all of them move to TARGET [rad]: "started"
    hold TARGET         the same, but "armed" comes between arming and SYNC; any line fires it
    stream TARGET       the first one moves there by set-points, in 0.5 s: "started"
    period MS           of set-points, before anything else: "set"
    patience SECONDS    the longest wait for other programs that arm: "set"
    wait                "done"
    positions           "AT AT"
    straddles           of the last start of the group: "COUNT SKEW_S"
    rounds COUNT        as many short motions there and back: "COUNT rounds"

A failure prints "failed KIND WHY".
"""

import sys

import can

from motorhil.motorapi import (
    ComplexTrajectory,
    ControlMode,
    Motor,
    MotorError,
    MotorGroup,
    MotorModel,
)
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.cia402.sync_start import SyncTrigger
from motorhil.motorapi.functions import Polynomial
from motorhil.motorapi.ownership import queue as turns

PATIENT_S = 60.0
MODEL = MotorModel(name="wheel", velocity_max=3.0, acceleration_max=10.0)


def options(period_ms):
    return HwOptions(
        heartbeat_timeout_ms=10_000,
        sdo_timeout_s=10.0,
        connect_timeout_s=30.0,
        sdo_quarantine_s=3.0,
        set_point_period_ms=period_ms,
    )


class Program:
    def __init__(self, bus, node_ids):
        self.bus = bus
        self.node_ids = node_ids
        self.period_ms = 20
        self.motors = []
        self.group = None

    def connect(self):
        if self.group is None:
            self.motors = [
                Cia402Motor(
                    Cia402HwMotor(self.bus, node_id=one, options=options(self.period_ms)),
                    MODEL,
                    name=f"node{one}",
                )
                for one in self.node_ids
            ]
            self.group = MotorGroup(*self.motors)
            self.group.for_each(Motor.position)
        return self.group

    def go(self, target):
        group = self.connect()
        group.for_each(Motor.set_control_mode, ControlMode.SETPOINT)
        group.for_each(Motor.set_setpoint, target)
        group.start(PATIENT_S)

    def do(self, word, *rest):
        if word == "period":
            self.period_ms = int(rest[0])
            return "set"
        group = self.connect()
        match word:
            case "connect":
                return "connected"
            case "patience":
                turns.TRANSACTION_TIMEOUT_S = float(rest[0])
                return "set"
            case "group":
                self.go(float(rest[0]))
                return "started"
            case "hold":
                fire = SyncTrigger.fire

                def held(trigger):
                    print("armed", flush=True)
                    sys.stdin.readline()
                    fire(trigger)

                SyncTrigger.fire = held
                try:
                    self.go(float(rest[0]))
                finally:
                    SyncTrigger.fire = fire
                return "started"
            case "stream":
                first = self.motors[0]
                first.set_control_mode(ControlMode.TRAJECTORY)
                away = float(rest[0]) - first.position()
                shape = Polynomial((0.0, 0.0, 0.0, 10.0 * away, -15.0 * away, 6.0 * away))
                duration_s = float(rest[1]) if len(rest) > 1 else 0.5
                function = shape.scaled(duration_s).restricted(0.0, duration_s)
                first.set_trajectory(ComplexTrajectory(function, relative=True))
                first.start(PATIENT_S)
                return "started"
            case "wait":
                group.wait_until_done(PATIENT_S)
                return "done"
            case "positions":
                return " ".join(f"{abs(motor.position()):.3f}" for motor in self.motors)
            case "straddles":
                quality = group.sync_quality()
                return f"{quality.straddles} {quality.command_skew_s}"
            case "rounds":
                for count in range(int(rest[0])):
                    with group.reserve("a round", timeout_s=PATIENT_S):
                        self.go(0.002 * (1 + count % 2))
                        group.wait_until_done(PATIENT_S)
                return f"{rest[0]} rounds"
        return f"what is {word}?"


def main():
    channel, *node_ids = sys.argv[1:]
    with can.Bus(interface="emulated", channel=channel) as bus:
        program = Program(bus, [int(one) for one in node_ids])
        print("ready", flush=True)
        for line in iter(sys.stdin.readline, ""):
            try:
                answer = program.do(*line.split())
            except MotorError as error:
                answer = f"failed {type(error).__name__} {error}"
            print(answer, flush=True)


if __name__ == "__main__":
    main()
