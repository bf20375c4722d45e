"""Tests of the adaptation on emulated drives and their plants."""

from pathlib import Path

import can
import pytest
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    DeviceFault,
    LinkError,
    MotionInterrupted,
    Motor,
    MotorGroup,
    MotorState,
    PeerError,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)

from motorhil_odrive.host import messages as m
from motorhil_odrive.host.units import single, single_below

MODEL = """\
velocity_max_rad_s = 2.0
acceleration_max_rad_s2 = 4.0
gear_ratio = 66.0
current_max_a = 4.0
"""
WINDOW = 0.002  # rad


def true(rig, name="left", what="position_rad"):
    return rig.controllers[name].snapshot()[what]


def go_to(motor, value, variable=ControlVariable.POSITION, **more):
    motor.set_control_mode(ControlMode.SETPOINT, variable)
    motor.set_setpoint(value, **more)
    motor.start()


def track(rig, seconds, step_s=0.002):
    """Return the true positions from now on."""
    found = []
    for _ in range(round(seconds / step_s)):
        rig.runtime.run_for(step_s)
        found.append(true(rig))
    return found


def opened(text):
    return Rig(parse_rig(Source(Path("inline.toml"), text), installed_plugins()))


def one_drive(more=""):
    return opened(
        "bus.can0.bitrate_bit_s = 1_000_000\n"
        '[controller.left]\nkind = "odrive"\nbus = "can0"\nnode_id = 10\n'
        f'plant = {{ preset = "wheel_60w" }}\n{more}\n'
        f'[motor.left]\nadaptation = "odrive"\ncontroller = "left"\n[motor.left.model]\n{MODEL}'
    )


# --- motions


def test_absolute_and_relative_moves_reach_target(rig):
    motor = rig.motors["left"]
    go_to(motor, 1.0)
    motor.wait_until_done(timeout_s=5)
    assert abs(true(rig) - 1.0) <= WINDOW
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(-0.4))
    motor.start()
    motor.wait_until_done(timeout_s=5)
    assert abs(true(rig) - 0.6) <= WINDOW


def test_distances_add_up_from_held_position(rig):
    motor = rig.motors["left"]
    motor.enable()
    rig.controllers["left"].stimulate("load_torque_n_m", 1.0)
    for _ in range(20):
        go_to(motor, 0.01, relative=True)
        motor.wait_until_done(timeout_s=5)
    assert abs(true(rig) - 0.2) <= WINDOW


def test_done_flag_of_previous_motion_is_ignored(rig):
    motor = rig.motors["left"]
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    assert motor.hardware.heard.heartbeat.is_done
    go_to(motor, 1.0)
    assert not motor.is_done()
    motor.wait_until_done(timeout_s=5)
    assert abs(true(rig) - 1.0) <= WINDOW


def late_heartbeats(hardware):
    """Add an old heartbeat just after each frame that starts a motion."""
    confirm = hardware.drive.confirm

    def instead(sent):
        time_ns = confirm(sent)
        if sent.frame[0] & 0x1F == m.INPUT_POSITION.command:
            hardware.heard._on_heartbeat((0, m.CLOSED_LOOP, 1, 1), time_ns + 1)
        return time_ns

    hardware.drive.confirm = instead


def test_heartbeat_queued_before_start_is_ignored(rig):
    motor = rig.motors["left"]
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    late_heartbeats(motor.hardware)
    go_to(motor, 1.0)
    motor.wait_until_done(timeout_s=5)
    began = rig.runtime.now_ns()
    go_to(motor, 0.0008, relative=True, limits=DerivativeLimits(first=0.002))  # within the window
    motor.wait_until_done(timeout_s=5)
    assert (rig.runtime.now_ns() - began) / 1e9 > 0.4


def test_move_to_present_position_is_done_soon(rig):
    motor = rig.motors["left"]
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=0.5)


def test_set_point_is_replaced_during_motion(rig):
    motor = rig.motors["left"]
    go_to(motor, 3.0)
    rig.runtime.run_for(0.8)
    go_to(motor, 1.0)
    motor.wait_until_done(timeout_s=5)
    assert abs(true(rig) - 1.0) <= WINDOW


