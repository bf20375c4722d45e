"""Motors on emulated CiA 402 drives: commands and ends of motions."""

from collections.abc import Callable
from contextlib import suppress

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor, HomingFailed
from motorhil.motorapi.adaptations.cia402.objects import PdsState
from motorhil.motorapi.commands import ControlMode, ControlVariable, DerivativeLimits
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    MotionInterrupted,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.state import MotorState
from motorhil.motorapi.synchronization.quality import SyncLevel
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.support.motors.drive_rigs import drive
from tests.support.motors.wheels import (
    INCREMENT_RAD,
    MS,
    WINDOW_RAD,
    frames_on,
    go_to,
    motor_of,
    truth,
)

OpenRig = Callable[..., Rig]


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1), drive("right", 2))


# --- moving ------------------------------------------------------------------------------------


def test_algorithm_1_of_the_paper(rig: Rig):
    hw = Cia402HwMotor(rig.bus("can0"), node_id=1)
    motor = Cia402Motor(hw, model=rig.motors["right"].model)
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(1.0)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    assert abs(truth(rig) - 1.0) <= WINDOW_RAD
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(1.0))
    motor.start()
    motor.wait_until_done(timeout_s=5)
    assert abs(truth(rig) - 2.0) <= WINDOW_RAD
    assert abs(motor.position() - 2.0) <= WINDOW_RAD
    hw.close()


def test_constructor_sends_nothing_before_first_use(rig: Rig):
    heard = frames_on(rig)
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(1.0)
    assert motor.state() is MotorState.OFFLINE
    rig.runtime.run_for(1.0)
    assert [sender for _, sender, _, _ in heard if sender == "host"] == []


def test_relative_moves_do_not_accumulate_rounding(rig: Rig):
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.TRAJECTORY)
    for _ in range(10):
        motor.set_trajectory(TrapezoidalTrajectory(0.01))  # 210.08 increments
        motor.start()
        motor.wait_until_done(timeout_s=5)
    demand_inc = rig.controllers["left"].snapshot()["demand_inc"]
    assert demand_inc == round(0.1 / INCREMENT_RAD)


def test_set_point_velocity_limit_of_command_applies(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 1.0, DerivativeLimits(first=0.5))
    started_ns = rig.runtime.now_ns()
    motor.wait_until_done(timeout_s=5)
    # D/v + v/a of 1 rad, 0.5 rad/s, 10 rad/s2, then the position window time of the drive
    assert 2.05 <= (rig.runtime.now_ns() - started_ns) / 1e9 <= 2.08


def test_set_point_in_motion_replaces_the_previous_one(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 3.0)
    rig.runtime.run_for(0.4)
    motor.set_setpoint(-0.5)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    assert abs(truth(rig) + 0.5) <= WINDOW_RAD


def test_move_of_length_zero_is_done(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    motor.start()
    motor.wait_until_done(timeout_s=0.2)


def test_velocity_is_reached_kept_and_stopped(rig: Rig):
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(-2.0)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    rig.runtime.run_for(0.5)
    assert rig.controllers["left"].snapshot()["velocity_rad_s"] == pytest.approx(
        -2.0, rel=0.02
    )  # the servo's ripple over one encoder increment
    motor.set_setpoint(1.0)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    motor.stop()
    motor.wait_until_done(timeout_s=5)
    assert rig.controllers["left"].snapshot()["velocity_rad_s"] == 0.0
    assert motor.state() is MotorState.ENABLED


def test_velocity_trajectory_is_done_at_its_end(rig: Rig):
    """The drive's own velocity window of 0.095 rad/s is reached long before."""
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
    motor.set_trajectory(TrapezoidalTrajectory(0.2, duration_s=2.0))
    motor.start()
    begun_ns = rig.runtime.now_ns()
    motor.wait_until_done(timeout_s=5)
    # a confirmation of the start before, and the period of the drive's status after it
    assert 1.95 <= (rig.runtime.now_ns() - begun_ns) / 1e9 <= 2.025
    assert rig.controllers["left"].snapshot()["velocity_rad_s"] == pytest.approx(0.2, abs=0.02)


def test_velocity_trajectories_of_a_group_end_together(rig: Rig):
    group = MotorGroup(rig.motors["left"], rig.motors["right"])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY, ControlVariable.VELOCITY)
    group.set_trajectory(
        TrapezoidalTrajectory(0.2, duration_s=2.0), TrapezoidalTrajectory(2.5, duration_s=2.0)
    )
    group.start()
    group.wait_until_done(timeout_s=5)
    quality = group.sync_quality()
    assert quality.end_skew_s is not None
    assert quality.end_skew_s <= quality.predicted_end_skew_s + 0.005  # servo, and status period
    group.stop()
    group.wait_until_done(timeout_s=5)


