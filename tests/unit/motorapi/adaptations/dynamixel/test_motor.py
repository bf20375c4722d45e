"""Motors on emulated Dynamixel servos: groups, modes, stops, and refusals."""

from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import RigError, Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    Motor,
    MotorError,
    MotorGroup,
    MotorState,
    PeerError,
    TrapezoidalTrajectory,
    UnsupportedError,
)
from motorhil.motorapi.adaptations.dynamixel import hardware, packets
from tests.support.kit_benches import RIGS

TEXT = (RIGS / "dynamixel.toml").read_text()


@contextmanager
def opened(text=TEXT):
    description = parse_rig(Source(Path("rig.toml"), text), installed_plugins())
    with Rig(description, seed=1) as rig:
        yield rig


@pytest.fixture
def rig():
    with opened() as one:
        yield one


def sent(rig):
    """Return the list that gets the packets of the host, in hex."""
    found: list[str] = []
    rig.world.tap_lines(
        lambda _, now_ns, start_ns, end_ns, sender, data, spoiled: (
            found.append(data.hex().upper()) if sender.startswith("host") else None
        )
    )
    return found


def test_group_starts_by_one_sync_write(rig):
    left, right = rig.motors["left"], rig.motors["right"]
    group = MotorGroup(left, right)
    group.for_each(Motor.enable)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(0.5), TrapezoidalTrajectory(-1.0))
    packets = sent(rig)
    group.start()
    starts = [packet for packet in packets if packet[14:16] == "83"]
    assert len(starts) == 1
    assert starts[0][16:24] == "6C000C00"  # 108, 12 bytes
    group.wait_until_done(timeout_s=5)
    assert [one.position() for one in (left, right)] == pytest.approx([0.5, -1.0], abs=0.004)
    assert group.sync_quality().start_skew_s == 0.0


def test_lost_sync_write_is_reported_by_start(rig):
    group = MotorGroup(rig.motors["left"], rig.motors["right"])
    group.for_each(Motor.enable)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(0.5), TrapezoidalTrajectory(-1.0))
    tell = rig.motors["left"].hardware.registers.line.tell

    def lost(request, unit, *owned, starts):
        rig.motors["left"].hardware.registers.line.started_ns[unit] = 0

    rig.motors["left"].hardware.registers.line.tell = lost
    with pytest.raises(PeerError, match="sync write, which is not acknowledged"):
        group.start()
    rig.motors["left"].hardware.registers.line.tell = tell


def test_stop_brakes_with_the_ramp_and_stays(rig):
    left = rig.motors["left"]
    left.set_control_mode(ControlMode.TRAJECTORY)
    left.set_trajectory(TrapezoidalTrajectory(3.0))
    left.enable()
    left.start()
    rig.runtime.run_for(0.4)
    left.stop()
    left.wait_until_done(timeout_s=2)
    at = left.position()
    assert 0.5 < at < 2.9
    rig.runtime.run_for(0.5)
    assert left.position() == pytest.approx(at, abs=0.003)  # it came back by a count at most
    assert left.state() is MotorState.ENABLED


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        (b"\xff" * 36, "FF7F0000FF7F0000"),
        (b"\1" + bytes(7) + b"\x7f" * 28, "0100000000000000FFFF0F00"),
    ],
)
def test_stop_of_a_servo_that_tells_nonsense_is_in_its_ranges(rig, monkeypatch, told, expected):
    """The goal of register 116 is at most 1,048,575; profiles are at most 32,767."""
    motor = rig.motors["left"]
    motor.enable()
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(3.0)
    motor.start()
    rig.runtime.run_for(0.2)
    status_in = packets._status_in
    monkeypatch.setattr(
        packets,
        "_status_in",
        lambda packet, unit: (
            (status := status_in(packet, unit))
            and status._replace(data=told if len(status.data) == 36 else status.data)
        ),
    )
    found = sent(rig)
    with suppress(MotorError):
        motor.stop()
        rig.runtime.run_for(0.1)
    (stop,) = [one for one in found if one[14:20] == "036C00" and one[20:].startswith(expected)]
    assert stop


def test_move_after_the_watchdog_starts_where_the_servo_stands(rig):
    """A servo stopped less than a two-hundredth of a turn short once began from its old target."""
    left, stands = rig.motors["left"], lambda: rig.controllers["left"].snapshot()["position_rad"]

    def move(distance):
        left.set_control_mode(ControlMode.TRAJECTORY)
        left.set_trajectory(TrapezoidalTrajectory(distance))
        left.start()

    left.enable()
    move(-0.32)
    rig.faults.inject("line", SerialFaultRule("lose", SerialFaultKind.LOSE))
    rig.runtime.run_for(1.0)
    rig.faults.lift("line", "lose")
    begun = stands()
    assert -0.315 < begun < -0.289  # within a two-hundredth of a turn
    left.enable()
    move(-0.4)
    left.wait_until_done(2.0)
    assert stands() == pytest.approx(begun - 0.4, abs=0.004)


