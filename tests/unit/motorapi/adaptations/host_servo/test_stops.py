"""Stops, holding, sharing and limits of central servo."""

import math
from collections.abc import Callable

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import MotionInterrupted, StateError, UnsupportedError
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.state import MotorState
from motorhil.motorapi.synchronization.quality import SyncLevel
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.support.motors.software_rigs import (
    ACCELERATION_MAX,
    INC_PER_RAD,
    INERTIA_A_S2_RAD,
    TORQUE_CONSTANT,
    VELOCITY_MAX,
    commanded,
    enabled,
    inc,
    motor,
    node,
    one,
    two,
)

OpenRig = Callable[..., Rig]
WINDOW = 10 / INC_PER_RAD


# --- stopping


def test_stop_uses_the_motions_deceleration_and_holds(open_rig: OpenRig):
    rig = open_rig(one())
    left = enabled(rig)
    commanded(left, ControlMode.TRAJECTORY, ControlVariable.POSITION, TrapezoidalTrajectory(3.0))
    rig.runtime.run_for(0.6)
    before = inc(rig) / INC_PER_RAD
    left.stop()
    left.wait_until_done(2)
    way = inc(rig) / INC_PER_RAD - before
    assert way == pytest.approx(VELOCITY_MAX**2 / (2 * ACCELERATION_MAX), abs=0.01)
    where = inc(rig)
    rig.runtime.run_for(1.0)
    assert abs(inc(rig) - where) <= 2
    assert left.state() is MotorState.ENABLED


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        (ControlVariable.POSITION, 3.0),
        (ControlVariable.VELOCITY, 2.5),
        (ControlVariable.CURRENT, 0.5),
    ],
)
@pytest.mark.parametrize("way", ["stop", "halt", "quick_stop"])
def test_set_point_is_stopped_from_any_state(
    open_rig: OpenRig, variable: ControlVariable, value: float, way: str
):
    rig = open_rig(one())
    left = enabled(rig)
    commanded(left, ControlMode.SETPOINT, variable, value)
    rig.runtime.run_for(0.15)
    assert left.velocity() > 1.0
    getattr(left, way)()
    left.wait_until_done(2)
    where = inc(rig)
    rig.runtime.run_for(0.5)
    assert abs(inc(rig) - where) <= 2
    stopped = MotorState.STOPPED if way == "quick_stop" else MotorState.ENABLED
    assert left.state() is stopped


def test_quick_stop_requires_enable_before_motion(open_rig: OpenRig):
    rig = open_rig(one())
    left = enabled(rig)
    commanded(left, ControlMode.TRAJECTORY, ControlVariable.POSITION, TrapezoidalTrajectory(3.0))
    rig.runtime.run_for(0.3)
    left.quick_stop()
    left.wait_until_done(2)
    with pytest.raises(StateError, match="quick stop"):
        left.start()
    left.enable()
    left.set_trajectory(TrapezoidalTrajectory(0.1))
    left.start()
    left.wait_until_done(2)


def test_stop_by_another_is_reported_to_the_waiter(open_rig: OpenRig):
    rig = open_rig(one(), motor("other", "io"))
    left, other = enabled(rig), rig.motors["other"]
    commanded(left, ControlMode.TRAJECTORY, ControlVariable.POSITION, TrapezoidalTrajectory(3.0))
    party = rig.runtime.spawn("stopper", lambda: (rig.runtime.run_for(0.2), other.stop())[1])
    with pytest.raises(MotionInterrupted, match=r"stop\(\) of other"):
        left.wait_until_done(5)
    assert party.join(1)


def test_disable_removes_current_and_last_one_ends_sync(open_rig: OpenRig):
    rig = open_rig(two())
    left, right = enabled(rig, "left"), enabled(rig, "right")
    left.disable()
    assert left.state() is MotorState.DISABLED
    rig.runtime.run_for(0.1)
    assert rig.controllers["io"].snapshot()["ready"] == 0.0
    assert left.hardware.node.bus.sync.period_ns == 1_000_000
    right.disable()
    rig.runtime.run_for(0.1)
    assert left.hardware.node.bus.sync.period_ns is None
    rig.controllers["io"].stimulate("load_torque_n_m", -3.0)
    rig.runtime.run_for(0.1)
    at = left.position()  # polled, as no cycle brings it
    assert at > 0.01
    assert left.velocity() > 0.1
    rig.controllers["io"].stimulate("load_torque_n_m", 0.0)
    rig.runtime.run_for(1.0)
    left.enable()
    commanded(left, ControlMode.TRAJECTORY, ControlVariable.POSITION, TrapezoidalTrajectory(-0.1))
    left.wait_until_done(1)


