"""Frames of our adaptations in short motions, read by others.

RobStride: robstride 0.1.0, unmodified. It packs enabling and disabling. It reads p, v and t of
feedback, which commands have in the same scales; kp is 0 to 500, and kd 0 to 5, over 16 bits.

VESC: numbers and scales of vedderb/bldc b9d287b3, documentation/comm_can.md. Frames that end a
motion are its golden frames. What pybldc packs is in test_pybldc.py.
"""

from contextlib import contextmanager
from itertools import pairwise
from math import pi, tau
from pathlib import Path

import can
import pytest
from robstride.client import Client, MotorMsg

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, ControlVariable, TrapezoidalTrajectory

ROBSTRIDE = """
bus.can0.bitrate_bit_s = 1_000_000
[controller.left]
kind = "robstride"
bus = "can0"
node_id = 7
model = "rs01"
[controller.left.plant]
preset = "wheel_60w"
gear_ratio = 10.0
load_inertia_kg_m2 = 0.01
encoder_increments_rev = 65536
[motor.left]
adaptation = "robstride"
controller = "left"
drive = "rs01"
kp_n_m_rad = 200.0
kd_n_m_s_rad = 2.5
inertia_kg_m2 = 0.0103
friction_n_m = 0.04
[motor.left.model]
velocity_max_rad_s = 4.0
acceleration_max_rad_s2 = 8.0
torque_max_n_m = 2.0
"""
VESC = """
bus.can0.bitrate_bit_s = 500_000
[controller.left]
kind = "vesc"
bus = "can0"
node_id = 23
status_1 = 25
plant.preset = "wheel_60w"
[motor.left]
adaptation = "vesc"
controller = "left"
brake_current_a = 5.0
[motor.left.model]
velocity_max_rad_s = {velocity}
acceleration_max_rad_s2 = {acceleration}
current_max_a = 60.0
gear_ratio = 1.0
position_tolerance_rad = 0.05
"""


@contextmanager
def opened(text):
    """Yield a rig, its motor, and a function that returns the frames so far."""
    with Rig(parse_rig(Source(Path("rig.toml"), text), installed_plugins()), seed=1) as rig:
        found: list[can.Message] = []
        with can.Bus(interface="emulated", channel="can0") as bus:

            def heard() -> list[can.Message]:
                while (one := bus.recv(0)) is not None:
                    found.append(one)
                return found

            yield rig, rig.motors["left"], heard


# ---- RobStride ----------------------------------------------------------------------------------


class Kept:
    """A bus that keeps what the client sends, and answers with one frame."""

    def __init__(self, answer=None):
        self.sent = []
        self._answer = answer

    def send(self, message):
        self.sent.append(message)

    def recv(self, _):
        return self._answer


def packed(verb):
    """Return the frame of the client for motor 7, from the host with our number."""
    bus = Kept()
    with pytest.raises(Exception, match="No response"):
        getattr(Client(bus, host_can_id=0xFD), verb)(7)
    return bus.sent[0].arbitration_id, bytes(bus.sent[0].data)


def read_command(frame):
    """Return p, v, t, kp, kd of a command: the first three as the client reads feedback."""
    number = frame.arbitration_id
    kind, torque, motor = number >> 24, number >> 8 & 0xFFFF, number & 0xFF
    assert (kind, motor, frame.dlc) == (MotorMsg.Control.value, 7, 8)
    data = bytes(frame.data[:4]) + torque.to_bytes(2, "big") + bytes(2)
    answer = can.Message(arbitration_id=0x02_00_07_AA, data=data, is_extended_id=True)
    told = Client(Kept(answer)).enable(7)
    kp, kd = (int.from_bytes(frame.data[at : at + 2], "big") / 65535 for at in (4, 6))
    return told.angle, told.velocity, told.torque, kp * 500, kd * 5


def of_host(frames, *kinds):
    return [one for one in frames if one.is_extended_id and one.arbitration_id >> 24 in kinds]


def test_robstride_client_packs_the_same_switching():
    with opened(ROBSTRIDE) as (rig, motor, heard):
        motor.enable()
        rig.runtime.run_for(0.1)
        motor.disable()
        frames = of_host(heard(), MotorMsg.Enable.value, MotorMsg.Disable.value)
    told = [(one.arbitration_id, bytes(one.data)) for one in frames]
    assert list(dict.fromkeys(told)) == [packed("enable"), packed("disable")]


