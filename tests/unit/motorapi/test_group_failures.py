from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DeadlineExceeded,
    DeviceFault,
    LimitError,
    LinkError,
    MotionInterrupted,
    Motor,
    MotorGroup,
    PeerError,
    StateError,
    Synchronization,
    SyncLevel,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from tests.support.motors.plain import MODEL, PlainBus, PlainHwMotor, PlainMotor, fault_now
from tests.unit.motorapi.test_group import group_of, hooks

TRAJECTORY = ControlMode.TRAJECTORY


@pytest.mark.parametrize("hook", ["_enable", "_arm"])
@pytest.mark.parametrize("place", [0, 1])
def test_refusal_of_one_motor_keeps_all_at_rest(pair, hook, place):
    pair[place].hw.fail[hook] = PeerError("refused")
    group = group_of(pair, 1.0, 2.0)
    with pytest.raises(PeerError) as caught:
        group.start()
    assert pair[0].hw.bus.fired == 0
    assert all(motor.hw.armed is None and motor.hw.motion is None for motor in pair)
    if hook == "_arm":
        assert f"from m{place + 1}, motor {place + 1} of 2" in caught.value.__notes__
        assert [hooks(motor)[-1] for motor in pair[: place + 1]] == ["_disarm"] * (place + 1)
    del pair[place].hw.fail[hook]
    group.start()
    group.wait_until_done()


def test_limit_of_one_motor_keeps_all_at_rest(runtime, pair):
    tight = PlainMotor(PlainHwMotor(runtime, 3), replace(MODEL, position_max=1.0), name="tight")
    with pytest.raises(LimitError, match="tight"):
        group_of([*pair, tight], 1.0, 1.0, 1.1).start()
    assert all(hooks(motor) == [] for motor in [*pair, tight])


@pytest.mark.parametrize("place", [0, 1])
def test_failed_begin_of_one_motor_stops_all(pair, place):
    pair[place].hw.fail["_confirm"] = PeerError("no acknowledge")
    with pytest.raises(PeerError) as caught:
        group_of(pair, 1.0, 2.0).start()
    assert f"from m{place + 1}, motor {place + 1} of 2" in caught.value.__notes__
    for motor in pair:
        assert hooks(motor)[-2:] == ["_stop", "_disarm"]
        assert motor.hw.motion is None
        with pytest.raises(MotionInterrupted, match="failed start"):
            motor.wait_until_done()


def test_failed_trigger_stops_all(pair):
    pair[0].hw.bus.fire_error = LinkError(link="bus0", reason="bus off")
    with pytest.raises(LinkError):
        group_of(pair, 1.0, 2.0).start()
    assert all(hooks(motor)[-2:] == ["_stop", "_disarm"] for motor in pair)


def test_failed_stop_is_noted_and_the_others_are_stopped(pair):
    pair[1].hw.fail["_confirm"] = PeerError("no acknowledge")
    pair[0].hw.fail["_stop"] = LinkError(link="bus0", reason="gone")
    with pytest.raises(PeerError) as caught:
        group_of(pair, 1.0, 2.0).start()
    assert any("m1 could not be stopped" in note for note in caught.value.__notes__)
    assert "_stop" in hooks(pair[1])


def test_fault_in_one_motor_stops_the_others_and_is_raised(runtime, pair):
    group = group_of(pair, 1.0, 3.0)
    group.start()
    runtime.spawn("trouble", lambda: (runtime.run_for(0.5), fault_now(pair[0].hw)))
    with pytest.raises(DeviceFault) as caught:
        group.wait_until_done()
    assert caught.value.motor == "m1"
    assert "from m1; the others of its group were stopped" in caught.value.__notes__
    assert hooks(pair[1])[-1] == "_stop"
    assert pair[1].velocity() == 0.0


def test_group_timeout_names_motors_that_are_not_done(pair):
    motor1, motor2 = pair
    group = MotorGroup(motor1, motor2)
    motor1.set_control_mode(ControlMode.SETPOINT)
    motor1.set_setpoint(0.1)
    motor2.set_control_mode(TRAJECTORY)
    motor2.set_trajectory(TrapezoidalTrajectory(3.0))
    group.start()
    with pytest.raises(DeadlineExceeded, match="end of motion of m2: did not") as caught:
        group.wait_until_done(timeout_s=1.0)
    assert "m1" not in caught.value.last_heard
    assert not group.is_done()
    assert hooks(motor2)[-1] == "_confirm"  # nothing was stopped
    group.wait_until_done()
    assert group.is_done()


