"""End-of-motion callbacks and progress, on hardware in memory."""

import logging

import pytest

from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DeviceFault,
    LinkError,
    MotionInterrupted,
    MotorGroup,
    PluginError,
    StateError,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.outcome import Ending, Outcome
from motorhil.motorapi.runtime.api import ChangeCounter
from tests.support.motors.plain import PlainMotor, fault_now

MS = 1_000_000


def follow(motor, way):
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(way))


@pytest.fixture
def told(motor):
    """Return the outcomes of an active motion of 3.0 (2 s: at 2.0, by 4.0)."""
    outcomes = []
    follow(motor, 3.0)
    motor.start()
    motor.on_done(outcomes.append)
    return outcomes


def test_end_is_reported_once(runtime, motor, told):
    runtime.run_for(1.0)
    assert told == []
    runtime.run_for(2.0)
    assert told == [Outcome("m1", "start() of m1", Ending.DONE, 2_000_000_000)]
    assert told[0]
    motor.start()
    motor.wait_until_done()
    assert len(told) == 1  # another motion


def test_past_end_is_reported_at_once_and_no_motion_raises(motor):
    with pytest.raises(StateError, match=r"on_done refused.*start\(\) first"):
        motor.on_done(print)
    follow(motor, 1.0)
    motor.start()
    motor.wait_until_done()
    told = []
    motor.on_done(told.append)
    assert [outcome.ending for outcome in told] == [Ending.DONE]
    with pytest.raises(UsageError, match="not callable; give a function"):
        motor.on_done(None)


@pytest.mark.parametrize("counted", [False, True])
def test_stop_from_elsewhere_is_reported_immediately(runtime, hw, motor, counted):
    if counted:
        motor.logical.physical.news = ChangeCounter()
    other = PlainMotor(hw, name="other")
    follow(motor, 3.0)
    motor.start()
    told = []
    motor.on_done(told.append)
    runtime.run_for(0.5)
    other.stop()
    assert [(one.ending, one.time_ns) for one in told] == [(Ending.INTERRUPTED, 500 * MS)]
    assert isinstance(told[0].error, MotionInterrupted)
    assert told[0].error.by == "stop() of other"
    assert not told[0]
    assert str(told[0]).startswith("start() of m1: interrupted at 0.500000 s: m1: the motion was")


def test_replaced_motion_is_interrupted(runtime, motor):
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(2.0)
    motor.start()
    told = []
    motor.on_done(told.append)
    runtime.run_for(0.1)
    motor.set_setpoint(1.0)
    motor.start()
    assert [one.ending for one in told] == [Ending.INTERRUPTED]


def test_fault_is_reported_with_its_details(runtime, hw, told):
    runtime.run_for(0.5)
    fault_now(hw, 0x8611, "lagging")
    runtime.run_for(0.02)  # without a change counter, this hardware is examined every 10 ms
    assert [one.ending for one in told] == [Ending.FAILED]
    assert isinstance(told[0].error, DeviceFault)
    assert told[0].error.code == 0x8611


def test_lost_motor_is_reported(runtime, hw, told):
    hw.heard = False
    runtime.run_for(0.02)
    assert isinstance(told[0].error, LinkError)
    assert told[0].ending is Ending.FAILED


def test_velocity_is_done_when_it_is_reached(runtime, motor):
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(1.0)
    motor.start()
    told = []
    motor.on_done(told.append)
    assert [one.ending for one in told] == [Ending.DONE]


def test_stop_and_homing_report_their_end(runtime, motor):
    for command, name in ((motor.stop, "stop"), (lambda: motor.home(wait=False), "home")):
        command()
        told = []
        motor.on_done(told.append)
        runtime.run_for(0.1)
        assert [(one.operation, one.ending) for one in told] == [(f"{name}() of m1", Ending.DONE)]


def test_cancelled_callback_is_not_called(runtime, motor, told):
    also = []
    registration = motor.on_done(also.append)
    registration.cancel()
    registration.cancel()
    runtime.run_for(3.0)
    assert (len(told), len(also)) == (1, 0)
    registration.cancel()
    assert motor.logical.physical.bell.listeners == []


def test_end_seen_by_two_threads_is_reported_once(runtime, motor):
    follow(motor, 1.0)
    motor.start()
    told = []
    notice = motor.on_done(lambda outcome: (told.append(outcome), notice.look()))
    runtime.run_for(2.0)
    notice.look()
    assert len(told) == 1