def test_enable_moves_nothing(open_rig: OpenRig):
    rig = open_rig(one())
    left = enabled(rig)
    rig.runtime.run_for(0.5)
    assert inc(rig) == 0
    assert left.position() == 0.0


@pytest.mark.parametrize("method", [None, 35, 37])
def test_homing_defines_position_0_and_moves_nothing(open_rig: OpenRig, method: int | None):
    rig = open_rig(one())
    left = enabled(rig)
    commanded(left, ControlMode.TRAJECTORY, ControlVariable.POSITION, TrapezoidalTrajectory(0.7))
    left.wait_until_done(2)
    rig.runtime.run_for(0.2)
    before = inc(rig)
    assert not left.is_referenced()
    left.home(method)
    rig.runtime.run_for(0.2)
    assert abs(inc(rig) - before) <= 2
    assert left.is_referenced()
    assert abs(left.position()) <= WINDOW
    commanded(left, ControlMode.SETPOINT, ControlVariable.POSITION, 0.0)
    left.wait_until_done(1)
    assert abs(inc(rig) - before) <= 10
    with pytest.raises(UnsupportedError, match="homing by method 17; it supports 35 and 37"):
        left.home(17)


def test_motor_with_reversed_counter_works_the_same(open_rig: OpenRig):
    rig = open_rig(one(increments=-INC_PER_RAD))
    left = enabled(rig)
    commanded(left, ControlMode.TRAJECTORY, ControlVariable.POSITION, TrapezoidalTrajectory(0.5))
    left.wait_until_done(2)
    assert inc(rig) == pytest.approx(-0.5 * INC_PER_RAD, abs=10)
    assert left.position() == pytest.approx(0.5, abs=WINDOW)
    commanded(left, ControlMode.SETPOINT, ControlVariable.CURRENT, 1.0)
    rig.runtime.run_for(0.02)
    assert left.velocity() > 0.1
    left.stop()
    left.wait_until_done(1)


# --- sharing and groups


def test_gains_belong_to_a_logical_motor_and_apply_at_start(open_rig: OpenRig):
    rig = open_rig(one(), motor("slow", "io", bandwidth=20.0))
    left, slow = rig.motors["left"], rig.motors["slow"]
    assert left.hardware is slow.hardware
    servo = left.hardware.servo
    left.enable()
    for chosen in (left, slow, left):
        chosen.set_control_mode(ControlMode.TRAJECTORY)
        chosen.set_trajectory(TrapezoidalTrajectory(0.1))
        before = servo._gains
        chosen.gains = chosen.gains  # local: without effect yet
        assert servo._gains is before
        chosen.start()
        assert servo._gains == chosen.gains.per_increment(INC_PER_RAD)
        chosen.wait_until_done(2)


def test_group_of_two_begins_with_one_sync(open_rig: OpenRig):
    """On two nodes: the first nonzero outputs are before the same SYNC on the wire."""
    rig = open_rig(
        node("a", 1),
        node("b", 2),
        motor("left", "a", friction=1.0, motor="amplifier_tick_ms = 0.25"),
        motor("right", "b", friction=1.0, motor="amplifier_tick_ms = 0.25"),
    )
    left, right = enabled(rig, "left"), enabled(rig, "right")
    rig.runtime.run_for(0.1)
    wire: list[tuple[int, int]] = []

    def on_frame(bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        can_id = int.from_bytes(frame[:4], "little")
        if can_id in (0x080, 0x301, 0x302):
            wire.append((can_id, int.from_bytes(frame[8:10], "little", signed=True)))

    group = MotorGroup(left, right)
    offers = group.sync_capability
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(0.5), TrapezoidalTrajectory(-1.0))
    capability = offers()
    assert capability.level is SyncLevel.CYCLIC
    assert (capability.command_skew_s, capability.start_skew_s) == (0.0, 0.000_25)
    rig.world.tap_frames(on_frame)
    group.start()
    group.wait_until_done(3)
    quality = group.sync_quality()
    assert quality.start_skew_s == 0.0
    assert quality.end_skew_s < 0.02  # their settling differs
    syncs = [place for place, (can_id, _) in enumerate(wire) if can_id == 0x080]
    first = {
        can_id: next(
            place for place, (other, raw) in enumerate(wire) if other == can_id and abs(raw) > 1000
        )
        for can_id in (0x301, 0x302)
    }
    cycles = {can_id: sum(sync < place for sync in syncs) for can_id, place in first.items()}
    assert cycles[0x301] == cycles[0x302]
    assert left.position() == pytest.approx(0.5, abs=WINDOW)
    assert right.position() == pytest.approx(-1.0, abs=WINDOW)


