"""A motor behind an RMD: its frames, and what the conformance kit does not ask.

Golden frames: MyActuator, Servo Motor Control Protocol V4.2 (2024-05).
"""

from math import radians
from pathlib import Path

import can
import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, ControlVariable, MotorState
from motorhil.motorapi.errors import (
    DeviceFault,
    LinkError,
    MotionInterrupted,
    MotorBusyError,
    UsageError,
)
from motorhil.motorapi.model import MotorModel

MODEL = "velocity_max_rad_s = 2.0\nacceleration_max_rad_s2 = 4.0\n"


def opened(drive="", model=""):
    """Return a rig of one RMD."""
    text = (
        "bus.can0.bitrate_bit_s = 1_000_000\n"
        f'[controller.left]\nkind = "rmd"\nbus = "can0"\nnode_id = 1\n{drive}\n'
        'plant = { preset = "wheel_60w" }\n'
        '[motor.left]\nadaptation = "rmd"\ncontroller = "left"\n'
        f"[motor.left.model]\n{MODEL}{model}"
    )
    return Rig(parse_rig(Source(Path("rmd.toml"), text), installed_plugins()))


def go_to(motor, target, variable=ControlVariable.POSITION):
    motor.set_control_mode(ControlMode.SETPOINT, variable)
    motor.set_setpoint(target)
    motor.start()


def true(rig, what="position_rad"):
    return rig.controllers["left"].snapshot()[what]


class Ear:
    """All frames to and from the drive, with its own bus object."""

    def __init__(self, rig):
        self.bus = can.Bus(interface="emulated", channel="can0")
        self.rig = rig

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.bus.shutdown()

    def heard(self):
        frames = []
        while (message := self.bus.recv(0)) is not None:
            frames.append((message.arbitration_id, bytes(message.data).hex().upper()))
        return frames

    def say(self, can_id, data):
        message = can.Message(arbitration_id=can_id, data=bytes.fromhex(data), is_extended_id=False)
        self.bus.send(message)
        self.rig.runtime.wait_until(lambda: False, 0.01)


@pytest.mark.parametrize(
    ("variable", "value", "frame"),
    [
        (ControlVariable.CURRENT, 1.0, (0x141, "A100000064000000")),
        (ControlVariable.CURRENT, -1.0, (0x141, "A10000009CFF0000")),
        (ControlVariable.VELOCITY, 100.0, (0x141, "A200000010270000")),
        (ControlVariable.VELOCITY, -100.0, (0x141, "A2000000F0D8FFFF")),
        (ControlVariable.POSITION, 360.0, (0x141, "A4000000A08C0000")),
        (ControlVariable.POSITION, -360.0, (0x141, "A40000006073FFFF")),
    ],
)
def test_set_point_is_the_frame_of_the_manual(variable, value, frame):
    with opened() as rig, Ear(rig) as ear:
        hardware = rig.motors["left"].hardware
        rig.motors["left"].position()  # connects
        hardware.drive.confirm(hardware.send(variable, value, None))
        assert frame in ear.heard()


def test_speed_from_long_ago_is_none_of_a_new_angle():
    with opened() as rig, Ear(rig) as ear:
        motor = rig.motors["left"]
        motor.position()  # connects
        rig.faults.inject("can0", FaultRule("silence", FaultKind.DROP, sender="left"))
        assert rig.runtime.wait_until(lambda: motor.latest() is None, 1.0)
        for _ in range(2):  # the first one may be an echo
            ear.say(0x241, "A4190A0030001100")  # 48 deg/s
        rig.runtime.run_for(1.0)
        ear.say(0x241, "92000000E1070000")
        assert motor.latest() is None


def test_accelerations_are_written_to_rom_once():
    with opened() as rig, Ear(rig) as ear:
        motor = rig.motors["left"]
        for target in (0.5, 1.0, -0.5):
            go_to(motor, target)
            motor.wait_until_done(timeout_s=5)
        written = [data for can_id, data in ear.heard() if can_id == 0x141 and data[:2] == "43"]
        assert written == [f"43{index:02X}000000000000" for index in range(4)]
        assert true(rig, "rom_writes") == 4


def test_accelerations_of_zero_are_not_written_again():
    with opened("acceleration_dps_s = 0") as rig:
        go_to(rig.motors["left"], 0.5)
        assert true(rig, "rom_writes") == 0


def test_position_goes_on_over_turns():
    with opened() as rig:
        motor = rig.motors["left"]
        go_to(motor, 20.0)
        motor.wait_until_done(timeout_s=15)
        assert true(rig) == pytest.approx(20.0, abs=0.003)
        assert motor.position() == pytest.approx(20.0, abs=0.003)


def test_negative_gear_ratio_reverses():
    with opened(model="gear_ratio = -1.0") as rig:
        motor = rig.motors["left"]
        go_to(motor, 1.0)
        motor.wait_until_done(timeout_s=5)
        assert true(rig) == pytest.approx(-1.0, abs=0.003)
        assert motor.position() == pytest.approx(1.0, abs=0.003)


def test_motor_that_never_answers_is_a_lost_link():
    with opened() as rig:
        rig.controllers["left"].stimulate("power", 0)
        with pytest.raises(LinkError, match="no answer to 92h, 9Ah and 42h within 3 s"):
            rig.motors["left"].enable()


def test_linear_model_is_refused():
    from motorhil.motorapi.adaptations.rmd.motor import RmdMotor
    from motorhil.motorapi.model import MotionKind

    model = MotorModel(name="x", kind=MotionKind.LINEAR, velocity_max=1.0, acceleration_max=1.0)
    with opened() as rig:
        hardware = rig.motors["left"].hardware
        with pytest.raises(UsageError, match="kind is linear; expected rotary"):
            RmdMotor(hardware, model)