def test_callbacks_are_called_in_order_of_registration(runtime, motor, told):
    order = []
    for name in "abc":
        motor.on_done(lambda outcome, name=name: order.append(name))
    runtime.run_for(3.0)
    assert order == ["a", "b", "c"]


def test_callback_exception_is_raised_by_the_next_wait(runtime, motor, caplog):
    def clumsy(outcome):
        raise KeyError("planted")

    follow(motor, 1.0)
    motor.start()
    told = []
    motor.on_done(clumsy)
    motor.on_done(told.append)
    with caplog.at_level(logging.ERROR, "motorapi"):
        runtime.run_for(2.0)  # others are not affected
    assert len(told) == 1  # nor is the next callback
    assert "clumsy: on_done of m1: KeyError('planted')" in caplog.text
    with pytest.raises(PluginError) as caught:
        motor.wait_until_done()
    assert caught.value.where == "on_done of m1"
    assert caught.value.plugin.endswith("clumsy")
    assert isinstance(caught.value.__cause__, KeyError)
    motor.wait_until_done()  # reported once
    assert motor.is_done()


def test_callback_exception_does_not_stop_a_group(runtime, pair):
    group = MotorGroup(*pair)
    for motor, way in zip(pair, (0.5, 1.0), strict=True):
        follow(motor, way)
    group.start()
    pair[0].on_done(lambda outcome: 1 / 0)
    with pytest.raises(PluginError, match="ZeroDivisionError"):
        group.wait_until_done()
    assert [motor.position() for motor in pair] == [0.5, 1.0]
    group.wait_until_done()


def test_callback_must_not_wait(runtime, hw, motor, told):
    hw.acts_s = 0.01
    motor.on_done(lambda outcome: motor.start())
    runtime.run_for(3.0)
    with pytest.raises(PluginError, match="waiting inside a callback"):
        motor.wait_until_done()


def test_party_continues_on_a_flag_set_by_the_callback(runtime, motor, told):
    def again():
        runtime.wait_until(lambda: bool(told))
        motor.start()

    party = runtime.spawn("again", again)
    runtime.run_for(3.0)
    assert party.finished
    motor.wait_until_done()
    assert motor.position() == 6.0


# --- progress ----------------------------------------------------------------------------------


def test_progress_reports_distance_time_and_remainder(runtime, motor):
    assert motor.progress() is None
    follow(motor, 3.0)
    motor.start()
    runtime.run_for(0.5)  # accelerates for 0.5 s, by 0.5
    progress = motor.progress()
    assert progress.operation == "start() of m1"
    assert (progress.elapsed_s, progress.expected_s, progress.remaining_s) == (0.5, 2.0, 1.5)
    assert progress.fraction == pytest.approx(0.5 / 3.0)  # of a quotient of floats
    assert (progress.position, progress.target) == (0.5, 3.0)
    runtime.run_for(0.5)
    assert motor.progress().fraction == pytest.approx(0.5)
    motor.wait_until_done()
    assert motor.progress() is None


def test_progress_neither_waits_nor_sends(runtime, hw, motor, told):
    log = list(hw.log)
    seen = []
    runtime.every(0.5, lambda: seen.append(motor.progress()))
    runtime.run_for(1.9)
    assert [one.elapsed_s for one in seen] == [0.5, 1.0, 1.5]
    assert hw.log == log


def test_progress_after_a_fault_or_a_stop_is_none(runtime, hw, motor, told):
    fault_now(hw)
    assert motor.progress() is None
    motor.reset_fault()
    assert motor.progress() is None
    motor.start()
    motor.stop()
    runtime.run_for(0.1)
    assert motor.progress() is None


def test_progress_of_a_reached_velocity_continues(runtime, motor):
    motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motor.set_setpoint(1.0)
    motor.start()
    runtime.run_for(1.0)
    progress = motor.progress()
    assert (progress.target, progress.fraction, progress.remaining_s) == (1.0, 1.0, 0.0)
    motor.stop()
    assert motor.progress() is None


def test_low_level_without_a_hardware_object_raises(motor):
    with pytest.raises(UnsupportedError, match="low-level access"), motor.low_level():
        pass
    follow(motor, 1.0)
    motor.start()  # nothing is held
    motor.wait_until_done()