def test_stop_tries_every_motor_and_then_raises(pair):
    group = group_of(pair, 1.0, 2.0)
    group.start()
    pair[0].hw.fail["_stop"] = LinkError(link="bus0", reason="gone")
    with pytest.raises(LinkError) as caught:
        group.stop()
    assert caught.value.__notes__ == ["from m1"]
    assert hooks(pair[1])[-1] == "_stop"
    del pair[0].hw.fail["_stop"]
    for stop in (group.stop, group.halt, group.quick_stop):
        stop()
        group.wait_until_done()


@pytest.mark.parametrize(
    ("refused", "kind"),
    [
        ((TrapezoidalTrajectory(5.0),), UsageError),
        ((TrapezoidalTrajectory(5.0), TrapezoidalTrajectory(5.0, duration_s=0.1)), LimitError),
    ],
)
def test_refused_trajectories_leave_nothing_to_start(pair, refused, kind):
    group = group_of(pair, 1.0, 2.0)
    group.start()
    group.wait_until_done()
    with pytest.raises(kind):
        group.set_trajectory(*refused)
    for start in (group.start, pair[0].start, pair[1].start):
        with pytest.raises(StateError, match="there is nothing to start"):
            start()
    assert [motor.position() for motor in pair] == [1.0, 2.0]
    group.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(2.0))
    group.start()
    group.wait_until_done()
    assert [motor.position() for motor in pair] == [2.0, 4.0]


def test_members_are_unique_devices_of_one_runtime(runtime, pair):
    motor1, motor2 = pair
    group = MotorGroup(motor1)
    with pytest.raises(UsageError, match="in the group already"):
        group.append(motor1)
    with pytest.raises(UsageError, match="same physical motor, bus0 node 1"):
        group.append(PlainMotor(motor1.hw, name="alias"))
    with pytest.raises(UsageError, match="named m1"):
        group.append(PlainMotor(PlainHwMotor(runtime, 7), name="m1"))
    elsewhere = VirtualRuntime(EventQueue())
    with pytest.raises(UsageError, match="different runtimes"):
        group.append(PlainMotor(PlainHwMotor(elsewhere, 8)))
    group.append(motor2)
    assert list(group) == [motor1, motor2]
    assert (len(group), group[1]) == (2, motor2)
    assert repr(group) == "<MotorGroup of 2: m1, m2>"
    group.remove(motor1)
    assert list(group) == [motor2]
    with pytest.raises(UsageError, match="not in the group"):
        group.remove(motor1)
    group.remove(motor2)
    for refused in (group.start, group.wait_until_done, group.sync_capability):
        with pytest.raises(UsageError, match="empty"):
            refused()


def test_for_each_returns_all_results_and_names_the_failure(pair):
    group = MotorGroup(*pair)
    assert group.for_each(Motor.position) == [0.0, 0.0]
    with pytest.raises(UnsupportedError) as caught:
        group.for_each(Motor.set_control_mode, TRAJECTORY, variable=ControlVariable.TORQUE)
    assert caught.value.__notes__ == ["from m1, member 1 of 2"]


def test_capability_of_one_trigger_is_bounded_by_latencies(runtime):
    bus = PlainBus()
    motors = [
        PlainMotor(PlainHwMotor(runtime, node, bus, latency_s=latency_s))
        for node, latency_s in ((1, 0.001), (2, 0.003))
    ]
    group = MotorGroup(*motors)
    capability = group.sync_capability()
    assert capability.level is SyncLevel.TRIGGERED
    assert capability.start_skew_s == pytest.approx(0.002, abs=1e-15)
    assert capability.end_skew_s is None  # nothing is set yet
    group.for_each(Motor.set_control_mode, TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(2.0))
    # Equal durations: the later begin causes the later end.
    assert group.sync_capability().end_skew_s == pytest.approx(0.002, abs=1e-12)
    group.start()
    group.wait_until_done()
    assert group.sync_quality().start_skew_s == 0.002
    assert all(motor.hw.log[0][0] == "_enable" for motor in motors)  # the query moved nothing