def test_target_beyond_32_bits_is_refused():
    with opened() as rig, pytest.raises(UsageError, match="does not fit 32 bits"):
        go_to(rig.motors["left"], 1e6)


@pytest.mark.parametrize("deaf_s", [0.15, 0.155])  # the angle is every second request
def test_echo_after_an_interruption_is_not_an_angle(deaf_s):
    """The first request comes back with zeros, which would be an angle of 0."""
    with opened("interruption_ms = 100") as rig:
        motor = rig.motors["left"]
        go_to(motor, 2.0)
        motor.wait_until_done(timeout_s=5)
        seen = []
        hardware = motor.hardware
        rule = FaultRule("deaf", FaultKind.DROP, identifier=0x141)
        rig.faults.inject("can0", rule)
        rig.runtime.run_for(deaf_s)  # F1h comes, and the next request is swallowed
        rig.faults.lift("can0", "deaf")
        for _ in range(100):
            rig.runtime.run_for(0.002)
            if hardware.estimate is not None:
                seen.append(hardware.estimate.position)
        assert seen
        assert min(seen) > 100.0
        assert motor.state() is MotorState.DISABLED


def test_interrupted_motion_is_told():
    with opened("interruption_ms = 100") as rig:
        motor = rig.motors["left"]
        go_to(motor, 10.0)
        rig.runtime.run_for(0.5)
        rig.faults.inject("can0", FaultRule("deaf", FaultKind.DROP, identifier=0x141))
        with pytest.raises((MotionInterrupted, LinkError)):
            motor.wait_until_done(timeout_s=5)
        assert true(rig, "mode") == 0


def test_stop_of_a_stream_that_another_program_ended_is_one_frame(monkeypatch):
    def refuse(*_):
        raise MotorBusyError(motor="left", holder="rescue", since_ns=0)

    with opened() as rig, Ear(rig) as ear:
        motor = rig.motors["left"]
        go_to(motor, 3.0)
        rig.runtime.run_for(0.5)
        ear.heard()
        monkeypatch.setattr(motor.hardware, "send", refuse)
        motor.stop()
        rig.runtime.run_for(0.5)
        assert (0x141, "8100000000000000") in ear.heard()
        assert true(rig, "velocity_rad_s") == pytest.approx(0.0, abs=1e-3)


def test_fault_of_level_1_is_reset_by_a_restart():
    with opened() as rig:
        motor = rig.motors["left"]
        go_to(motor, 2.0)
        rig.runtime.run_for(0.3)
        rig.controllers["left"].stimulate("fault", 0x0010)
        with pytest.raises(DeviceFault, match="over-current"):
            motor.wait_until_done(timeout_s=5)
        assert motor.state() is MotorState.FAULT
        motor.reset_fault()
        assert (motor.state(), true(rig, "fault")) == (MotorState.DISABLED, 0)
        go_to(motor, 0.5)
        motor.wait_until_done(timeout_s=5)


def test_fault_of_level_2_is_kept_until_reset():
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        rig.controllers["left"].stimulate("fault", 0x1000)
        rig.runtime.run_for(1.0)
        assert true(rig, "fault") == 0
        assert motor.fault().text == "over-temperature of the motor"
        motor.reset_fault()
        assert motor.state() is MotorState.DISABLED


def test_blocked_motor_is_a_stall():
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        rig.controllers["left"].stimulate("load_torque_n_m", 100.0)
        go_to(motor, radians(90))
        with pytest.raises(DeviceFault, match="stall"):
            motor.wait_until_done(timeout_s=5)


def test_speed_from_before_a_loss_is_forgotten():
    with opened() as rig:
        motor = rig.motors["left"]
        go_to(motor, 1.0, ControlVariable.VELOCITY)
        rig.runtime.run_for(1.0)
        now_ns = rig.runtime.now_ns()
        lost = FaultRule("lost", FaultKind.DROP, sender="left", until_ns=now_ns + 1_000_000_000)
        rig.faults.inject("can0", lost)
        rig.runtime.run_for(0.1)
        motor.hardware.stop_anyway()
        assert rig.runtime.wait_until(lambda: motor.latest() is None, 1.0)
        assert rig.runtime.wait_until(lambda: motor.latest() is not None, 1.0)
        assert abs(motor.latest().velocity) < 0.02  # one deg/s


def test_answer_of_an_unknown_acceleration_leaves_the_motor_usable():
    with opened() as rig, Ear(rig) as ear:
        motor = rig.motors["left"]
        motor.position()
        ear.say(0x241, "4204000000000000")
        motor.position()
        go_to(motor, 0.1)
        motor.wait_until_done(timeout_s=5)


@pytest.mark.parametrize(
    "frame", [(0x141, "8000000000000000"), (0x280, "8100000000000000"), (0x141, "A200000010270000")]
)
def test_command_of_another_program_interrupts(frame):
    with opened() as rig, Ear(rig) as ear:
        motor = rig.motors["left"]
        go_to(motor, 2.0)
        rig.runtime.run_for(0.3)
        ear.say(*frame)
        with pytest.raises(MotionInterrupted, match="another program"):
            motor.wait_until_done(timeout_s=5)


def test_reading_of_another_program_does_not_interrupt():
    with opened() as rig, Ear(rig) as ear:
        motor = rig.motors["left"]
        go_to(motor, 1.0)
        ear.say(0x141, "9C00000000000000")
        motor.wait_until_done(timeout_s=5)
