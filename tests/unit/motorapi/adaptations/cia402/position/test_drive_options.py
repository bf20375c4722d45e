"""The drive's own halt option, home offset and polarity under a motor: 605Dh, 607Ch, 607Eh."""

from collections.abc import Callable

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    LimitError,
    Motor,
    TrapezoidalTrajectory,
    UnsupportedError,
)
from tests.support.motors.drive_rigs import drive
from tests.support.motors.wheels import INCREMENT_RAD, WINDOW_RAD, frames_on, go_to, motor_of, truth

OpenRig = Callable[..., Rig]
SLOW = 'objects = {{ "605Dh" = {option}, "6085h" = 2_000_000 }}'
SWITCHES = """
[controller.left.switches]
negative_limit_rad = -0.5
"""


def braking_rad_s2(rig: Rig, motor: Motor, stop: Callable[[], None]) -> float:
    """Return the deceleration of the drive's demand after `stop`, of a motion at 2 rad/s."""
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(40.0, duration_s=21.0))
    motor.start()
    rig.runtime.run_for(1.5)
    begin = rig.controllers["left"].snapshot()["demand_inc"]
    rig.runtime.run_for(0.001)
    speed = rig.controllers["left"].snapshot()["demand_inc"] - begin
    stop()
    begin = rig.controllers["left"].snapshot()["demand_inc"]
    motor.wait_until_done(timeout_s=5)
    way = rig.controllers["left"].snapshot()["demand_inc"] - begin
    return (speed * 1e3) ** 2 / (2.0 * way) * INCREMENT_RAD


# --- 605Dh, halt option code


@pytest.mark.parametrize("option", [1, 2, 3])
@pytest.mark.parametrize("how", ["stop", "halt"])
def test_stop_decelerates_as_the_motion_under_605dh(open_rig: OpenRig, how: str, option: int):
    rig = open_rig(drive("left", 1, SLOW.format(option=option)))
    motor = motor_of(rig)
    assert braking_rad_s2(rig, motor, getattr(motor, how)) == pytest.approx(10.0, rel=0.05)


def test_disable_restores_605dh(open_rig: OpenRig):
    rig = open_rig(drive("left", 1, SLOW.format(option=2)))
    motor = motor_of(rig)
    braking_rad_s2(rig, motor, motor.stop)
    assert rig.world.controller("left").od.get(0x605D, 0).integer() == 1
    motor.disable()
    assert rig.world.controller("left").od.get(0x605D, 0).integer() == 2


def test_low_level_access_begins_with_the_own_605dh(open_rig: OpenRig):
    rig = open_rig(drive("left", 1, SLOW.format(option=2)))
    motor = motor_of(rig)
    braking_rad_s2(rig, motor, motor.stop)
    with motor.low_level() as hardware:
        assert hardware.read("halt_option_code") == 2
    assert braking_rad_s2(rig, motor, motor.stop) == pytest.approx(10.0, rel=0.05)


@pytest.mark.parametrize(("option", "tries"), [(1, 0), (2, 1)])
def test_stop_decelerates_as_the_motion_if_605dh_is_fixed(
    open_rig: OpenRig, option: int, tries: int
):
    rig = open_rig(drive("left", 1, SLOW.format(option=option)))
    rig.world.controller("left").od.get(0x605D, 0).access = "ro"
    motor, frames = motor_of(rig), frames_on(rig)
    for _ in range(2):
        assert braking_rad_s2(rig, motor, motor.stop) == pytest.approx(10.0, rel=0.05)
        assert downloads(frames, 0x605D) == tries


def test_605dh_is_not_written_if_it_is_right(open_rig: OpenRig):
    rig = open_rig(drive("left", 1, SLOW.format(option=1)))
    motor, frames = motor_of(rig), frames_on(rig)
    for stop in (motor.stop, motor.halt):
        braking_rad_s2(rig, motor, stop)
    motor.disable()
    assert downloads(frames, 0x605D) == downloads(frames, 0x6085) == 0


def test_drive_without_605dh_stops(open_rig: OpenRig):
    rig = open_rig(drive("left", 1))
    rig.world.controller("left").od.get(0x605D, 0).access = "wo"
    motor = motor_of(rig)
    assert braking_rad_s2(rig, motor, motor.stop) == pytest.approx(10.0, rel=0.05)


@pytest.mark.parametrize("option", [1, 2])
def test_stop_of_homing_decelerates_by_609ah(open_rig: OpenRig, option: int):
    objects = (
        f'objects = {{ "605Dh" = {option}, "6085h" = 2_000_000, "6099h:1" = 60000,'
        ' "609Ah" = 100_000 }'
    )
    rig = open_rig(drive("left", 1, objects + SWITCHES.replace("-0.5", "-3.0")))
    motor = motor_of(rig)
    motor.home(17, wait=False)
    rig.runtime.run_for(0.8)
    begin = rig.controllers["left"].snapshot()["demand_inc"]
    motor.stop()
    motor.wait_until_done(timeout_s=5)
    way = begin - rig.controllers["left"].snapshot()["demand_inc"]
    assert way == pytest.approx(60_000**2 / 2 / 100_000, rel=0.05)


def downloads(frames: list[tuple[int, str, int, bytes]], index: int) -> int:
    """Return the number of expedited downloads to an object of the drive."""
    place = index.to_bytes(2, "little")
    sent = [data for _, _, can_id, data in frames if can_id == 0x601]
    return sum(data[0] >> 5 == 1 and data[1:3] == place for data in sent)


