"""A program that commands node 1 of a hub, line by line.

python -m tests.support.programs.shared_drive CHANNEL MODEL NAME[:STATUS_PERIOD_MS]

    move DISTANCE [TIMEOUT_S]       "started", or "busy WHY"
    run VELOCITY                    the same, without an end
    wait                            "done", or "failed WHY"
    home                            "begun"
    stop                            "stopped"
    reserve PURPOSE [TIMEOUT_S]     "reserved", or "busy WHY"
    seize PURPOSE                   the same, taken over from its holder
    release                         "released"
    low_level                       "alone", or "busy WHY"
    gain P                          of the position loop, from the next motion on: "set"
    read INDEX SUBINDEX             "read VALUE"
    read_many COUNT                 a text, in segments: "same" if it never changed
    impatient                       a read that waits 1 us for its answer: "failed WHY"
    position                        "at POSITION"
    began                           "began at rest", or the velocity at which it was armed
    downloads                       "wrote COUNT": the number of objects this process has written
"""

import sys
from contextlib import ExitStack
from dataclasses import replace

import can

from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    MotorBusyError,
    MotorError,
    MotorModel,
)
from motorhil.motorapi.adaptations.canopen.sdo import SdoChannel
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.cia402.parameters import Cia402Parameters

PATIENT = HwOptions(
    heartbeat_timeout_ms=10_000,
    sdo_timeout_s=10.0,
    connect_timeout_s=30.0,
    sdo_quarantine_s=3.0,
)


class Program:
    def __init__(self, bus, model, name):
        name, _, period_ms = name.partition(":")
        options = replace(PATIENT, status_period_ms=int(period_ms or 20))
        self.hardware = Cia402HwMotor(bus, node_id=1, options=options)
        self.motor = Cia402Motor(self.hardware, model=model, name=name)
        self.held = ExitStack()
        self.wrote = 0
        write = SdoChannel.download

        def counted(channel, *args, **kwargs):
            self.wrote += 1
            write(channel, *args, **kwargs)

        SdoChannel.download = counted
        self.velocity_when_armed = 0.0
        arm = Cia402Motor._arm

        def looking(motor, *args, **kwargs):
            self.velocity_when_armed = motor.velocity()
            return arm(motor, *args, **kwargs)

        Cia402Motor._arm = looking

    def do(self, word, *rest):
        timeout_s = float(rest[1]) if len(rest) > 1 else None
        motor, hardware = self.motor, self.hardware
        match word:
            case "move":
                motor.set_control_mode(ControlMode.SETPOINT)
                motor.set_setpoint(float(rest[0]), relative=True)
                motor.start(timeout_s)
                return "started"
            case "run":
                motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
                motor.set_setpoint(float(rest[0]))
                motor.start()
                return "started"
            case "wait":
                motor.wait_until_done(60.0)
                return "done"
            case "home":
                motor.home(wait=False)
                return "begun"
            case "stop":
                motor.stop()
                return "stopped"
            case "reserve":
                self.held.enter_context(motor.reserve(rest[0], timeout_s=timeout_s))
                return "reserved"
            case "seize":
                self.held.enter_context(motor.reserve(rest[0], take_over=True))
                return "reserved"
            case "low_level":
                self.held.enter_context(motor.low_level())
                return "alone"
            case "release":
                self.held.close()
                return "released"
            case "gain":
                motor.set_parameters(Cia402Parameters(position_gains=(int(rest[0]),)))
                return "set"
            case "read":
                value = hardware.upload(int(rest[0], 16), int(rest[1]))
                return f"read {int.from_bytes(value, 'little')}"
            case "read_many":
                texts = {hardware.upload(0x1008) for _ in range(int(rest[0]))}
                return "same" if len(texts) == 1 else f"different: {texts}"
            case "impatient":
                client = hardware.node.sdo._client
                client.timeout_s, patient_s = 1e-6, client.timeout_s
                try:
                    return f"read {hardware.upload(0x1018, 1).hex()}"
                finally:
                    client.timeout_s = patient_s
            case "position":
                return f"at {motor.position():.3f}"
            case "began":
                rest = abs(self.velocity_when_armed) < 0.01
                return f"began {'at rest' if rest else self.velocity_when_armed}"
            case "downloads":
                return f"wrote {self.wrote}"
        return f"what is {word}?"


def main():
    channel, model, name = sys.argv[1:]
    with can.Bus(interface="emulated", channel=channel) as bus:
        program = Program(bus, MotorModel.load(model), name)
        print("ready", flush=True)
        for line in sys.stdin:
            try:
                answer = program.do(*line.split())
            except MotorBusyError as error:
                answer = f"busy {error}"
            except MotorError as error:
                answer = f"failed {error}"
            print(answer, flush=True)


if __name__ == "__main__":
    main()