def test_robstride_client_reads_the_motion_that_was_commanded():
    with opened(ROBSTRIDE) as (_, motor, heard):
        motor.enable()
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(TrapezoidalTrajectory(-1.0, initial=motor.position()))
        before = len(heard())
        motor.start()
        motor.wait_until_done(timeout_s=3)
        frames = of_host(heard()[before:], MotorMsg.Control.value)
        commands = [read_command(one) for one in frames]
    p, v, t, kp, kd = zip(*commands, strict=True)
    step = 8 * pi / 65535
    assert p[0] == pytest.approx(0.0, abs=0.001)
    assert p[-1] == pytest.approx(-1.0, abs=step)
    assert list(p) == sorted(p, reverse=True)
    assert min(v) == pytest.approx(-(8**0.5), abs=8.0 * 0.005 + 88 / 65535)  # a triangle
    assert v[-1] == pytest.approx(0.0, abs=88 / 65535)
    for at in range(1, len(p)):  # every 5 ms; velocities add up to positions, but for rounding
        assert p[at] - p[at - 1] == pytest.approx(0.0025 * (v[at] + v[at - 1]), abs=1.2 * step)
    # inertia and friction, within a code of the torque
    assert min(t) == pytest.approx(-(0.0103 * 8 + 0.04), abs=34 / 65535)
    assert max(t) == pytest.approx(0.0103 * 8 - 0.04, abs=34 / 65535)
    assert {round(one, 1) for one in kp} == {200.0}
    assert {round(one, 2) for one in kd} == {2.5}


# ---- VESC ---------------------------------------------------------------------------------------

CURRENT, BRAKE, RPM, POS = 0x117, 0x217, 0x317, 0x417  # to controller 23


def numbers(frames, can_id):
    """Return the numbers of a command: four bytes, the highest first."""
    found = [bytes(one.data) for one in frames if one.arbitration_id == can_id]
    assert all(len(one) == 4 for one in found)
    return [int.from_bytes(one, "big", signed=True) for one in found]


def go_to(motor, target, variable):
    motor.set_control_mode(ControlMode.SETPOINT, variable)
    motor.set_setpoint(target)
    motor.start()


def test_vesc_is_sent_the_position_in_millionths_of_a_degree():
    with opened(VESC.format(velocity=2.0, acceleration=8.0)) as (_, motor, heard):
        motor.enable()
        before = len(heard())
        go_to(motor, tau / 4, ControlVariable.POSITION)
        motor.wait_until_done(timeout_s=5)
        frames = heard()[before:]
    angles = [(one / 1e6 + 180) % 360 - 180 for one in numbers(frames, POS)]
    assert angles == sorted(angles)
    steps = [after - one for one, after in pairwise(angles)]
    assert max(steps) == pytest.approx(360 * 2.0 / tau * 0.005, rel=0.01)  # at the full velocity
    last = [one for one in frames if one.arbitration_id == POS][-1]
    assert bytes(last.data).hex().upper() == "055D4A80"  # 90 degrees
    assert numbers(frames, RPM) == numbers(frames, CURRENT) == []


def test_vesc_is_sent_the_velocity_in_electrical_turns_a_minute():
    with opened(VESC.format(velocity=60.0, acceleration=100.0)) as (rig, motor, heard):
        motor.enable()
        before = len(heard())
        go_to(motor, 3000 / 60 / 7 * tau, ControlVariable.VELOCITY)  # 7 pairs of poles
        rig.runtime.run_for(1.0)
        frames = heard()[before:]
    speeds = numbers(frames, RPM)
    assert speeds == sorted(speeds)
    steps = [after - one for one, after in pairwise(speeds)]
    assert max(steps) == pytest.approx(100.0 / tau * 60 * 7 * 0.005, abs=1)  # the ramp
    last = [one for one in frames if one.arbitration_id == RPM][-1]
    assert bytes(last.data).hex().upper() == "00000BB8"


def test_vesc_is_sent_the_current_in_milliamperes():
    with opened(VESC.format(velocity=60.0, acceleration=100.0)) as (rig, motor, heard):
        motor.enable()
        before = len(heard())
        go_to(motor, 51.0, ControlVariable.CURRENT)
        rig.runtime.run_for(0.01)
        frames = heard()[before:]
    last = [one for one in frames if one.arbitration_id == CURRENT][-1]
    assert bytes(last.data).hex().upper() == "0000C738"


def test_vesc_of_another_owner_is_sent_the_brake_current():
    with opened(VESC.format(velocity=2.0, acceleration=8.0)) as (rig, motor, heard):
        motor.enable()
        hardware = motor.hardware
        hardware.drive.confirm(hardware.stop_anyway())
        rig.runtime.run_for(0.01)
        brakes = [one for one in heard() if one.arbitration_id == BRAKE]
    assert [bytes(one.data).hex().upper() for one in brakes] == ["00001388"]