def test_four_motors_of_one_node_move_at_once(open_rig: OpenRig):
    names = ["a", "b", "c", "d"]
    motors = [motor(name, "io", channel) for channel, name in enumerate(names, 1)]
    rig = open_rig(node("io", 1, 4), *motors)
    group = MotorGroup(*(rig.motors[name] for name in names))
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(*(TrapezoidalTrajectory(0.2 * k) for k in (1, -2, 3, -4)))
    group.start()
    group.wait_until_done(3)
    assert group.sync_quality().start_skew_s == 0.0
    for k, channel in zip((1, -2, 3, -4), (1, 2, 3, 4), strict=True):
        assert inc(rig, channel=channel) / INC_PER_RAD == pytest.approx(0.2 * k, abs=WINDOW)
    assert group[0].hardware.report().missed == 0


def test_motor_at_rest_does_not_oscillate(open_rig: OpenRig):
    rig = open_rig(one())
    left = enabled(rig)
    commanded(
        left, ControlMode.TRAJECTORY, ControlVariable.POSITION, TrapezoidalTrajectory(0.1234567)
    )
    left.wait_until_done(2)
    rig.runtime.run_for(0.5)
    seen = set()
    rig.runtime.every(0.001, lambda: seen.add(inc(rig)))
    rig.runtime.run_for(10.0)
    assert len(seen) == 1


def test_load_is_compensated_by_the_integral(open_rig: OpenRig):
    rig = open_rig(one())
    left = enabled(rig)
    rig.controllers["io"].stimulate("load_torque_n_m", 3.0)
    rig.runtime.run_for(1.0)
    assert abs(inc(rig)) <= 1
    load_a = 3.0 / TORQUE_CONSTANT
    assert left.hardware.servo.current_a == pytest.approx(load_a, abs=0.3)  # friction holds some


def test_model_current_and_torque_limit_the_output(open_rig: OpenRig):
    blocked = "[controller.io.plant]\npreset = 'wheel_60w'\ncoulomb_friction_n_m = 9\n"
    for model, most in (("current_max_a = 1.5", 1.5), ("torque_max_n_m = 4.0", 2.34), ("", 8.0)):
        with open_rig(one(model=model), blocked) as rig:
            left = enabled(rig)
            commanded(left, ControlMode.SETPOINT, ControlVariable.POSITION, 1.0)
            rig.runtime.run_for(0.2)
            now_a = rig.controllers["io"].snapshot()["current_a"]
            assert now_a == pytest.approx(most, abs=0.001)


def test_reading_and_repr_help_at_a_prompt(open_rig: OpenRig):
    rig = open_rig(one())
    left = rig.motors["left"]
    assert repr(left) == "<SoftwareMotor 'left' on can0 node 1 channel 1>"
    left.enable()
    assert repr(left) == "<SoftwareMotor 'left' on can0 node 1 channel 1: enabled, 0 rad>"
    assert repr(left.hardware) == "<AmplifierHwMotor can0 node 1 channel 1: enabled>"
    assert str(left.cycles).endswith("cycles of 1 ms, none missed")
    assert left.gains.kd == pytest.approx(3 * 60 * INERTIA_A_S2_RAD)
    assert math.isclose(left.following_error(), 0.0)
