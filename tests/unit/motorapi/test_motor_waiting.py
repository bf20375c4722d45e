import pytest

from motorhil.motorapi import (
    ControlVariable,
    DeadlineExceeded,
    DerivativeLimits,
    DeviceFault,
    LinkError,
    MotionInterrupted,
    Motor,
    MotorBusyError,
    MotorState,
    PluginError,
    StateError,
)
from tests.support.motors.plain import PlainHwMotor, PlainMotor, fault_now
from tests.unit.motorapi.test_motor import SETPOINT, aim, asked, follow

VELOCITY = ControlVariable.VELOCITY


def test_wait_timeout_reports_the_last_values(runtime, motor):
    follow(motor, 3.0)
    motor.start()
    began_ns = runtime.now_ns()
    with pytest.raises(DeadlineExceeded) as caught:
        motor.wait_until_done(timeout_s=1.0)
    assert runtime.now_ns() - began_ns == 1_000_000_000
    assert caught.value.timeout_s == 1.0
    assert "end of motion of m1" in str(caught.value)
    assert "enabled at" in caught.value.last_heard
    assert "1.5 rad, 2 rad/s" in caught.value.last_heard
    assert not motor.is_done()
    motor.wait_until_done(timeout_s=1.001)
    assert motor.is_done()


def test_wait_without_a_command_returns_at_once(runtime, motor):
    motor.wait_until_done()
    assert motor.is_done()
    assert runtime.now_ns() == 0


def test_fault_during_a_motion_ends_the_wait(runtime, motor, hw):
    follow(motor, 3.0)
    motor.start()
    runtime.spawn("trouble", lambda: (runtime.run_for(0.5), fault_now(hw, 0x8611, "lagging")))
    with pytest.raises(DeviceFault) as caught:
        motor.wait_until_done(timeout_s=5)
    assert runtime.now_ns() <= 501_000_000
    assert (caught.value.code, caught.value.text, caught.value.motor) == (0x8611, "lagging", "m1")
    for refused in (motor.start, motor.enable, motor.home):
        with pytest.raises(DeviceFault):
            refused()
    assert motor.fault().code == 0x8611
    motor.reset_fault()
    assert motor.fault() is None
    assert motor.state() is MotorState.DISABLED
    with pytest.raises(DeviceFault, match="fault 8611h"):  # that motion still ended in this way
        motor.wait_until_done()
    motor.start()
    motor.wait_until_done()


def test_reset_fault_without_a_fault_does_nothing(motor, hw):
    motor.reset_fault()
    assert hw.log == []


def test_motor_that_does_not_respond_raises_link_error(runtime, motor, hw):
    hw.state = MotorState.OFFLINE
    assert motor.state() is MotorState.OFFLINE
    aim(motor, 1.0)
    with pytest.raises(LinkError, match="bus0 node 1"):
        motor.start()
    hw.state = MotorState.ENABLED
    motor.start()
    hw.heard = False
    with pytest.raises(LinkError):
        motor.wait_until_done()


def test_own_stop_ends_the_motion_and_is_awaited(runtime, motor, hw):
    follow(motor, 3.0)
    motor.start()
    runtime.run_for(1.0)
    motor.stop()
    motor.wait_until_done()
    assert motor.position() == 1.5
    motor.start()  # the command is still there
    motor.wait_until_done()
    assert motor.position() == 4.5


@pytest.mark.parametrize("how", [Motor.stop, Motor.quick_stop, Motor.halt])
def test_stop_from_elsewhere_ends_the_wait_with_its_name(runtime, motor, hw, how):
    other = PlainMotor(hw, name="other")
    follow(motor, 3.0)
    motor.start()
    runtime.spawn("other", lambda: (runtime.run_for(0.5), how(other)))
    with pytest.raises(MotionInterrupted, match=rf"{how.__name__}\(\) of other") as caught:
        motor.wait_until_done()
    assert caught.value.at_ns == 500_000_000


