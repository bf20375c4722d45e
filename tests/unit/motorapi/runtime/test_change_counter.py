"""Change counters: hardware with a counter is examined after changes only."""

import pytest

from motorhil.motorapi import ControlMode
from motorhil.motorapi.errors import DeadlineExceeded, MotionInterrupted
from motorhil.motorapi.runtime.api import ChangeCounter
from tests.support.motors.plain import PlainMotor


@pytest.fixture
def asked(runtime, motor, monkeypatch):
    """Return the times of the motor's `_is_done` calls [ns]; time stops every 1 ms."""
    times_ns = []
    is_done = PlainMotor._is_done

    def counted(self):
        times_ns.append(runtime.now_ns())
        return is_done(self)

    monkeypatch.setattr(PlainMotor, "_is_done", counted)
    runtime.every(0.001, lambda: None)
    motor.hw.polled_s = None  # it reports by itself
    motor.logical.physical.news = ChangeCounter()
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(1.0)  # takes 1 s
    motor.start()
    times_ns.clear()
    return times_ns


def tell(runtime, motor):
    motor.logical.physical.news.count += 1


def test_change_is_examined_in_its_own_event(runtime, motor, asked):
    runtime.every(0.3, lambda: tell(runtime, motor))
    motor.wait_until_done(timeout_s=2.0)
    assert runtime.now_ns() == 1_200_000_000
    assert sorted(set(asked)) == [0, 300_000_000, 600_000_000, 900_000_000, 1_200_000_000]


def test_motor_without_changes_is_not_examined(motor, asked):
    with pytest.raises(DeadlineExceeded):
        motor.wait_until_done(timeout_s=2.0)
    assert set(asked) == {0}


def test_motor_without_a_counter_is_examined_at_every_event(runtime, motor, asked):
    motor.logical.physical.news = None
    motor.wait_until_done(timeout_s=2.0)
    assert runtime.now_ns() == 1_000_000_000
    assert len(asked) > 900


def test_motor_that_is_asked_is_examined_after_new_measurements(runtime, motor, asked):
    motor.hw.polled_s = 0.1
    motor.wait_until_done(timeout_s=2.0)
    assert runtime.now_ns() == 1_000_000_000
    assert len(set(asked)) < 20


def test_stop_by_another_motor_is_a_change(runtime, hw, motor, asked):
    other = PlainMotor(hw, name="other")
    party = runtime.spawn("stop", lambda: (runtime.run_for(0.5), other.stop()))
    with pytest.raises(MotionInterrupted, match="other"):
        motor.wait_until_done(timeout_s=2.0)
    assert 500_000_000 <= runtime.now_ns() < 502_000_000
    assert party.join(1.0)