def test_capability_of_two_triggers_is_sequential_with_reason(runtime, pair):
    other = PlainMotor(PlainHwMotor(runtime, 3, PlainBus("bus1")))
    capability = MotorGroup(*pair, other).sync_capability()
    assert capability.level is SyncLevel.SEQUENTIAL
    assert capability.start_skew_s is None
    assert capability.weakest == "m3"
    assert "bus1" in capability.reason


def test_quality_before_a_start_raises_and_until_end_unknown(runtime, pair):
    """Query the quality without a wait: a group supervises its motors by itself."""
    group = group_of(pair, 1.0, 2.0)
    with pytest.raises(UsageError, match="not been started"):
        group.sync_quality()
    group.start()
    assert group.sync_quality().end_skew_s is None
    runtime.run_for(5.0)
    assert group.sync_quality().end_skew_s == 0.0
    assert [name for name, _ in group.sync_quality().times] == ["m1", "m2"]


def test_two_groups_of_one_trigger_do_not_start_each_other(runtime):
    bus = PlainBus()
    motors = [PlainMotor(PlainHwMotor(runtime, node, bus, acts_s=0.01)) for node in range(5)]
    groups = [group_of(motors[:2], 1.0, 1.0), group_of(motors[2:], 1.0, 1.0, 1.0)]

    for motor in motors:
        motor.enable()  # so that arming happens at the same time

    def run(group):
        for _ in range(5):
            group.start()
            assert group.sync_quality().start_skew_s == 0.0
            group.wait_until_done(timeout_s=10)

    parties = [runtime.spawn(f"p{k}", lambda k=k: run(groups[k])) for k in range(2)]
    for party in parties:
        assert party.join(timeout_s=100)
        assert party.error is None
    assert bus.fired == 10


@pytest.mark.parametrize("timeout_s", [-1.0, float("nan")])
def test_timeout_must_be_a_number_of_seconds(pair, timeout_s):
    motor = pair[0]
    with pytest.raises(UsageError, match="timeout_s"):
        motor.wait_until_done(timeout_s)
    with pytest.raises(UsageError, match="timeout_s"):
        MotorGroup(*pair).wait_until_done(timeout_s)
    motor.wait_until_done(float("inf"))


def test_replaceable_set_point_is_not_rest_for_other_members(pair):
    group = group_of(pair, 1.0, 2.0)
    group.start()
    with pytest.raises(StateError, match="is active"):
        group.start()


WAYS = st.lists(st.floats(-20.0, 20.0).map(lambda way: round(way, 3)), min_size=2, max_size=5)
STEPS = st.tuples(*[st.sampled_from([0.0, 0.001, 0.01])] * 3)


@given(WAYS, st.lists(STEPS, min_size=5, max_size=5))
def test_rounding_separates_ends_as_predicted(ways, steps):
    """Round each motion to hardware units, and measure the ends on the rounded profiles."""
    runtime = VirtualRuntime(EventQueue())
    bus = PlainBus()
    motors = []
    for node, (position, velocity, acceleration) in enumerate(steps[: len(ways)]):
        hardware = PlainHwMotor(
            *(runtime, node, bus),
            position_step=position,
            velocity_step=velocity,
            acceleration_step=acceleration,
        )
        hardware.polled_s = 1e-6 if node == 0 else None
        motors.append(PlainMotor(hardware))
    group = group_of(motors, *ways)
    group.start()
    quality = group.sync_quality()
    profiles = [motor.hw.profile() for motor in motors]
    ends_s = [profile.duration_s for profile in profiles if profile.duration_s]  # others stay
    measured_s = max(ends_s) - min(ends_s) if ends_s else 0.0
    assert quality.predicted_end_skew_s == pytest.approx(measured_s, abs=1e-9)
    for profile in profiles:
        assert profile.peak <= 2.0
    # No motor exceeds its limit, and the group is not slower than its slowest rounded member.
    if ends_s and all(step == (0.0, 0.0, 0.0) for step in steps[: len(ways)]):
        assert measured_s <= 1e-9