def test_stop_is_permitted_in_a_callback(runtime, motor, hw):
    follow(motor, 3.0)
    motor.start()
    runtime.every(0.75, motor.stop)
    with pytest.raises(MotionInterrupted):
        motor.wait_until_done()
    assert runtime.now_ns() == 750_000_000
    assert asked(hw)[-1] == "_stop"


def test_motor_after_quick_stop_moves_only_when_enabled(motor, hw):
    follow(motor, 3.0)
    motor.start()
    motor.quick_stop()
    motor.wait_until_done()
    assert motor.state() is MotorState.STOPPED
    with pytest.raises(StateError, match=r"enable\(\)"):
        motor.start()
    motor.enable()
    motor.start()


def test_disable_ends_the_motion(motor):
    follow(motor, 3.0)
    motor.start()
    motor.disable()
    assert motor.state() is MotorState.DISABLED
    with pytest.raises(MotionInterrupted, match=r"disable\(\) of m1"):
        motor.wait_until_done()


def test_trajectory_starts_from_rest_only(runtime, motor):
    follow(motor, 3.0)
    motor.start()
    for refused in (motor.start, motor.home):
        with pytest.raises(StateError, match=r"start\(\) of m1 is active"):
            refused()
    aim(motor, 0.0)
    with pytest.raises(StateError, match="stop"):
        motor.start()
    motor.wait_until_done()
    motor.start()


def test_set_point_replaces_one_of_its_kind_during_motion(runtime, motor, hw):
    aim(motor, 3.0)
    motor.start()
    runtime.run_for(0.5)
    motor.set_setpoint(0.0)
    motor.start()
    motor.wait_until_done()
    assert motor.position() == 0.0
    motor.set_setpoint(1.0)
    motor.start()
    motor.set_control_mode(SETPOINT, VELOCITY)
    motor.set_setpoint(1.0)
    with pytest.raises(StateError):
        motor.start()


def test_velocity_set_point_is_done_when_reached_and_continues(runtime, motor, hw):
    motor.set_control_mode(SETPOINT, VELOCITY)
    motor.set_setpoint(1.5)
    motor.start()
    motor.wait_until_done()
    runtime.run_for(2.0)
    assert motor.velocity() == 1.5
    motor.set_setpoint(-1.0)
    motor.start()
    follow(motor, 1.0)
    with pytest.raises(StateError, match="is active"):
        motor.start()
    motor.stop()
    motor.wait_until_done()
    motor.start()


def test_torque_has_the_requested_slope(motor, hw):
    motor.set_control_mode(SETPOINT, ControlVariable.TORQUE)
    motor.set_setpoint(0.5, limits=DerivativeLimits(first=(-3.0, 2.0)))
    motor.start()
    assert (hw.motion.target, hw.motion.slope) == (0.5, 2.0)


@pytest.mark.parametrize("hook", ["_enable", "_arm"])
def test_start_that_fails_before_firing_moves_nothing(motor, hw, hook):
    hw.fail[hook] = LinkError(link="bus0", reason="gone")
    aim(motor, 1.0)
    with pytest.raises(LinkError):
        motor.start()
    assert hw.motion is None
    assert hw.armed is None
    assert hw.bus.fired == 0
    assert asked(hw)[-1] == ("_disarm" if hook == "_arm" else "_enable")
    motor.wait_until_done()  # nothing was begun
    del hw.fail[hook]
    motor.start()
    motor.wait_until_done()
    assert motor.position() == 1.0


def test_start_without_acknowledge_is_stopped(motor, hw):
    hw.fail["_confirm"] = DeadlineExceeded(awaited="bit 12", timeout_s=0.1, last_heard="")
    aim(motor, 1.0)
    with pytest.raises(DeadlineExceeded, match="bit 12"):
        motor.start()
    assert asked(hw)[-2:] == ["_stop", "_disarm"]
    with pytest.raises(MotionInterrupted, match="failed start"):
        motor.wait_until_done()


