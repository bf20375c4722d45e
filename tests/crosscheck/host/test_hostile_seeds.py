"""Loss, reboots and foreign nodes at random moments: every call ends correctly.

After an error no motor moves without a command; after success every motor is at its target.
"""

import contextlib
from random import Random

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.motorapi import ControlMode, ControlVariable, Motor, MotorGroup, TrapezoidalTrajectory
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    DeviceFault,
    LinkError,
    MotionInterrupted,
    MotorError,
)
from tests.support.canopen.drive_wire import frame
from tests.support.canopen.two_drives import INC_PER_RAD, demand, is_at_rest, moving, two_drives
from tests.support.repetition import examples

SECOND = 1_000_000_000
RIGHT_ERRORS = (DeadlineExceeded, DeviceFault, LinkError, MotionInterrupted)
ONE_PERCENT = FaultRule("loss", FaultKind.DROP, probability=0.01)


def group_of(rig) -> MotorGroup:
    group = MotorGroup(rig.motors["left"], rig.motors["right"])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(0.3), TrapezoidalTrajectory(-0.2))
    return group


@pytest.mark.parametrize("seed", range(examples(4)))
def test_group_with_one_percent_loss_arrives_or_stops(seed):
    with two_drives(ONE_PERCENT, seed=seed) as rig:
        try:
            group_of(rig).start()
            group_of(rig).wait_until_done(5)
        except RIGHT_ERRORS:
            rig.runtime.run_for(0.5)
            assert is_at_rest(rig, "left", "right")
            before = demand(rig, "left"), demand(rig, "right")
            assert 0 <= before[0] <= 0.3 * INC_PER_RAD + 1
            assert -0.2 * INC_PER_RAD - 1 <= before[1] <= 0
            # Any set-point still latched would start now.
            rig.motors["left"].hardware.node.bus.sync.send()
            rig.runtime.run_for(0.3)
            assert (demand(rig, "left"), demand(rig, "right")) == before
        else:
            assert demand(rig, "left") == pytest.approx(0.3 * INC_PER_RAD, abs=1)
            assert demand(rig, "right") == pytest.approx(-0.2 * INC_PER_RAD, abs=1)
        assert rig.runtime.now_ns() < 60 * SECOND


@pytest.mark.parametrize("seed", range(examples(4)))
def test_wheel_with_one_percent_loss_turns_and_stops(seed):
    with two_drives(ONE_PERCENT, seed=seed) as rig:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        motor.set_setpoint(1.5)
        try:
            motor.start()
            motor.wait_until_done(3)
        except RIGHT_ERRORS:
            pass
        else:
            turning = rig.controllers["left"].snapshot()["velocity_rad_s"]
            assert turning == pytest.approx(1.5, abs=0.1)
        motor.stop()
        rig.runtime.run_for(1.0)
        assert is_at_rest(rig, "left")


@pytest.mark.parametrize("seed", range(examples(3)))
def test_calls_end_with_one_percent_loss(seed):
    with two_drives(ONE_PERCENT, seed=seed) as rig:
        motor = rig.motors["left"]
        for call in (
            motor.position,
            lambda: motor.home(37, timeout_s=2),
            motor.velocity,
            motor.torque,
            motor.is_referenced,
            lambda: rig.controllers["left"].stimulate("fault", 0x2310),
            motor.fault,
            motor.reset_fault,
            motor.enable,
            motor.quick_stop,
            lambda: motor.wait_until_done(2),
            motor.disable,
        ):
            begun = rig.runtime.now_ns()
            with contextlib.suppress(RIGHT_ERRORS):
                call()
            assert rig.runtime.now_ns() - begun < 8 * SECOND


@pytest.mark.parametrize("command", ["81", "82", "02", "80"])
@pytest.mark.parametrize("seed", range(examples(2)))
def test_drive_is_usable_after_reset_or_stop_at_any_moment(command, seed):
    with two_drives(seed=seed) as rig:
        motor = rig.motors["left"]
        port = rig.world.add_host("can0", "stranger", lambda *_: None)
        at = rig.runtime.now_ns() + round(Random(f"{command}{seed}").uniform(0, 0.35) * SECOND)
        rig.world.queue.alarm(lambda _: port.send(frame(f"000#{command}01"))).set(at)
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(TrapezoidalTrajectory(0.5))
        try:
            motor.start()
            motor.wait_until_done(5)
        except RIGHT_ERRORS:
            pass
        rig.runtime.run_for(1.0)
        begun = demand(rig)
        motor.set_trajectory(TrapezoidalTrajectory(0.1))
        motor.start()
        motor.wait_until_done(5)
        assert demand(rig) - begun == pytest.approx(0.1 * INC_PER_RAD, abs=40)


@pytest.mark.parametrize("period_s", [0.0002, 0.0007, 0.0101])
@pytest.mark.parametrize("variable", [ControlVariable.POSITION, ControlVariable.VELOCITY])
def test_second_sync_producer_starts_no_motion_twice(period_s, variable):
    with two_drives() as rig:
        port = rig.world.add_host("can0", "stranger", lambda *_: None)
        rig.runtime.every(period_s, lambda: port.send(frame("080#")))
        group = MotorGroup(rig.motors["left"], rig.motors["right"])
        group.for_each(Motor.set_control_mode, ControlMode.SETPOINT, variable)
        group.for_each(Motor.set_setpoint, 0.4)
        group.start()
        group.wait_until_done(5)
        rig.runtime.run_for(0.2)
        for name in ("left", "right"):
            if variable is ControlVariable.POSITION:
                assert demand(rig, name) == pytest.approx(0.4 * INC_PER_RAD, abs=1)
            else:
                truth = rig.controllers[name].snapshot()["velocity_rad_s"]
                assert truth == pytest.approx(0.4, abs=0.1)


@pytest.mark.parametrize(("seconds", "lost"), [(0.1, False), (0.5, True)])
def test_full_bus_ends_in_dead_man_time_and_is_usable_again(seconds, lost):
    with two_drives() as rig:
        motor = moving(rig.motors["left"])
        port = rig.world.add_host("can0", "babbler", lambda *_: None)
        begun = rig.runtime.now_ns()
        for _ in range(int(seconds / 126e-6)):  # 126 bits each: no other frame gets through
            port.send(frame("000#FFFFFFFFFFFFFFFF"))
        if lost:
            with pytest.raises(LinkError, match="no heartbeat for 300 ms"):
                motor.wait_until_done(5)
            assert rig.runtime.now_ns() - begun <= 0.41 * SECOND
            rig.runtime.run_for(1.0)
            assert is_at_rest(rig, "left")  # its own dead-man has stopped it
            assert demand(rig) < INC_PER_RAD
            motor.set_trajectory(TrapezoidalTrajectory(0.1))
            motor.start()
        motor.wait_until_done(5)


def test_single_false_statusword_ends_wait_only_with_error():
    with two_drives() as rig:
        motor = moving(rig.motors["left"])
        place = int(rig.controllers["left"].snapshot()["position_inc"])
        port = rig.world.add_host("can0", "liar", lambda *_: None)
        port.send(frame("181#4002" + place.to_bytes(4, "little").hex()))  # switch on disabled?
        with pytest.raises(MotionInterrupted):
            motor.wait_until_done(5)
        rig.runtime.run_for(0.02)
        with pytest.raises(MotorError, match="is active"):  # the motion continues
            motor.start()
        motor.wait_until_done(5)
        assert demand(rig) == pytest.approx(INC_PER_RAD, abs=1)