def test_velocity_limit_of_command_is_kept(rig):
    motor = rig.motors["left"]
    go_to(motor, 1.0, limits=DerivativeLimits(first=0.5))
    speeds = []
    while not motor.is_done():
        rig.runtime.run_for(0.01)
        speeds.append(true(rig, what="velocity_rad_s"))
    assert 0.45 < max(speeds) < 0.55


def test_lost_set_point_raises_peer_error(rig):
    motor = rig.motors["left"]
    motor.enable()
    rule = FaultRule("lost", FaultKind.DROP, identifier=1 << 5 | 0x0C)
    rig.faults.inject("can0", rule)
    with pytest.raises(PeerError, match="did not take the set-point"):
        go_to(motor, 1.0)
    rig.faults.lift("can0", "lost")
    go_to(motor, 1.0)
    motor.wait_until_done(timeout_s=5)


def test_velocity_set_point_is_ramped_and_kept(rig):
    motor = rig.motors["left"]
    go_to(motor, 1.0, ControlVariable.VELOCITY)
    began = rig.runtime.now_ns()
    motor.wait_until_done(timeout_s=5)
    assert 0.2 < (rig.runtime.now_ns() - began) / 1e9 < 0.35  # 1 rad/s at 4 rad/s^2
    assert true(rig, what="velocity_rad_s") == pytest.approx(1.0, abs=0.05)
    go_to(motor, -0.5, ControlVariable.VELOCITY)
    motor.wait_until_done(timeout_s=5)
    assert true(rig, what="velocity_rad_s") == pytest.approx(-0.5, abs=0.05)
    motor.stop()
    motor.wait_until_done(timeout_s=5)
    assert true(rig, what="velocity_rad_s") == 0.0


def test_torque_is_that_of_the_output(rig):
    motor = rig.motors["left"]
    motor.enable()
    rig.controllers["left"].stimulate("load_torque_n_m", 1.5)
    go_to(motor, 1.5, ControlVariable.TORQUE)
    motor.wait_until_done(timeout_s=5)
    assert true(rig, what="torque_n_m") == pytest.approx(1.5, rel=0.05)
    assert motor.torque() == pytest.approx(1.5, rel=0.05)


def test_group_starts_sequentially_and_reports_it(rig):
    group = MotorGroup(rig.motors["left"], rig.motors["right"])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(0.5), TrapezoidalTrajectory(-1.0))
    assert "a command of its own" in group.sync_capability().reason
    group.start()
    group.wait_until_done(timeout_s=5)
    assert abs(true(rig, "right") + 1.0) <= WINDOW
    assert 0.0 < group.sync_quality().start_skew_s < 0.001


@pytest.mark.parametrize(("mode", "variable"), [(ControlMode.SETPOINT, ControlVariable.CURRENT)])
def test_unsupported_mode_is_refused(rig, mode, variable):
    with pytest.raises(UnsupportedError):
        rig.motors["left"].set_control_mode(mode, variable)


def test_jerk_limited_trajectory_is_refused(rig):
    motor = rig.motors["left"]
    motor.set_control_mode(ControlMode.TRAJECTORY)
    with pytest.raises(UnsupportedError, match="limited jerk"):
        motor.set_trajectory(TrapezoidalTrajectory(1.0, limits=DerivativeLimits(third=10.0)))


def test_old_heartbeat_does_not_refuse_enable(rig):
    motor = rig.motors["left"]
    motor.enable()
    motor.disable()  # the drive reports "cancelled" for its closed loop
    hardware, confirm = motor.hardware, motor.hardware.drive.confirm

    def instead(sent):
        time_ns = confirm(sent)
        hardware.heard._on_heartbeat((0, m.IDLE, 2, 1), time_ns + 1)
        return time_ns

    hardware.drive.confirm = instead
    motor.enable()
    assert motor.state() is MotorState.ENABLED


def test_refused_enable_has_reason(rig):
    motor = rig.motors["left"]
    rule = FaultRule("lost", FaultKind.DROP, identifier=1 << 5 | 7)
    rig.faults.inject("can0", rule)
    with pytest.raises(PeerError, match="closed loop was refused"):
        motor.enable()


# --- stopping


