"""A program that loses its drive while it is paused.

python -m tests.support.programs.fenced_owner CHANNEL HOW

HOW is "fenced", or a defect that the tests must detect: "unfenced" (its frames are sent without
regard to the owner of the drive), "careless" (they are sent with its former token, unchecked).

    stream LEASE_S  "streaming": a motion of a minute, in a reservation (LEASE_S 0: without a lease)
    run             the same by the drive's own profile, with a low acceleration
    stop            "stopped": it slows down, for seconds
    group           arms nodes 1 and 2, says "armed", and sends SYNC after a pause and its end;
                    then "started", or "busy WHY"
    spoil           "spoilt": the function of the stream fails once the program was paused
    told            the error that on_done reported without any wait for the motor, and the error of
                    the stream, once both have ended
    write           "wrote" a setting, by SDO; or "busy WHY"
    wait            "done", or "interrupted WHY"
    renew           "renewed", or "busy WHY"
    again           "started" a small move; or "busy WHY"
    end             "ended" the reservation
"""

import signal
import sys
from contextlib import ExitStack

import can

from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    MotionInterrupted,
    MotorBusyError,
    MotorGroup,
    MotorModel,
)
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.cia402.sync_start import SyncTrigger
from motorhil.motorapi.ownership.fencing import BoundFence, NodeFence
from tests.support.motors.streaming import quintic, set_function

MODEL = MotorModel(name="wheel", velocity_max=3.0, acceleration_max=10.0)
OPTIONS = HwOptions(
    set_point_period_ms=10, heartbeat_timeout_ms=30_000, sdo_timeout_s=10.0, connect_timeout_s=30.0
)


def open_bus(channel):
    """Open a bus of a hub, by the path of its socket, or a SocketCAN interface."""
    interface = "emulated" if "/" in channel else "socketcan"
    return can.Bus(interface=interface, channel=channel)


def fence_of(fence):
    return fence._fence if isinstance(fence, BoundFence) else fence


def send_carelessly(fence, frame):
    token = fence._hold.token if isinstance(fence, BoundFence) else fence.lock._hold.token
    fence_of(fence).let_out(frame, token)


class Program:
    def __init__(self, bus, how):
        if how != "fenced":
            send = {
                "unfenced": lambda fence, frame: fence_of(fence).runtime.send(bus, frame),
                "careless": send_carelessly,
            }[how]
            BoundFence.send = NodeFence.send = send
        self.hardware = Cia402HwMotor(bus, node_id=1, options=OPTIONS)
        self.motor = Cia402Motor(self.hardware, model=MODEL, name="owner")
        self.held = ExitStack()
        self.reservation = None
        self.outcomes = []

    def do(self, word, *rest):
        motor = self.motor
        match word:
            case "stream" | "run":
                lease_s = float(rest[0]) if rest else 0.0
                self.reservation = self.held.enter_context(
                    motor.reserve("survey", lease_s=lease_s or None)
                )
                if word == "stream":
                    set_function(motor, quintic(60.0, 60.0))
                else:
                    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
                    motor.set_setpoint(1.0, limits=DerivativeLimits(first=0.5))
                motor.start()
                motor.on_done(self.outcomes.append)
                return "streaming"
            case "group":
                return self.start_group()
            case "spoil":
                stream, resumed = self.hardware.stream, []
                signal.signal(signal.SIGCONT, lambda *_: resumed.append(True))
                target = stream._next_target
                stream._next_target = lambda cycle: 1 / 0 if resumed else target(cycle)
                return "spoilt"
            case "stop":
                motor.stop()
                return "stopped"
            case "told":
                stream = self.hardware.stream  # either may be notified first
                motor.runtime.wait_until(lambda: bool(self.outcomes) and stream.ended, 60.0)
                return f"{self.outcomes[0].error}; the stream: {stream.error}"
            case "write":
                self.hardware.write(0x6065, 2000)
                return "wrote"
            case "wait":
                motor.wait_until_done(60.0)
                return "done"
            case "renew":
                self.reservation.renew()
                return "renewed"
            case "again":
                motor.set_control_mode(ControlMode.SETPOINT)
                motor.set_setpoint(0.1, relative=True)
                motor.start()
                return "started"
            case "end":
                self.held.close()
                return "ended"
        return f"what is {word}?"

    def start_group(self):
        second = Cia402Motor(
            Cia402HwMotor(self.hardware.link.bus, node_id=2, options=OPTIONS), MODEL, name="second"
        )
        fire = SyncTrigger.fire

        def paused(trigger):
            resumed = []
            signal.signal(signal.SIGCONT, lambda *_: resumed.append(True))
            print("armed", flush=True)
            self.motor.runtime.wait_until(lambda: bool(resumed), 60.0)
            fire(trigger)

        SyncTrigger.fire = paused
        for motor in (self.motor, second):
            motor.set_control_mode(ControlMode.SETPOINT)
            motor.set_setpoint(2.0, relative=True)
        MotorGroup(self.motor, second).start()
        return "started"


def main():
    channel, how = sys.argv[1:]
    with open_bus(channel) as bus:
        program = Program(bus, how)
        print("ready", flush=True)
        for line in sys.stdin:
            try:
                answer = program.do(*line.split())
            except MotorBusyError as error:
                answer = f"busy {error}"
            except MotionInterrupted as error:
                answer = f"interrupted {error}"
            print(answer, flush=True)


if __name__ == "__main__":
    main()
