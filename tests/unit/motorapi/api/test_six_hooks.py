"""A motor whose adaptation implements the six hooks that are a must, and nothing else."""

from dataclasses import fields

import pytest

from motorhil.motorapi.commands import ControlMode, DerivativeLimits
from motorhil.motorapi.errors import (
    DeviceFault,
    LinkError,
    MotionInterrupted,
    StateError,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.hooks import Hooks
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.outcome import Ending
from motorhil.motorapi.runtime.api import ChangeCounter
from motorhil.motorapi.state import Measurement, MotorState
from motorhil.motorapi.synchronization.quality import SyncLevel
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.support.checkout import CHECKOUT
from tests.support.motors.plain import MODEL, PlainHwMotor, fault_now


class SixMotor(Motor):
    def __init__(self, hardware, on_close=None):
        self.hw = hardware
        super().__init__(
            name=None,
            model=MODEL,
            runtime=hardware.runtime,
            physical=hardware.physical,
            on_close=on_close,
        )

    def _connect(self):
        pass

    def _latest(self):
        hw = self.hw
        return Measurement(self.runtime.now_ns(), hw.state, hw.position(), hw.velocity())

    def _enable(self):
        self.hw.state = MotorState.ENABLED

    def _disable(self):
        self.hw.freeze()
        self.hw.state = MotorState.DISABLED

    def _command(self, motion):
        self.hw.armed = motion
        self.hw.begin()

    def _stop(self):
        self.hw.freeze()


@pytest.fixture
def motor(hw):
    return SixMotor(hw)


def move(motor, distance, *, wait=True):
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(distance, relative=True)
    motor.start()
    if wait:
        motor.wait_until_done(timeout_s=5.0)


def test_six_hooks_make_a_motor_that_moves(motor):
    assert motor.state() is MotorState.DISABLED
    move(motor, 1.0)
    assert motor.position() == pytest.approx(1.0, abs=1e-12)  # a sum of parts of the profile
    assert motor.state() is MotorState.ENABLED
    assert motor.fault() is None
    motor.disable()
    assert motor.state() is MotorState.DISABLED


def test_relative_motion_starts_at_the_held_target(motor, hw):
    move(motor, 1.0)
    hw.held, hw.motion = 1.004, None  # an error of the servo, within the tolerance of the model
    move(motor, 1.0, wait=False)
    assert hw.motion.target == 2.0
    motor.stop()
    motor.wait_until_done(timeout_s=1.0)
    at = motor.position()
    move(motor, 1.0, wait=False)
    assert hw.motion.target == at + 1.0


def test_trajectory_ends_after_its_duration(motor):
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(0.004, duration_s=2.0))
    began_ns = motor.runtime.now_ns()
    motor.start()
    motor.wait_until_done(timeout_s=5.0)
    assert 2.0 <= (motor.runtime.now_ns() - began_ns) / 1e9 <= 2.1  # a poll every 10 ms, and rest


def test_stop_without_a_flag_is_done_at_rest(motor):
    move(motor, 1.0, wait=False)
    motor.runtime.wait_until(lambda: False, 0.2)
    motor.stop()
    assert not motor.is_done()
    motor.wait_until_done(timeout_s=1.0)
    assert motor.is_done()


def test_quick_stop_by_default_lasts_until_enabled(motor):
    move(motor, 1.0, wait=False)
    motor.quick_stop()
    assert motor.state() is MotorState.STOPPED
    assert motor.latest().state is MotorState.STOPPED
    motor.wait_until_done(timeout_s=1.0)
    with pytest.raises(StateError, match="quick stop"):
        motor.start()
    motor.enable()
    assert motor.state() is MotorState.ENABLED
    move(motor, 0.5)


@pytest.mark.parametrize(
    ("call", "feature"),
    [
        (Motor.torque, "measuring torque"),
        (Motor.following_error, "measuring the following error"),
        (Motor.home, "homing"),
        (lambda motor: motor.low_level().__enter__(), "low-level access"),
    ],
)
def test_capability_without_its_hook_is_unsupported(motor, call, feature):
    with pytest.raises(UnsupportedError, match=feature):
        call(motor)