def test_stop_of_one_motor_stops_others_only_in_a_group_wait(runtime, pair):
    group = group_of(pair, 1.0, 3.0)
    group.start()
    runtime.run_for(0.5)
    pair[0].stop()
    runtime.run_for(0.5)
    assert hooks(pair[1])[-1] == "_confirm"  # still active
    assert group.sync_quality().end_skew_s is None
    runtime.run_for(2.0)
    assert pair[1].position() == 3.0

    group.start()  # again
    alias = PlainMotor(pair[0].hw, name="alias")
    runtime.spawn("stopper", lambda: (runtime.run_for(0.5), alias.stop()))
    with pytest.raises(MotionInterrupted, match=r"m1.*ended by stop\(\) of alias") as caught:
        group.wait_until_done()
    assert "from m1; the others of its group were stopped" in caught.value.__notes__
    assert hooks(pair[1])[-1] == "_stop"
    with pytest.raises(MotionInterrupted, match=r"m2.*fault reaction of its group \(m1"):
        pair[1].wait_until_done()


def test_fault_without_a_waiter_stops_the_others_once(runtime, pair):
    group = group_of(pair, 1.0, 3.0)
    group.start()
    runtime.run_for(0.5)
    fault_now(pair[0].hw)
    assert hooks(pair[1])[-1] == "_confirm"
    runtime.run_for(0.02)  # without a change counter, it is examined every 10 ms
    assert hooks(pair[1])[-1] == "_stop"
    for ask in (group.wait_until_done, group.is_done, group.is_done):
        with pytest.raises(DeviceFault) as caught:
            ask()
        assert caught.value.__notes__ == ["from m1; the others of its group were stopped"]
    assert hooks(pair[1]).count("_stop") == 1


def test_failed_stop_is_reported_to_every_caller(runtime, pair, caplog):
    group = group_of(pair, 1.0, 3.0)
    group.start()
    pair[1].hw.fail["_stop"] = LinkError(link="bus0", reason="gone")
    runtime.run_for(0.5)
    fault_now(pair[0].hw)
    runtime.run_for(0.02)
    assert "m2 could not be stopped after m1: fault 7500h" in caplog.text
    with pytest.raises(DeviceFault) as caught:
        group.is_done()
    assert "but m2 could not be stopped: bus0: gone" in caught.value.__notes__


def test_new_start_or_stop_clears_earlier_failures(runtime, pair):
    group = group_of(pair, 1.0, 3.0)
    group.start()
    runtime.run_for(0.5)
    group.stop()
    fault_now(pair[0].hw)
    runtime.run_for(0.1)
    assert hooks(pair[1]).count("_stop") == 1  # by the group itself
    pair[0].reset_fault()
    group.start()
    group.wait_until_done()


def test_start_without_synchronisation_is_fastest_for_each(runtime, pair):
    group = group_of(pair, 1.0, 3.0)
    group.synchronization = Synchronization.NONE
    group.start()
    # By hand, at 2 and 4: 1 is a triangle of 1 s, 3 takes 2 s.
    assert [motor.hw.profile().duration_s for motor in pair] == [1.0, 2.0]
    group.wait_until_done()
    group.set_trajectory(
        TrapezoidalTrajectory(1.0, duration_s=4.0), TrapezoidalTrajectory(1.0, duration_s=5.0)
    )
    group.start()
    assert [motor.hw.profile().duration_s for motor in pair] == pytest.approx([4.0, 5.0], rel=1e-12)
    for name in ("synchronization", "fault_reaction"):
        with pytest.raises(UsageError, match=name):
            setattr(group, name, "phase")


def test_takeover_of_one_motor_fails_its_group(runtime, pair):
    group = group_of(pair, 1.0, 3.0)
    group.start()
    runtime.run_for(0.5)
    rescue = PlainMotor(pair[0].hw, name="rescue")
    with rescue.reserve("rescue", take_over=True):
        assert hooks(pair[1])[-1] == "_stop"
    with pytest.raises(MotionInterrupted, match="took the motor over") as caught:
        group.wait_until_done()
    assert caught.value.motor == "m1"
