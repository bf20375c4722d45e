"""Every failure of every call is in the error tree, whatever a hook or callback raises."""

import struct
from dataclasses import fields

import can
import pytest
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from motorhil.motorapi import (
    ControlMode,
    LinkError,
    Motor,
    MotorError,
    MotorGroup,
    PluginError,
    Synchronization,
    TrapezoidalTrajectory,
    UsageError,
    WallRuntime,
)
from motorhil.motorapi.hooks import Hooks
from tests.support.motors.plain import PlainBus, PlainHwMotor, PlainMotor

HOOKS = sorted(f"_{field.name}" for field in fields(Hooks) if field.name != "plugin")
RAISED = (
    KeyError("planted"),
    OSError(19, "No such device"),
    struct.error("unpack requires 4 bytes"),
    can.CanOperationError("bus off"),
    SdoAbortedError(0x06020000),
    SdoCommunicationError("planted"),
    AssertionError(),
    StopIteration(),
    RuntimeError("planted"),
)
CALLS = {
    "mode": lambda motor: motor.set_control_mode(ControlMode.SETPOINT),
    "setpoint": lambda motor: motor.set_setpoint(1.0),
    "trajectory": lambda motor: (
        motor.set_control_mode(ControlMode.TRAJECTORY),
        motor.set_trajectory(TrapezoidalTrajectory(1.0)),
    ),
    "start": Motor.start,
    "progress": Motor.progress,
    "on_done": lambda motor: motor.on_done(lambda outcome: None),
    "is_done": Motor.is_done,
    "wait": lambda motor: motor.wait_until_done(timeout_s=3.0),
    "stop": Motor.stop,
    "halt": Motor.halt,
    "quick_stop": Motor.quick_stop,
    "enable": Motor.enable,
    "disable": Motor.disable,
    "home": lambda motor: motor.home(37, timeout_s=1.0),
    "reset_fault": Motor.reset_fault,
    "state": Motor.state,
    "fault": Motor.fault,
    "is_referenced": Motor.is_referenced,
    "position": Motor.position,
    "velocity": Motor.velocity,
    "torque": Motor.torque,
    "following_error": Motor.following_error,
    "latest": Motor.latest,
    "low_level": lambda motor: motor.low_level(timeout_s=1.0).__enter__(),
    "repr": repr,
}


def path_quality(group):
    group.wait_until_done(timeout_s=3.0)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(*(TrapezoidalTrajectory(1.0) for _ in group))
    group.synchronization = Synchronization.PHASE
    group.start()
    group.sync_quality()


GROUP_CALLS = {
    "start": MotorGroup.start,
    "is_done": MotorGroup.is_done,
    "wait": lambda group: group.wait_until_done(timeout_s=3.0),
    "capability": MotorGroup.sync_capability,
    "quality": MotorGroup.sync_quality,
    "path": path_quality,
    "stop": MotorGroup.stop,
    "repr": repr,
}


NOT_ASKED = ("_close_low_level", "_disarm", "_reset_fault", "_stop_with_others")
"""This adaptation does not offer its hardware object, and none of these starts fails. A stop of
other motors fails inside a callback: it becomes a note on the error of the first failed motor.
"""


def failures_of(calls, thing):
    """Return the exception of each call, also those outside of the error tree."""
    raised = {}
    for name, call in calls.items():
        try:
            call(thing)
        except Exception as error:
            raised[name] = error
    return raised


CASES = [(hook, RAISED[0]) for hook in HOOKS]
DEFAULTS = {
    "_halt": ("_stop",),
    "_read_torque": ("_refresh", "_latest"),
    "_read_following_error": ("_refresh", "_latest"),
}
"""The hooks that another one calls by default."""
CASES += [(hook, planted) for hook in ("_arm", "_is_done", "_stop") for planted in RAISED[1:]]


@pytest.mark.parametrize(("hook", "planted"), CASES)
def test_hook_exception_becomes_a_plugin_error(runtime, hook, planted):
    def fail(self, *args, **kwargs):
        raise planted

    fail.__name__ = hook
    broken = type("Broken", (PlainMotor,), {hook: fail})
    bus = PlainBus()
    motors = [broken(PlainHwMotor(runtime, node, bus)) for node in (1, 2)]
    raised = failures_of(CALLS, motors[0])
    raised |= {f"group {k}": e for k, e in failures_of(GROUP_CALLS, MotorGroup(*motors)).items()}
    raised |= failures_of({"close": Motor.close}, motors[0])
    assert [name for name, error in raised.items() if not isinstance(error, MotorError)] == []
    plugin = [error for error in raised.values() if isinstance(error, PluginError)]
    for error in plugin:
        assert (error.plugin, error.problem) == ("Broken", repr(planted))
        assert error.where == hook or hook in DEFAULTS.get(error.where, ())
        assert error.__cause__ is planted
    assert plugin or hook in NOT_ASKED
    assert "repr" not in raised


def test_callback_exception_names_its_place(runtime, motor):
    def clumsy():
        raise ZeroDivisionError("planted")

    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(3.0))
    motor.start()
    timer = runtime.every(0.1, clumsy)
    with pytest.raises(PluginError) as caught:
        motor.wait_until_done(timeout_s=5.0)
    timer.cancel()
    assert caught.value.plugin.endswith("clumsy")
    assert "test_every_failure.py" in caught.value.where
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
    motor.wait_until_done(timeout_s=5.0)  # the motion is not affected


def test_group_observer_exception_becomes_a_plugin_error(pair):
    group = MotorGroup(*pair)
    for motor in pair:
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(TrapezoidalTrajectory(1.0))
    group.observe(lambda quality: {}["planted"])
    group.start()
    with pytest.raises(PluginError, match=r"observer of m1, m2: KeyError\('planted'\)"):
        group.wait_until_done()
    assert [motor.position() for motor in pair] == [1.0, 1.0]


@pytest.mark.parametrize("junk", [None, "left", 7, object(), []])
def test_group_rejects_members_that_are_not_devices(pair, junk):
    group = MotorGroup(*pair)
    for call in (group.append, group.remove):
        with pytest.raises(UsageError, match="is not a device"):
            call(junk)
    assert len(group) == 2


@pytest.mark.parametrize("error", [OSError(100, "Network is down"), can.CanOperationError("off")])
def test_real_bus_that_cannot_send_is_a_lost_link(error):
    class Broken:
        channel_info = "broken bus"

        def send(self, message):
            raise error

    runtime = WallRuntime()
    try:
        with pytest.raises(LinkError, match="broken bus: cannot send") as caught:
            runtime.send(Broken(), bytes(16))
        assert caught.value.__cause__ is error
    finally:
        runtime.close()