@pytest.mark.parametrize("after_s", [0.2, 0.7, 1.4])
def test_stop_brakes_without_reversing(rig, after_s):
    motor = rig.motors["left"]
    go_to(motor, 2.5)
    rig.runtime.run_for(after_s)
    at, speed = true(rig), true(rig, what="velocity_rad_s")
    motor.stop()
    way = track(rig, 1.0)
    motor.wait_until_done(timeout_s=1)
    assert way[-1] - at == pytest.approx(speed**2 / (2 * 4.0), abs=0.03)
    assert max(way) - way[-1] < 0.0005
    assert motor.fault() is None
    assert motor.state() is MotorState.ENABLED


def test_stop_of_slow_motion_is_not_over_early(rig):
    motor = rig.motors["left"]
    go_to(motor, 1.0, limits=DerivativeLimits(first=0.004, second=0.002))
    rig.runtime.run_for(4.0)
    motor.stop()
    began = rig.runtime.now_ns()
    motor.wait_until_done(timeout_s=5)
    assert (rig.runtime.now_ns() - began) / 1e9 == pytest.approx(2.0, abs=0.2)


def test_start_after_quick_stop_needs_enable(rig):
    motor = rig.motors["left"]
    go_to(motor, 2.5)
    rig.runtime.run_for(0.7)
    motor.quick_stop()
    motor.wait_until_done(timeout_s=2)
    assert motor.state() is MotorState.STOPPED
    assert true(rig) < 2.0
    with pytest.raises(UsageError, match="quick stop"):
        motor.start()
    motor.enable()
    motor.start()
    motor.wait_until_done(timeout_s=5)


def test_drive_without_host_stops(rig):
    motor = rig.motors["left"]
    go_to(motor, 2.0, ControlVariable.VELOCITY)
    motor.wait_until_done(timeout_s=5)
    rig.faults.inject("can0", FaultRule("cut", FaultKind.CUT, ports=("host",)))
    rig.runtime.run_for(1.0)
    assert true(rig, what="axis_state") == 1
    assert true(rig, what="velocity_rad_s") == 0.0


# --- faults, losses, other hosts


def test_fault_has_code_and_text_and_can_be_reset(rig):
    motor = rig.motors["left"]
    go_to(motor, 2.0)
    rig.runtime.run_for(0.3)
    rig.controllers["left"].stimulate("fault", 0x2200)
    with pytest.raises(DeviceFault, match=r"2200h \(DC bus under-voltage, motor too hot\)"):
        motor.wait_until_done(timeout_s=5)
    assert motor.state() is MotorState.FAULT
    motor.reset_fault()
    assert motor.state() is MotorState.DISABLED
    motor.start()
    motor.wait_until_done(timeout_s=5)


def test_fault_with_present_cause_is_not_reset(rig):
    motor = rig.motors["left"]
    motor.enable()
    rig.controllers["left"].stimulate("encoder", 0)
    rig.runtime.run_for(0.2)
    with pytest.raises(DeviceFault, match="missing estimate"):
        motor.reset_fault()


def test_silent_drive_is_lost_and_not_referenced(rig):
    motor = rig.motors["left"]
    motor.home()
    assert motor.is_referenced()
    go_to(motor, 2.0)
    rig.faults.inject("can0", FaultRule("cut", FaultKind.CUT, ports=("left",)))
    with pytest.raises(LinkError, match="no heartbeat for 300 ms"):
        motor.wait_until_done(timeout_s=5)
    assert motor.state() is MotorState.OFFLINE
    rig.faults.lift("can0", "cut")
    rig.runtime.run_for(0.2)
    assert not motor.is_referenced()


def test_restarted_drive_receives_all_settings_again(rig):
    motor = rig.motors["left"]
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    for power in (0, 1):
        rig.controllers["left"].stimulate("power", power)
        rig.runtime.run_for(1.0)
    go_to(motor, 2.0)
    motor.wait_until_done(timeout_s=1.6)


def test_setting_changed_by_tool_is_sent_again(rig):
    motor = rig.motors["left"]
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    with can.Bus(interface="emulated", channel="can0") as bus:
        slow = can.Message(arbitration_id=1 << 5 | 0x11, data=bytes(4), is_extended_id=False)
        bus.send(slow)
    rig.runtime.run_for(0.01)
    go_to(motor, 1.0)
    motor.wait_until_done(timeout_s=2)