def test_old_target_velocity_never_takes_effect(rig: Rig):
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(2.0)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    motor.stop()
    motor.wait_until_done(timeout_s=5)
    motor.disable()
    motor.enable()
    at = truth(rig)
    rig.runtime.run_for(0.5)
    assert abs(truth(rig) - at) <= WINDOW_RAD
    motor.set_setpoint(0.5)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    assert 0 < rig.controllers["left"].snapshot()["velocity_rad_s"] < 1.0


def test_current_control_is_refused_with_alternatives(rig: Rig):
    """CiA 402 has no target current; a conversion of torque by 6075h would be a guess."""
    with pytest.raises(UnsupportedError, match="setpoint of torque"):
        motor_of(rig).set_control_mode(ControlMode.SETPOINT, ControlVariable.CURRENT)


# --- stopping ----------------------------------------------------------------------------------


def test_stop_rests_short_of_target_and_nothing_resumes(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 3.0)
    rig.runtime.run_for(0.5)
    motor.stop()
    motor.wait_until_done(timeout_s=5)
    at = truth(rig)
    assert 0.1 < at < 2.9
    rig.runtime.run_for(1.0)
    assert abs(truth(rig) - at) <= WINDOW_RAD
    motor.set_setpoint(at - 0.5)  # not back to 3.0 first
    motor.start()
    rig.runtime.run_for(0.05)
    assert truth(rig) < at
    motor.wait_until_done(timeout_s=5)
    assert abs(truth(rig) - (at - 0.5)) <= WINDOW_RAD


@pytest.mark.parametrize("way", [Motor.stop, Motor.quick_stop, Motor.halt])
@pytest.mark.parametrize("first", [Motor.disable, Motor.quick_stop])
def test_stop_without_power_is_done_when_it_has_coasted(rig: Rig, first, way):
    motor = motor_of(rig)
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(2.0)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    first(motor)
    way(motor)
    assert not motor.is_done()
    motor.wait_until_done(timeout_s=10)
    assert abs(rig.controllers["left"].snapshot()["velocity_rad_s"]) <= 0.01
    with suppress(UsageError):  # after a quick stop
        motor.enable()
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=10)


def test_stop_from_a_callback_ends_the_other_wait(rig: Rig):
    motor = motor_of(rig)
    other = Cia402Motor(motor.hardware, motor.model, name="other")
    go_to(motor, 3.0)
    rig.world.queue.alarm(lambda now_ns: other.stop()).set(rig.runtime.now_ns() + 300 * MS)
    with pytest.raises(MotionInterrupted, match=r"stop\(\) of other"):
        motor.wait_until_done(timeout_s=5)
    other.wait_until_done(timeout_s=5)
    assert rig.controllers["left"].snapshot()["velocity_rad_s"] == 0.0


@pytest.mark.parametrize("delay_us", range(0, 6000, 250))
def test_stop_during_start_prevents_the_motion(rig: Rig, delay_us: int):
    motor = motor_of(rig)
    motor.enable()
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(2.0)
    stopper = rig.world.queue.alarm(lambda now_ns: motor.stop())
    stopper.set(rig.runtime.now_ns() + delay_us * 1000)
    with suppress(MotionInterrupted):
        motor.start()
    with suppress(MotionInterrupted):
        motor.wait_until_done(timeout_s=5)
    rig.runtime.run_for(1.0)
    at = truth(rig)
    assert at < 0.5
    rig.runtime.run_for(0.5)
    assert abs(truth(rig) - at) <= WINDOW_RAD


def test_quick_stop_requires_enable_before_motion(rig: Rig):
    motor = motor_of(rig)
    go_to(motor, 3.0)
    rig.runtime.run_for(0.5)
    motor.quick_stop()
    motor.wait_until_done(timeout_s=5)
    assert motor.state() is MotorState.STOPPED
    with pytest.raises(UsageError, match="enable"):
        motor.start()
    motor.enable()
    at = truth(rig)
    motor.set_setpoint(at + 0.2)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    assert abs(truth(rig) - (at + 0.2)) <= WINDOW_RAD


# --- homing ------------------------------------------------------------------------------------


def test_homing_sets_position_0_and_can_be_repeated(rig: Rig):
    motor = motor_of(rig)
    assert not motor.is_referenced()
    for _ in range(2):
        go_to(motor, 0.5)
        motor.wait_until_done(timeout_s=5)
        motor.home(37)
        assert abs(motor.position()) <= WINDOW_RAD
        assert motor.is_referenced()
    assert abs(truth(rig) - 1.0) <= 2 * WINDOW_RAD  # the plant has moved twice