@pytest.mark.parametrize("moment", ["_enable", "_arm", "_confirm"])
def test_stop_during_start_wins(runtime, moment):
    hw = PlainHwMotor(runtime, acts_s=0.1)
    motor, other = PlainMotor(hw), PlainMotor(hw, name="other")
    order = ["_enable", "_arm", "_confirm"]
    at_s = 0.05 + 0.1 * order.index(moment)
    aim(motor, 3.0)
    runtime.spawn("other", lambda: (runtime.run_for(at_s), other.stop()))
    with pytest.raises(MotionInterrupted, match=r"stop\(\) of other"):
        motor.start()
    assert hw.motion is None
    assert hw.armed is None
    assert hw.bus.fired == (1 if moment == "_confirm" else 0)
    if moment == "_confirm":
        with pytest.raises(MotionInterrupted):
            motor.wait_until_done()
    else:
        motor.wait_until_done()  # nothing was begun


def test_stop_between_acquisition_and_planning_is_the_holder(runtime, hw, motor, monkeypatch):
    other = PlainMotor(hw, name="other")
    monkeypatch.setattr(hw, "done", lambda: False)  # its deceleration takes long
    hw.connecting_s = 0.01
    stopping = runtime.spawn("stop", other.stop)  # once connected, at 10 ms
    runtime.run_for(0.005)
    aim(motor, 1.0)
    with pytest.raises(MotorBusyError, match=r"held by stop\(\) of other"):
        motor.start()  # acquired at 5 ms, connected at 15 ms
    assert runtime.now_ns() == 15_000_000
    assert stopping.finished
    assert ("_arm", False) not in hw.log


def test_adaptation_errors_are_plugin_errors_with_cause(motor, hw):
    hw.fail["_arm"] = KeyError("6081h")
    aim(motor, 1.0)
    with pytest.raises(PluginError) as caught:
        motor.start()
    assert (caught.value.plugin, caught.value.where) == ("PlainMotor", "_arm")
    assert isinstance(caught.value.__cause__, KeyError)
    hw.fail = {"_is_done": ZeroDivisionError()}
    motor.start()
    with pytest.raises(PluginError, match="_is_done"):
        motor.wait_until_done()


def test_public_methods_cannot_be_overridden():
    with pytest.raises(PluginError, match="final"):

        class Cheat(PlainMotor):
            def start(self):
                pass


OWN_NAMES = (
    *("_name", "_runtime", "_model", "_logical", "_hooks", "_command", "_mode", "_variable"),
    *("_run", "_owner", "_operation", "_status", "_begin", "_measured", "_require_mode"),
)


def test_adaptation_may_use_private_names_of_its_own(hw):
    class Own(PlainMotor):
        def __init__(self, hw):
            super().__init__(hw)
            for name in OWN_NAMES:
                setattr(self, name, "own")

        def _measured(self):
            raise AssertionError

        _require_mode = _status = _begin = _operation = _measured

    motor = Own(hw)
    aim(motor, 1.0)
    motor.start()
    motor.wait_until_done()
    assert (motor.name, motor.position()) == ("m1", 1.0)
    assert motor.logical.name == "m1"
    assert {getattr(motor, name) for name in OWN_NAMES} == {"own"}


def test_homing_waits_if_requested(runtime, motor, hw):
    motor.home(35, wait=False)
    motor.wait_until_done()
    hw.fail["_is_done"] = DeadlineExceeded(awaited="homing", timeout_s=1.0, last_heard="")
    with pytest.raises(DeadlineExceeded):
        motor.home()
    assert asked(hw)[-1] == "_stop"


def test_motor_repr_shows_its_identity(motor, hw):
    assert repr(motor) == "<PlainMotor 'm1' on bus0 node 1: disabled, 0 rad>"
    aim(motor, 1.0)
    motor.start()
    motor.wait_until_done()
    assert repr(motor) == "<PlainMotor 'm1' on bus0 node 1: enabled, 1 rad>"
    assert motor.latest().position == 1.0
    assert motor.control_mode is SETPOINT
    assert motor.control_variable is ControlVariable.POSITION
