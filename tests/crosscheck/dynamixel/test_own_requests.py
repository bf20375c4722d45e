"""Packets of our adaptation, read and made again by the maker's SDK (dynamixel-sdk 4.1.0).

The SDK checks the CRC, removes the stuffing, and packs the commanded values by itself. It never
sends a stuffed packet, so that one is compared with the result of its `addStuffing`.
"""

from contextlib import contextmanager
from math import sqrt, tau
from pathlib import Path

import pytest
from dynamixel_sdk import (
    BROADCAST_ID,
    INST_READ,
    INST_SYNC_WRITE,
    INST_WRITE,
    GroupSyncWrite,
    PacketHandler,
)

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    Motor,
    MotorGroup,
    TrapezoidalTrajectory,
)

UNITS = {"left": 1, "right": 2}
RIG = 'bus.line = {kind = "serial", baud_bit_s = 1_000_000}\n'
UNIT = """
[controller.{name}]
kind = "dynamixel"
bus = "line"
unit = {unit}
boot_up_s = 0
plant.preset = "wheel_60w"
[motor.{name}]
adaptation = "dynamixel"
controller = "{name}"
{more}
model.gear_ratio = 1.0
model.velocity_max_rad_s = 4.0
model.acceleration_max_rad_s2 = 8.0
"""
COUNTS = 4096 / tau
SPEED = 15.625  # counts/s of 1 in a register of velocity, by the maker's formula for t1
RAMP = 244.140625  # counts/s2, likewise
TORQUE, VELOCITY, PROFILE, GOAL = 64, 104, 108, 116
SDK = PacketHandler(2.0)


@contextmanager
def opened(more=""):
    text = RIG + "".join(UNIT.format(name=n, unit=u, more=more) for n, u in UNITS.items())
    description = parse_rig(Source(Path("rig.toml"), text), installed_plugins())
    with Rig(description, seed=1) as rig:
        yield rig


def sent(rig):
    """Return the list that gets the packets of the host."""
    found: list[bytes] = []
    rig.world.tap_lines(
        lambda _, now_ns, start_ns, end_ns, sender, data, spoiled: (
            found.append(data) if sender.startswith("host") else None
        )
    )
    return found


def read(packet):
    """Return (id, instruction, parameters) as the SDK reads a packet."""
    crc = SDK.updateCRC(0, list(packet), len(packet) - 2)
    assert crc == int.from_bytes(packet[-2:], "little")
    assert int.from_bytes(packet[5:7], "little") == len(packet) - 7
    plain = SDK.removeStuffing(list(packet))
    end = 7 + int.from_bytes(bytes(plain[5:7]), "little") - 2
    return plain[4], plain[7], bytes(plain[8:end])


class Port:
    """A port that keeps what the SDK sends."""

    def __init__(self):
        self.is_using = False
        self.written = b""

    def clearPort(self):  # noqa: N802 -- the SDK's names
        pass

    def writePort(self, packet):  # noqa: N802
        self.written = bytes(packet)
        return len(packet)


def written(unit, address, *values, size=4):
    """Return the packet of the SDK that writes values."""
    port = Port()
    data = b"".join(value.to_bytes(size, "little", signed=value < 0) for value in values)
    SDK.writeTxOnly(port, unit, address, len(data), list(data))
    return port.written


def registers(packet):
    """Return (id, address, numbers) of a write of numbers with four bytes."""
    unit, instruction, data = read(packet)
    assert instruction == INST_WRITE
    values = (data[at : at + 4] for at in range(2, len(data), 4))
    numbers = tuple(int.from_bytes(one, "little", signed=True) for one in values)
    return unit, int.from_bytes(data[:2], "little"), numbers


def go_to(motor, target, variable=ControlVariable.POSITION):
    motor.set_control_mode(ControlMode.SETPOINT, variable)
    motor.set_setpoint(target)
    motor.start()


@pytest.mark.parametrize("target", [0.5, -1.25, 7.0])
def test_sdk_reads_the_motion_that_was_commanded(target):
    with opened() as rig:
        motor = rig.motors["left"]
        packets = sent(rig)
        motor.enable()
        go_to(motor, target)
        motor.wait_until_done(timeout_s=10)
        motor.disable()
        assert {read(one)[1] for one in packets} == {INST_READ, INST_WRITE}
        writes = [one for one in packets if one[7] == INST_WRITE]
        on, off = written(1, TORQUE, 1, size=1), written(1, TORQUE, 0, size=1)
        assert writes.index(on) < writes.index(off) == len(writes) - 1
        motions = [registers(one) for one in writes if one[8] == PROFILE]
        assert len(motions) == 1
        unit, _, (ramp, speed, goal) = motions[0]
        assert unit == 1
        assert goal == round(target * COUNTS) + 2048
        assert ramp == int(8.0 * COUNTS / RAMP)  # of the model, rounded down
        assert speed == int(4.0 * COUNTS / SPEED)
        assert written(1, PROFILE, ramp, speed, goal) in writes