def test_unknown_homing_method_is_refused(rig: Rig):
    with pytest.raises(UnsupportedError, match="homing by method 99"):
        motor_of(rig).home(99)


@pytest.mark.parametrize(("method", "told"), [(37, "by method 37"), (None, "by its own method")])
def test_failed_homing_raises_an_error(rig: Rig, method: int | None, told: str):
    motor = motor_of(rig)
    motor.enable()
    motor.home(method, wait=False)
    watch = motor.hardware.node.watch
    assert watch is not None
    watch.see(0x0237, 0, rig.runtime.now_ns())
    watch.see(0x2637, 0, rig.runtime.now_ns())  # homing error, drives.md: 2400h
    with pytest.raises(HomingFailed, match=told):
        motor.wait_until_done(timeout_s=1)


# --- failing motions -----------------------------------------------------------------------------


def test_algorithm_2_of_the_paper(rig: Rig):
    group = MotorGroup(rig.motors["left"], rig.motors["right"])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(2.0))
    group.start()
    group.wait_until_done(timeout_s=10)
    assert abs(truth(rig, "left") - 1.0) <= WINDOW_RAD
    assert abs(truth(rig, "right") - 2.0) <= WINDOW_RAD
    quality = group.sync_quality()
    assert quality.start_skew_s == 0.0
    assert quality.predicted_end_skew_s < 1e-6
    assert quality.end_skew_s is not None
    assert quality.end_skew_s < 0.002  # a profile tick, and two frames on one bus
    assert group.sync_capability().level is SyncLevel.TRIGGERED


def test_sync_follows_all_armed_rpdos(rig: Rig):
    group = MotorGroup(rig.motors["left"], rig.motors["right"])
    group.for_each(Motor.enable)
    group.for_each(Motor.set_control_mode, ControlMode.SETPOINT)
    group.for_each(Motor.set_setpoint, 1.0)
    heard = frames_on(rig)
    group.start()
    armed = [time_ns for time_ns, _, can_id, _ in heard if can_id in (0x301, 0x302)]
    sync = [time_ns for time_ns, _, can_id, _ in heard if can_id == 0x080]
    assert len(armed) == 2
    assert len(sync) == 1
    assert max(armed) < sync[0]
    group.wait_until_done(timeout_s=5)


def test_armed_motion_without_start_is_disarmed(rig: Rig):
    left, right = motor_of(rig, "left"), motor_of(rig, "right")
    group = MotorGroup(left, right)
    group.for_each(Motor.enable)
    group.for_each(Motor.set_control_mode, ControlMode.SETPOINT)
    group.for_each(Motor.set_setpoint, 1.0)
    lose = FaultRule("lose", FaultKind.DROP, identifier=0x602, from_ns=rig.runtime.now_ns())
    rig.faults.inject("can0", lose)  # every SDO request to the right one
    with pytest.raises(DeadlineExceeded, match="node 2"):
        group.start()
    left.hardware.node.bus.sync.send()
    rig.runtime.run_for(0.5)
    assert abs(truth(rig, "left")) <= WINDOW_RAD


def test_velocities_start_at_one_sync(rig: Rig):
    group = MotorGroup(rig.motors["left"], rig.motors["right"])
    group.for_each(Motor.set_control_mode, ControlMode.SETPOINT, ControlVariable.VELOCITY)
    group.for_each(Motor.set_setpoint, 1.5)
    group.start()
    group.wait_until_done(timeout_s=5)
    quality = group.sync_quality()
    assert quality.start_skew_s == 0.0
    group.stop()
    group.wait_until_done(timeout_s=5)
    assert rig.controllers["right"].snapshot()["velocity_rad_s"] == 0.0


# --- one object per drive ------------------------------------------------------------------------


def test_second_hardware_object_is_refused_naming_the_first(rig: Rig):
    hw = Cia402HwMotor(rig.bus("can0"), node_id=5)
    with pytest.raises(UsageError, match="can0 node 5 has a hardware object already: <Cia402HwM"):
        Cia402HwMotor(rig.bus("can0"), node_id=5)
    hw.close()
    hw.close()
    Cia402HwMotor(rig.bus("can0"), node_id=5).close()


def test_dropped_hardware_object_releases_drive_and_bus(rig: Rig):
    hw = Cia402HwMotor(rig.bus("can0"), node_id=1)
    hw.connect()
    assert hw.state is PdsState.SWITCH_ON_DISABLED
    del hw
    heard = frames_on(rig)
    rig.runtime.run_for(0.5)
    assert [can_id for _, sender, can_id, _ in heard if sender == "host"] == []
    Cia402HwMotor(rig.bus("can0"), node_id=1).close()