def test_fault_without_a_code_is_reported(motor, hw):
    move(motor, 1.0, wait=False)
    fault_now(hw)
    with pytest.raises(DeviceFault, match="the drive reports no code"):
        motor.wait_until_done(timeout_s=1.0)
    assert motor.fault().code == 0
    with pytest.raises(UnsupportedError, match="clearing a fault"):
        motor.reset_fault()


class PolledMotor(SixMotor):
    """A motor whose drive must be asked, which waits."""

    answered = None

    def _refresh(self):
        self.runtime.wait_until(lambda: False, 0.001)
        self.answered = self.hw.fault
        return 0.01

    def _latest_fault(self):
        return self.answered


def test_fault_of_a_polled_motor_ends_its_wait(hw):
    motor = PolledMotor(hw)
    move(motor, 1.0, wait=False)
    fault_now(hw)
    with pytest.raises(DeviceFault, match="communication"):
        motor.wait_until_done(timeout_s=1.0)
    assert motor.fault() == hw.fault


class AskedMotor(SixMotor):
    """A motor on a link that counts frames, whose drive is asked: `_refresh` evaluates them."""

    heard = None

    def _refresh(self):
        self.runtime.wait_until(lambda: False, 0.001)
        self.hw.physical.news.grow()  # the last frame of the answer
        self.heard = super()._latest()
        return 0.01

    def _latest(self):
        return self.heard


def test_end_of_an_asked_motor_is_notified(hw):
    hw.physical.news = ChangeCounter()
    motor, outcomes = AskedMotor(hw), []
    move(motor, 1.0, wait=False)
    motor.on_done(outcomes.append)
    motor.wait_until_done(timeout_s=5.0)
    assert [outcome.ending for outcome in outcomes] == [Ending.DONE]


def test_power_lost_in_a_motion_interrupts_it(motor, hw):
    move(motor, 1.0, wait=False)
    hw.freeze()
    hw.state = MotorState.DISABLED
    with pytest.raises(MotionInterrupted, match="the drive, now off"):
        motor.wait_until_done(timeout_s=1.0)


def test_drive_that_is_not_heard_is_offline(motor, hw):
    def check():
        raise LinkError(link="bus0", reason="no status for 50 ms")

    move(motor, 1.0, wait=False)
    hw.physical.check_heard = check
    assert motor.state() is MotorState.OFFLINE
    assert motor.latest().state is MotorState.OFFLINE
    for call in (motor.position, lambda: motor.wait_until_done(timeout_s=1.0)):
        with pytest.raises(LinkError, match="no status for 50 ms"):
            call()


def test_group_of_such_motors_starts_one_by_one(runtime):
    group = MotorGroup(*(SixMotor(PlainHwMotor(runtime, node)) for node in (1, 2)))
    assert group.sync_capability().level is SyncLevel.SEQUENTIAL
    for motor, target in zip(group, (1.0, 2.0), strict=True):
        motor.set_control_mode(ControlMode.SETPOINT)
        motor.set_setpoint(target)
    group.start()
    group.wait_until_done(timeout_s=5.0)
    assert [round(motor.position(), 9) for motor in group] == [1.0, 2.0]


def test_motor_is_named_and_closed_by_its_base(hw):
    closed = []
    with SixMotor(hw, lambda: closed.append(1)) as motor:
        assert motor.name == "plain at bus0 node 1"
    motor.close()
    assert closed == [1]


def test_class_without_a_command_is_refused(hw):
    mute = type("Mute", (SixMotor,), {"_command": Motor._command})
    with pytest.raises(UsageError, match="Mute: implements neither _command nor _arm"):
        mute(hw)


def test_command_that_no_default_can_follow_is_refused(motor):
    motor.set_control_mode(ControlMode.TRAJECTORY)
    with pytest.raises(UnsupportedError, match="limited jerk"):
        motor.set_trajectory(TrapezoidalTrajectory(1.0, limits=DerivativeLimits(third=1.0)))


def test_every_hook_is_on_the_page_of_the_api():
    page = (CHECKOUT / "docs" / "reference" / "adaptation.md").read_text()
    hooks = {field.name for field in fields(Hooks)} - {"plugin"} | {"command", "latest_fault"}
    assert [hook for hook in sorted(hooks) if f"`_{hook}(" not in page] == []


def test_drive_is_asked_for_its_fault(hw):
    motor = PolledMotor(hw)
    assert motor.fault() is None
    fault_now(hw)
    assert motor.fault() == hw.fault