def test_sdk_reads_the_velocity_that_was_commanded():
    with opened('mode = "velocity"') as rig:
        motor = rig.motors["right"]
        motor.enable()
        packets = sent(rig)
        go_to(motor, -2.0, ControlVariable.VELOCITY)
        rig.runtime.run_for(0.5)
        motor.stop()
        rig.runtime.run_for(0.5)
        goals = [registers(one) for one in packets if one[7:9] == bytes((INST_WRITE, VELOCITY))]
        ramp = int(8.0 * COUNTS / RAMP)
        assert goals[0] == (2, VELOCITY, (-round(2.0 * COUNTS / SPEED), ramp))
        assert goals[-1][2][0] == 0


def test_stop_is_the_goal_at_which_the_ramp_ends():
    with opened() as rig:
        motor = rig.motors["left"]
        go_to(motor, 6.0)
        rig.runtime.run_for(1.0)
        position, packets = motor.position(), sent(rig)
        motor.stop()
        rig.runtime.run_for(0.1)
        goals = [registers(one) for one in packets if one[7:9] == bytes((INST_WRITE, PROFILE))]
        assert len(goals) == 1
        way = goals[0][2][2] - 2048 - position * COUNTS
        assert way == pytest.approx(4.0**2 / (2 * 8.0) * COUNTS, abs=0.012 * 4.0 * COUNTS)  # a poll


def test_start_of_a_group_is_the_sync_write_of_the_sdk():
    with opened() as rig:
        group = MotorGroup(*rig.motors.values())
        group.for_each(Motor.enable)
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        group.set_trajectory(TrapezoidalTrajectory(0.5), TrapezoidalTrajectory(-1.0))
        packets = sent(rig)
        group.start()
        starts = [one for one in packets if one[7] == INST_SYNC_WRITE]
        assert len(starts) == 1
        unit, _, data = read(starts[0])
        assert (unit, data[:4]) == (BROADCAST_ID, bytes((PROFILE, 0, 12, 0)))
        port = Port()
        own = GroupSyncWrite(port, SDK, PROFILE, 12)
        goals = {}
        for at in range(4, len(data), 13):
            one = data[at : at + 13]
            assert own.addParam(one[0], list(one[1:]))
            goals[one[0]] = tuple(int.from_bytes(one[n : n + 4], "little") for n in (1, 5, 9))
        own.txPacket()
        assert port.written == starts[0]
        ways = [goals[unit][2] - 2048 for unit in (1, 2)]
        assert ways == [round(0.5 * COUNTS), -round(1.0 * COUNTS)]
        seconds = [_duration_s(goals[1], 0.5 * COUNTS), _duration_s(goals[2], 1.0 * COUNTS)]
        assert seconds[0] == pytest.approx(seconds[1], rel=0.05)  # they end together


def _duration_s(values, way):
    """Return how long the servo needs by the maker's formulas."""
    ramp, speed = values[0] * RAMP, values[1] * SPEED
    if speed * speed / ramp > way:
        return 2 * sqrt(way / ramp)
    return way / speed + speed / ramp


def test_goal_with_the_mark_of_a_header_is_stuffed_as_by_the_sdk():
    goal = int.from_bytes(b"\xff\xff\xfd\xff", "little", signed=True)
    with opened() as rig:
        motor = rig.motors["left"]
        motor.enable()
        packets = sent(rig)
        go_to(motor, (goal - 2048) / COUNTS)
        writes = [one for one in packets if one[7:9] == bytes((INST_WRITE, PROFILE))]
        assert len(writes) == 1
        assert registers(writes[0])[2][2] == goal
        plain = list(written(1, PROFILE, *registers(writes[0])[2]))
        stuffed = SDK.addStuffing(plain)
        crc = SDK.updateCRC(0, stuffed, len(stuffed) - 2)
        assert bytes(stuffed[:-2]) + crc.to_bytes(2, "little") == writes[0]
        assert len(writes[0]) == len(plain) + 1
