"""Stops, sharing, group starts and rig settings of an ideal motor."""

import pytest

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.motorapi import (
    DerivativeLimits,
    DeviceFault,
    LinkError,
    MotionInterrupted,
    MotionKind,
    MotorBusyError,
    MotorGroup,
    MotorModel,
    MotorState,
    StateError,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.adaptations.ideal.hardware import IdealHwMotor
from motorhil.motorapi.adaptations.ideal.motor import IdealMotor, build
from motorhil.motorapi.synchronization.quality import SyncLevel
from tests.support.motors.ideals import (
    MODEL,
    ROUNDING,
    SETPOINT,
    TRAJECTORY,
    VELOCITY,
    aim,
    follow,
)

# --- stopping


def test_stop_uses_the_motions_deceleration(runtime, motor):
    follow(motor, TrapezoidalTrajectory(2.0, limits=DerivativeLimits(second=(-4.0, 4.0))))
    runtime.run_for(0.5)
    motor.stop()
    runtime.run_for(0.25)
    assert motor.velocity() == 1.0
    motor.wait_until_done()
    assert runtime.now_ns() == 1_000_000_000  # 2 rad/s at 4 rad/s^2
    assert motor.position() == 0.25 + 0.5 + 0.5


def test_halt_is_a_stop_and_start_needs_nothing_more(runtime, motor):
    aim(motor, 1.0, VELOCITY)
    motor.wait_until_done()
    motor.halt()
    motor.wait_until_done()
    assert runtime.now_ns() == 250_000_000 + 125_000_000
    assert motor.state() is MotorState.ENABLED
    aim(motor, 0.0)
    motor.wait_until_done()
    assert motor.position() == 0.0


def test_quick_stop_uses_the_models_deceleration(runtime, motor):
    aim(motor, 2.0, VELOCITY, limits=DerivativeLimits(first=1.0))
    motor.wait_until_done()
    motor.quick_stop()
    begun_ns = runtime.now_ns()
    motor.wait_until_done()
    assert runtime.now_ns() - begun_ns == 250_000_000  # 2 rad/s at 8 rad/s^2
    assert motor.state() is MotorState.STOPPED
    with pytest.raises(StateError):
        motor.start()
    motor.enable()
    aim(motor, 0.0)
    motor.wait_until_done()
    assert motor.position() == 0.0


def test_power_off_stops_the_motor_at_once(runtime, motor):
    aim(motor, 1.0, VELOCITY)
    runtime.run_for(0.25)
    motor.disable()
    assert motor.velocity() == 0.0
    place = motor.position()
    runtime.run_for(1.0)
    assert (motor.position(), motor.state()) == (place, MotorState.DISABLED)


# --- faults, homing, closing


def test_fault_in_motion_ends_the_wait(runtime, motor, hw):
    follow(motor, TrapezoidalTrajectory(2.0))
    breaks = runtime.spawn("breaks", lambda: (runtime.run_for(0.3), hw.inject_fault(0x2310)))
    with pytest.raises(DeviceFault) as caught:
        motor.wait_until_done(timeout_s=5)
    assert (caught.value.code, caught.value.since_ns) == (0x2310, 300_000_000)
    assert runtime.now_ns() == 300_000_000
    breaks.join()
    assert (motor.state(), motor.velocity()) == (MotorState.FAULT, 0.0)
    with pytest.raises(DeviceFault):
        motor.start()
    motor.reset_fault()
    assert motor.state() is MotorState.DISABLED
    motor.start()
    motor.wait_until_done()
    place = 0.25 + 0.18 + 2.0  # 4 x 0.3^2 / 2 before the fault
    assert motor.position() == pytest.approx(place, abs=ROUNDING)


def test_homing_defines_the_position_as_0_at_once(runtime, motor):
    assert not motor.is_referenced()
    motor.home()
    assert motor.is_referenced()
    assert (motor.position(), runtime.now_ns()) == (0.0, 0)
    with pytest.raises(UnsupportedError, match="method 17"):
        motor.home(17)


def test_closed_motor_is_offline_and_waits_end(runtime, motor, hw):
    aim(motor, 1.0, VELOCITY, limits=DerivativeLimits(first=0.1))
    runtime.spawn("closes", lambda: (runtime.run_for(0.1), hw.close()))
    with pytest.raises((LinkError, MotionInterrupted)):
        motor.wait_until_done()
    assert (runtime.now_ns(), motor.state()) == (100_000_000, MotorState.OFFLINE)
    with pytest.raises(LinkError, match="closed"):
        motor.start()
    assert IdealHwMotor(runtime, "axis 1").reading().position == 0.0


# --- one physical motor, several logical ones


def test_second_object_is_refused_naming_the_first(runtime, hw):
    with pytest.raises(UsageError, match="has a hardware object already: <IdealHwMotor axis 1"):
        IdealHwMotor(runtime, "axis 1")
    IdealHwMotor(VirtualRuntime(EventQueue()), "axis 1")  # of another runtime


def test_logical_motors_share_the_motor_not_the_settings(runtime, motor, hw):
    other = IdealMotor(hw, MODEL, name="other")
    aim(motor, 1.25)
    other.set_control_mode(SETPOINT)
    other.set_setpoint(0.0)
    with pytest.raises(MotorBusyError, match=r"start\(\) of m"):
        other.start()
    motor.wait_until_done()
    other.start()
    with pytest.raises(MotorBusyError):
        motor.start()
    other.stop()
    assert motor.position() == other.position()


def test_stop_by_another_ends_wait_and_motion_without_end(runtime, motor, hw):
    other = IdealMotor(hw, MODEL, name="other")
    follow(motor, TrapezoidalTrajectory(2.0))
    runtime.spawn("stops", lambda: (runtime.run_for(0.25), other.stop()))
    with pytest.raises(MotionInterrupted, match=r"stop\(\) of other"):
        motor.wait_until_done()
    assert runtime.now_ns() == 250_000_000
    runtime.run_for(2.0)
    times = motor._motion_times()
    assert (times.started_ns, times.ended_ns) == (0, None)


# --- time


def test_group_begins_and_ends_at_the_same_nanosecond(runtime):
    motors = [IdealMotor(IdealHwMotor(runtime, f"axis {n}"), MODEL, name=f"m{n}") for n in "123"]
    group = MotorGroup(*motors)
    group.for_each(IdealMotor.set_control_mode, TRAJECTORY)
    group.set_trajectory(*(TrapezoidalTrajectory(way) for way in (1.0, -2.0, 3.0)))
    capability = group.sync_capability()
    assert (capability.level, capability.start_skew_s) == (SyncLevel.TRIGGERED, 0.0)
    group.start()
    group.wait_until_done()
    quality = group.sync_quality()
    assert (quality.start_skew_s, quality.end_skew_s) == (0.0, 0.0)
    assert {times.ended_ns for _, times in quality.times} == {runtime.now_ns()}
    assert [motor.position() for motor in motors] == [1.0, -2.0, 3.0]


def test_moving_motor_notifies_so_conditions_are_checked(runtime, motor):
    aim(motor, 1.25)
    assert runtime.wait_until(lambda: motor.latest().position >= 1.0, 5.0)
    assert runtime.now_ns() == 375_000_000


def test_motor_at_rest_needs_no_events(runtime, motor, hw):
    aim(motor, 1.25)
    motor.wait_until_done()
    motor.stop()
    runtime.run_for(0.1)
    assert runtime.queue.next_time_ns() is None


def test_reading_a_motor_changes_nothing(runtime):
    """Two motors, one of them read every 0.1 ms: they end with the same bits."""
    quiet, watched = (
        IdealMotor(IdealHwMotor(runtime, name), MODEL, name=name) for name in ("quiet", "watched")
    )
    for motor in (quiet, watched):
        follow(motor, TrapezoidalTrajectory(0.7, duration_s=1.1))
    for _ in range(5000):
        watched.latest()
        runtime.run_for(1e-4)
    assert quiet.latest() == watched.latest()


# --- motors built by a rig


def test_motors_built_for_one_axis_share_it_until_closed(runtime):
    table = {"name": "a", "axis": "shaft", "position_rad": 1.5, "torque_constant_n_m_a": 0.1}
    first = build(None, table, MODEL, runtime)
    second = build(None, {"name": "b", "axis": "shaft"}, MODEL, runtime)
    assert first.hardware is second.hardware
    assert (second.position(), first.hardware.torque_constant) == (1.5, 0.1)
    first.close()
    first.close()
    assert second.state() is MotorState.DISABLED
    second.close()
    assert second.state() is MotorState.OFFLINE
    assert build.needs_bus is False


def test_motion_stopped_before_it_moved_is_stopped_not_done(runtime):
    hardware = IdealHwMotor(runtime)
    first, second = (IdealMotor(hardware, MODEL, name=name) for name in "ab")
    follow(first, TrapezoidalTrajectory(1.0))
    outcomes = []
    first.on_done(outcomes.append)
    second.stop()  # at the very nanosecond of its beginning
    assert [str(outcome.ending) for outcome in outcomes] == ["Ending.INTERRUPTED"]
    with pytest.raises(MotionInterrupted, match=r"stop\(\) of b"):
        first.wait_until_done(1.0)


def test_waiting_at_rest_in_a_reserved_motor_lets_time_pass(runtime):
    hardware = IdealHwMotor(runtime)
    first, second = (IdealMotor(hardware, MODEL, name=name) for name in "ab")
    first.stop()  # there is a finished motion, and it has not been checked yet
    with first.reserve(), pytest.raises(MotorBusyError), second.reserve(timeout_s=0.05):
        pass
    assert runtime.now_ns() == 50_000_000


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (
            {"axes": "x"},
            "axes: unknown key (known: name, axis, position_rad, torque_constant_n_m_a); did you",
        ),
        (
            {"node_id": 1},
            "node_id: unknown key (known: name, axis, position_rad, torque_constant_n_m_a); take",
        ),
        (
            {"position_m": 1.0},
            "position_m: unknown key (known: name, axis, position_rad, torque_constant_n_m_a)",
        ),
        (
            {"position_rad": "far"},
            'position_rad: must be a number [rad], but is a string ("far"); allowed: any finite',
        ),
        (
            {"position_rad": True},
            "position_rad: must be a number [rad], but is a boolean (true); allowed: any finite",
        ),
        (
            {"torque_constant_n_m_a": 0},
            "torque_constant_n_m_a: 0 is out of range; allowed: more than 0",
        ),
        ({"axis": 3}, "axis: must be a string, but is an integer (3)"),
    ],
)
def test_invalid_setting_is_named(runtime, settings, told):
    with pytest.raises(UsageError) as caught:
        build(None, {"name": "m", **settings}, MODEL, runtime)
    assert str(caught.value).startswith(told)


def test_motors_of_one_axis_must_agree_on_settings(runtime):
    first = build(None, {"name": "a", "axis": "shaft", "position_rad": 1.5}, MODEL, runtime)
    with pytest.raises(UsageError, match="must have the same settings"):
        build(None, {"name": "b", "axis": "shaft", "position_rad": 1.0}, MODEL, runtime)
    first.close()


def test_linear_motor_settings_are_in_metres(runtime):
    model = MotorModel(name="rail", kind=MotionKind.LINEAR, velocity_max=1.0, acceleration_max=1.0)
    motor = build(None, {"name": "r", "position_m": 0.3}, model, runtime)
    assert motor.position() == 0.3
    motor.close()