# --- 607Ch, home offset: zero is 607Ch beyond home (CiA 402-2)


@pytest.mark.parametrize("polarity", [0x00, 0xC0])
@pytest.mark.parametrize("method", [35, 37])
def test_homing_here_is_0_under_a_home_offset(open_rig: OpenRig, method: int, polarity: int):
    objects = f'objects = {{ "607Ch" = 5000, "607Eh" = {polarity} }}'
    rig = open_rig(drive("left", 1, objects))
    motor = motor_of(rig)
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    at = truth(rig)
    motor.home(method)
    assert motor.position() == pytest.approx(0.0, abs=WINDOW_RAD)
    go_to(motor, -0.5)
    motor.wait_until_done(timeout_s=5)
    assert truth(rig) == pytest.approx(at - 0.5 * (-1 if polarity else 1), abs=2 * WINDOW_RAD)


def test_homing_at_a_switch_keeps_the_home_offset(open_rig: OpenRig):
    objects = 'objects = { "607Ch" = 5000, "6099h:1" = 60000, "6098h" = 17 }'
    rig = open_rig(drive("left", 1, objects + SWITCHES))
    motor = motor_of(rig)
    motor.home(37)
    for method in (17, None):
        motor.home(method)
        go_to(motor, 0.0)
        motor.wait_until_done(timeout_s=5)
        assert truth(rig) == pytest.approx(-0.5 + 5000 * INCREMENT_RAD, abs=2 * WINDOW_RAD)


def test_homing_here_is_refused_under_a_fixed_home_offset(open_rig: OpenRig):
    rig = open_rig(drive("left", 1, 'objects = { "607Ch" = 5000 }'))
    rig.world.controller("left").od.get(0x607C, 0).access = "ro"
    motor = motor_of(rig)
    with pytest.raises(UnsupportedError, match="607Ch"):
        motor.home(37)
    assert not motor.is_referenced()
    motor.home()  # by the drive's own method and offset
    assert motor.position() == pytest.approx(-5000 * INCREMENT_RAD, abs=WINDOW_RAD)


@pytest.mark.parametrize(("method", "highest"), [(None, 45_000), (37, 50_000)])
def test_targets_are_checked_against_607dh_from_home(open_rig: OpenRig, method, highest: int):
    """607Dh counts from home, not from zero (CiA 402-2, 607Dh)."""
    objects = 'objects = { "607Ch" = 5000, "607Dh:1" = -50000, "607Dh:2" = 50000 }'
    rig = open_rig(drive("left", 1, objects))
    motor = motor_of(rig)
    motor.home(method)
    go_to(motor, (highest - 20) * INCREMENT_RAD)
    motor.wait_until_done(timeout_s=5)
    with pytest.raises(LimitError, match="607Dh"):
        go_to(motor, (highest + 20) * INCREMENT_RAD)


# --- 607Eh, polarity: bit 7 of positions, bit 6 of velocities


@pytest.mark.parametrize("scale", ["", "increments_per_rad = -21008.45249"])
@pytest.mark.parametrize("polarity", [0x00, 0x40, 0x80, 0xC0])
def test_velocity_has_the_sign_of_position(open_rig: OpenRig, polarity: int, scale: str):
    objects = f'objects = {{ "607Eh" = {polarity} }}'
    rig = open_rig(drive("left", 1, objects, "velocity_period_ms = 10", scale))
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(1.0)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    rig.runtime.run_for(0.1)
    before, at = motor.position(), truth(rig)
    rig.runtime.run_for(0.1)
    assert motor.position() - before == pytest.approx(0.1, rel=0.05)
    sign = (-1 if polarity & 0x80 else 1) * (-1 if scale else 1)
    assert truth(rig) - at == pytest.approx(sign * 0.1, rel=0.05)
    assert motor.velocity() == pytest.approx(1.0, rel=0.05)
    latest = motor.logical.hooks.latest()
    assert latest is not None
    assert latest.velocity == pytest.approx(1.0, rel=0.05)
    motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
    motor.set_trajectory(TrapezoidalTrajectory(-2.0))  # from 1 to -1
    motor.start()
    motor.wait_until_done(timeout_s=5)
    assert motor.velocity() == pytest.approx(-1.0, rel=0.05)
    assert motor.following_error() == pytest.approx(0.0, abs=0.1)
    motor.stop()


@pytest.mark.parametrize("polarity", [0x00, 0x40, 0x80, 0xC0])
def test_following_error_and_torque_have_the_sign_of_position(open_rig: OpenRig, polarity: int):
    objects = f'objects = {{ "607Eh" = {polarity}, "6076h" = 180, "6065h" = 0xFFFFFFFF }}'
    rig = open_rig(drive("left", 1, objects))
    motor = motor_of(rig)
    motor.enable()
    rig.controllers["left"].stimulate("load_torque_n_m", 2.0)
    rig.runtime.run_for(0.05)
    away = truth(rig) * (-1 if polarity & 0x80 else 1)
    assert abs(away) > INCREMENT_RAD
    assert motor.following_error() == pytest.approx(-away, abs=3 * INCREMENT_RAD)
    assert motor.torque() * away < 0.0  # it holds against the load