def test_velocity_mode_runs_and_stops():
    text = TEXT.replace('adaptation = "dynamixel"', 'adaptation = "dynamixel"\nmode = "velocity"')
    with opened(text) as rig:
        left = rig.motors["left"]
        left.enable()
        with pytest.raises(UnsupportedError):
            left.set_control_mode(ControlMode.TRAJECTORY)
        left.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        left.set_setpoint(-2.0)
        left.start()
        left.wait_until_done(timeout_s=2)
        rig.runtime.run_for(0.2)
        assert left.velocity() == pytest.approx(-2.0, abs=0.06)
        left.stop()
        left.wait_until_done(timeout_s=2)
        assert abs(left.velocity()) < 0.06


def test_velocity_beyond_the_register_is_refused():
    text = TEXT.replace('adaptation = "dynamixel"', 'adaptation = "dynamixel"\nmode = "velocity"')
    with opened(text.replace("velocity_max_rad_s = 6.0", "velocity_max_rad_s = 1e6")) as rig:
        left = rig.motors["left"]
        left.enable()
        left.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        left.set_setpoint(0.9e6)  # 3.75e7 steps; the register has 15 bits and a sign
        with pytest.raises(LimitError, match=r"velocity 900000 rad/s, .* 785\.374 rad/s"):
            left.start()


def test_errors_that_come_together_are_all_told(rig):
    rig.motors["left"].enable()
    rig.controllers["left"].stimulate("fault", 0x24)  # register 70: bits 2 and 5
    assert "overheating, overload" in repr(rig.motors["left"].fault())


def test_servo_is_referenced_without_homing(rig):
    assert rig.motors["left"].is_referenced()  # its encoder is absolute


def test_target_beyond_256_turns_is_refused(rig):
    left = rig.motors["left"]
    left.enable()
    left.set_control_mode(ControlMode.SETPOINT)
    left.set_setpoint(257 * 6.2832)
    with pytest.raises(LimitError, match="range of the servo's goal"):
        left.start()


def test_velocity_below_the_smallest_step_is_refused(rig):
    # Profile velocity of X servos: 0.229 rpm, 0.02398 rad/s; only less is refused.
    left = rig.motors["left"]
    left.enable()
    left.set_control_mode(ControlMode.SETPOINT)
    left.set_setpoint(0.01, limits=DerivativeLimits(first=0.0239))
    with pytest.raises(LimitError, match=r"velocity limit 0\.0239 rad/s, .*at least 0\.0239"):
        left.start()
    rig.runtime.run_for(0.5)
    assert left.position() == pytest.approx(0.0, abs=0.002)
    left.set_setpoint(0.01, limits=DerivativeLimits(first=0.024))
    left.start()
    left.wait_until_done(2.0)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("registers = { return_delay_time = 25 }", "registers = { drive_mode = 4 }",
         "profiles are time-based"),
        ("gear_ratio = 1.0\n", "", "gear_ratio is not given"),
    ],
)  # fmt: skip
def test_servo_that_cannot_be_used_is_refused_in_words(old, new, told):
    with opened(TEXT.replace(old, new)) as rig, pytest.raises(Exception, match=told):
        rig.motors["left"].enable()


def test_servo_of_another_series_is_refused(rig, monkeypatch):
    monkeypatch.setattr(hardware, "_X_SERIES", (1020,))
    with pytest.raises(PeerError, match="model number 1200, firmware 52, is not of the X series"):
        rig.motors["left"].enable()


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('kind = "serial"', 'kind = "modbus_rtu"', "for buses of kind serial"),
        ("baud_bit_s = 1_000_000", "baud_bit_s = 19_200", "bit rate is 19200 bit/s"),
        ('adaptation = "dynamixel"', 'adaptation = "dynamixel"\nmode = "torque"', "mode"),
        ("unit = 1\n", "unit = 253\n", "unit"),
    ],
)
def test_mistake_in_a_rig_is_told_with_its_line(old, new, told):
    with pytest.raises(RigError, match=told), opened(TEXT.replace(old, new, 1)) as rig:
        rig.motors["left"].enable()


@pytest.mark.parametrize("key", ["unit", "function"])
def test_fault_by_unit_on_a_serial_line_is_refused(key):
    fault = f'[[fault]]\nbus = "line"\nkind = "lose"\n{key} = 1\n'
    told = f'{key}: bus "line" is of kind serial, whose protocol is not known; write sender instead'
    with pytest.raises(RigError, match=told), opened(TEXT + fault):
        pass