def test_command_of_other_program_interrupts_motion(rig):
    motor = rig.motors["left"]
    go_to(motor, 2.0)
    rig.runtime.run_for(0.3)
    with can.Bus(interface="emulated", channel="can0") as bus:
        idle = can.Message(arbitration_id=1 << 5 | 7, data=[1, 0, 0, 0], is_extended_id=False)
        bus.send(idle)
        with pytest.raises(MotionInterrupted, match="another program"):
            motor.wait_until_done(timeout_s=5)


def test_settings_are_sent_again_after_low_level_access(rig):
    motor = rig.motors["left"]
    go_to(motor, 0.5)
    motor.wait_until_done(timeout_s=5)
    with motor.low_level() as hardware:
        assert hardware.ask(m.SUPPLY)[0] == pytest.approx(24.0)
        hardware.tell(m.TRAJECTORY_VELOCITY, 0.01)
    go_to(motor, 1.0)
    motor.wait_until_done(timeout_s=2)


# --- homing


def test_homing_on_the_spot_sets_zero(rig):
    motor = rig.motors["left"]
    go_to(motor, 0.7)
    motor.wait_until_done(timeout_s=5)
    motor.home(35)
    assert motor.position() == pytest.approx(0.0, abs=WINDOW)
    go_to(motor, 0.1)
    motor.wait_until_done(timeout_s=5)
    assert abs(true(rig) - 0.8) <= WINDOW


def test_homing_by_end_stop_sets_zero():
    more = "min_endstop_rad = -0.2\nhoming_speed_rev_s = 5.0\nvelocity_ramp_rev_s2 = 50.0"
    with one_drive(more) as rig:
        motor = rig.motors["left"]
        motor.home(17)
        assert motor.is_referenced()
        go_to(motor, 0.5)
        motor.wait_until_done(timeout_s=5)
        assert abs(true(rig) - 0.3) <= WINDOW


def test_failed_homing_has_reason():
    with one_drive() as rig:
        motor = rig.motors["left"]
        with pytest.raises(PeerError, match="homing without an end stop"):
            motor.home(17)
        assert not motor.is_referenced()
        with pytest.raises(UnsupportedError, match="method 3"):
            motor.home(3)


# --- on one bus with CANopen


def test_odrive_and_canopen_drive_share_a_bus():
    # Node 10 has identifiers 140h to 15Fh; node 12 would have 180h to 19Fh, CANopen's TPDO 1.
    with opened(
        "bus.can0.bitrate_bit_s = 500_000\n"
        '[controller.left]\nkind = "odrive"\nbus = "can0"\nnode_id = 10\n'
        'plant = { preset = "wheel_60w" }\n'
        '[controller.right]\nkind = "cia402"\nbus = "can0"\nnode_id = 1\n'
        'plant = { preset = "wheel_60w" }\n'
        f'[motor.left]\nadaptation = "odrive"\ncontroller = "left"\n[motor.left.model]\n{MODEL}'
        f'[motor.right]\nadaptation = "cia402"\ncontroller = "right"\n[motor.right.model]\n{MODEL}'
        "encoder_increments_rev = 2000\n"
        "velocity_unit_rad_s = 4.7599888690754445e-05\n"
        "acceleration_unit_rad_s2 = 4.7599888690754445e-05\n"
    ) as rig:
        group = MotorGroup(rig.motors["left"], rig.motors["right"])
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        group.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(1.0))
        group.start()
        group.wait_until_done(timeout_s=5)
        for name in ("left", "right"):
            assert abs(true(rig, name) - 1.0) <= WINDOW


# --- units


@pytest.mark.parametrize("value", [1.0, 0.1, 1e-3, 21.00845, 42.0169, 3.3e5])
def test_single_below_is_at_most_value_and_stable(value):
    down = single_below(value)
    assert down <= value
    assert value - down < value * 2**-22
    assert single(down) == down
    assert single_below(down) == down


def test_model_without_gear_ratio_is_refused(rig):
    from motorhil.motorapi.model import MotorModel

    from motorhil_odrive.host.motor import OdriveMotor

    model = MotorModel(name="wheel", velocity_max=1.0, acceleration_max=1.0)
    with pytest.raises(UsageError, match=r"gear_ratio = 1\.0 if there is no gear"):
        OdriveMotor(rig.motors["left"].hardware, model)
