"""Wheels that roll beyond the 32 bits of the drive's position counter."""

from collections.abc import Callable

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.canopen.bus import open_bus, release_bus
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.node import DriveNode
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import LimitError
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.trajectory import ComplexTrajectory, TrapezoidalTrajectory
from tests.support.motors.drive_rigs import drive
from tests.support.motors.streaming import quintic
from tests.support.motors.wheels import INCREMENT_RAD, WINDOW_RAD, frames_on, go_to, motor_of, truth

OpenRig = Callable[..., Rig]
WRAP_RAD = (1 << 31) * INCREMENT_RAD  # 102,220 rad: 6064h is 2^31 - 1 below it, -2^31 above
NEAR_RAD = 102_219.0


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(
        drive("left", 1, f"initial_position_rad = {NEAR_RAD}"),
        drive("right", 2, f"initial_position_rad = {-NEAR_RAD}"),
    )


def move_by(motor: Motor, distance: float) -> None:
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(distance))
    motor.start()
    motor.wait_until_done(timeout_s=30)


def test_relative_moves_pass_the_wrap_both_ways(rig: Rig):
    motor = motor_of(rig)
    at = motor.position()
    for distance in (1.0, 1.0, 1.0, -0.5, -3.0, -1.0, 4.0):
        move_by(motor, distance)
        at += distance
        assert motor.position() == pytest.approx(at, abs=WINDOW_RAD)
        assert truth(rig) == pytest.approx(at, abs=WINDOW_RAD)


def test_absolute_set_points_pass_the_wrap_and_return(rig: Rig):
    motor = motor_of(rig)
    for target in (WRAP_RAD + 3.0, WRAP_RAD - 2.0, 1e3 + WRAP_RAD - 999.0):
        go_to(motor, target)
        motor.wait_until_done(timeout_s=10)
        assert truth(rig) == pytest.approx(target, abs=WINDOW_RAD)


def test_set_point_replaced_beyond_the_wrap_counts_from_no_halfway(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, WRAP_RAD + 5.0)
    rig.runtime.run_for(0.7)
    go_to(motor, WRAP_RAD + 2.5)
    motor.wait_until_done(timeout_s=10)
    assert truth(rig) == pytest.approx(WRAP_RAD + 2.5, abs=WINDOW_RAD)


def test_set_point_after_a_stop_beyond_the_wrap_arrives(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, WRAP_RAD + 5.0)
    rig.runtime.run_for(1.0)
    motor.stop()
    motor.wait_until_done(timeout_s=5)
    assert truth(rig) < WRAP_RAD + 3.0
    go_to(motor, WRAP_RAD + 5.0)
    motor.wait_until_done(timeout_s=10)
    assert truth(rig) == pytest.approx(WRAP_RAD + 5.0, abs=WINDOW_RAD)


def test_positioning_option_is_given_back_after_the_wrap(rig: Rig):
    motor = motor_of(rig)
    move_by(motor, 3.0)
    assert motor.hardware.read("positioning_option_code") == 1
    move_by(motor, -4.0)
    move_by(motor, -60.0)
    assert motor.hardware.read("positioning_option_code") == 1  # still near the wrap at its start
    move_by(motor, -1.0)
    assert motor.hardware.read("positioning_option_code") == 0


def test_group_passes_both_wraps_at_one_sync(rig: Rig):
    group = MotorGroup(rig.motors["left"], rig.motors["right"])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(3.0), TrapezoidalTrajectory(-3.0))
    for turn in (1, 2):
        group.start()
        group.wait_until_done(timeout_s=10)
        assert truth(rig, "left") == pytest.approx(NEAR_RAD + 3.0 * turn, abs=WINDOW_RAD)
        assert truth(rig, "right") == pytest.approx(-NEAR_RAD - 3.0 * turn, abs=WINDOW_RAD)
    assert group.sync_quality().start_skew_s == 0.0


def test_streamed_trajectory_passes_the_wrap(rig: Rig):
    motor = motor_of(rig)
    at = motor.position()
    motor.set_control_mode(ControlMode.TRAJECTORY)
    for turn in (1, 2):
        motor.set_trajectory(ComplexTrajectory(quintic(2.0, 4.0), relative=True))
        motor.start()
        motor.wait_until_done(timeout_s=10)
        assert truth(rig) == pytest.approx(at + 2.0 * turn, abs=2 * WINDOW_RAD)
        assert motor.position() == pytest.approx(at + 2.0 * turn, abs=2 * WINDOW_RAD)


def test_position_at_constant_velocity_never_jumps(rig: Rig):
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(3.0)
    motor.start()
    before = motor.position()
    for _ in range(100):
        rig.runtime.run_for(0.02)
        assert 0.0 <= motor.position() - before < 0.15  # 3 rad/s for 20 ms and a status period
        before = motor.position()
    assert before > WRAP_RAD
    motor.stop()
    motor.wait_until_done(timeout_s=5)
    at = motor.position()
    move_by(motor, -1.0)
    assert truth(rig) == pytest.approx(at - 1.0, abs=WINDOW_RAD)


def test_homing_beyond_the_wrap_sets_position_0(rig: Rig):
    motor = motor_of(rig)
    move_by(motor, 3.0)
    motor.home(37)
    assert abs(motor.position()) <= WINDOW_RAD
    heard = frames_on(rig)
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    assert motor.position() == pytest.approx(0.5, abs=WINDOW_RAD)
    words = [data[:2] for _, sender, can_id, data in heard if (sender, can_id) == ("host", 0x201)]
    assert bytes((0x3F, 0)) in words  # CiA 402-2: new set-point, change immediately, absolute


def test_move_longer_than_32_bits_is_refused(rig: Rig):
    motor = motor_of(rig)
    with pytest.raises(LimitError, match=r"distance of one move .*607Ah has 32 bits"):
        go_to(motor, 3.0 * WRAP_RAD)
    assert truth(rig) == pytest.approx(NEAR_RAD, abs=WINDOW_RAD)


def test_counter_is_unwrapped_in_both_directions(rig: Rig):
    bus = open_bus(rig.bus("can0"), rig.runtime)
    node = DriveNode(bus, 9, HwOptions())
    top, bottom = 0x7FFF_FFFF, -0x8000_0000
    seen: list[int] = []
    for counter in (bottom, top, top - 9, bottom + 9, -1, top - 5, bottom, -10):
        node.take_status(0x0637, counter, 0)
        seen.append(node.position_inc - bottom)
    # by hand: one below the first, 10 further down, 19 up, then half a span, and so on
    assert seen[:4] == [0, -1, -10, 9]
    assert seen[4:] == [(1 << 31) - 1, (1 << 32) - 6, 1 << 32, (1 << 32) + (1 << 31) - 10]
    assert node.on_from(-3) == node.position_inc + 7
    node.close()
    release_bus(bus)
