import pytest

from motorhil.motorapi import (
    ControlMode,
    LimitError,
    Motor,
    MotorGroup,
    TrapezoidalTrajectory,
    UsageError,
)
from tests.support.motors.plain import PlainBus, PlainHwMotor, PlainMotor

TRAJECTORY = ControlMode.TRAJECTORY


def group_of(motors, *distances, **options):
    group = MotorGroup(*motors)
    group.for_each(Motor.set_control_mode, TRAJECTORY)
    group.set_trajectory(*(TrapezoidalTrajectory(way, **options) for way in distances))
    return group


def hooks(motor):
    return [entry[0] for entry in motor.hw.log]


def test_for_each_requires_a_callable(pair):
    with pytest.raises(
        UsageError, match=r"^for_each\('enable'\): not callable; give a method, as Motor.enable"
    ):
        MotorGroup(*pair).for_each("enable")


def test_algorithm_2_begins_and_ends_together(pair):
    motor1, motor2 = pair
    group = MotorGroup(motor1, motor2)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(2.0))
    group.start()
    group.wait_until_done()
    assert [motor.position() for motor in group] == [1.0, 2.0]
    quality = group.sync_quality()
    assert quality.start_skew_s == 0.0
    assert quality.end_skew_s == 0.0  # of the same poll
    assert quality.predicted_end_skew_s < 1e-12


def test_group_is_as_fast_as_its_slowest_motor(runtime, pair):
    group = group_of(pair, 1.0, 3.0)
    group.start()
    began_ns = runtime.now_ns()
    group.wait_until_done()
    # By hand: 3 at limits 2 and 4 takes 2 s; 1 alone would take 1 s.
    assert 2.0e9 <= runtime.now_ns() - began_ns <= 2.001e9
    # 1 in 2 s with 4: v' = (8 - sqrt(64 - 16)) / 2 = 0.5359
    assert pair[0].hw.motion.velocity == pytest.approx(0.5358983848622456, rel=1e-12)
    assert pair[1].hw.motion.velocity == 2.0


def test_duration_of_one_motor_holds_for_all(runtime, pair):
    group = MotorGroup(*pair)
    group.for_each(Motor.set_control_mode, TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(1.0, duration_s=4.0), TrapezoidalTrajectory(2.0))
    group.start()
    began_ns = runtime.now_ns()
    group.wait_until_done()
    assert 4.0e9 <= runtime.now_ns() - began_ns <= 4.001e9
    assert group.sync_quality().predicted_end_skew_s < 1e-9
    group.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(0.0, duration_s=3.0))
    group.start()
    began_ns = runtime.now_ns()
    group.wait_until_done()
    assert 3.0e9 <= runtime.now_ns() - began_ns <= 3.001e9


def test_common_duration_is_that_of_the_slowest_rounded_motor(runtime):
    bus = PlainBus()
    fine = PlainMotor(PlainHwMotor(runtime, 1, bus))
    coarse = PlainMotor(PlainHwMotor(runtime, 2, bus, velocity_step=0.75))
    # By hand: coarse has 1.5 of 2 rad/s: 3 rad in 3 / 1.5 + 1.5 / 4 = 2.375 s, not in 2 s.
    group = group_of([fine, coarse], 1.0, 3.0)
    group.start()
    assert coarse.hw.motion.velocity == 1.5
    assert coarse.hw.profile().duration_s == 2.375
    assert fine.hw.profile().duration_s == pytest.approx(2.375, rel=1e-12)
    assert group.sync_quality().predicted_end_skew_s < 1e-12


@pytest.mark.parametrize("excess", [k * 1e-12 for k in range(20)])
def test_slowest_motor_is_not_slowed_again_by_rounding(runtime, excess):
    # Nearly a triangle: there the peak for a duration is ill-conditioned.
    bus = PlainBus()
    fine = PlainMotor(PlainHwMotor(runtime, 1, bus))
    coarse = PlainMotor(PlainHwMotor(runtime, 2, bus, velocity_step=0.75))
    group_of([fine, coarse], 0.1, 0.5625 * (1.0 + excess)).start()
    assert coarse.hw.motion.velocity == 1.5


def test_contradictory_durations_raise(pair):
    group = MotorGroup(*pair)
    group.for_each(Motor.set_control_mode, TRAJECTORY)
    group.set_trajectory(
        TrapezoidalTrajectory(1.0, duration_s=4.0), TrapezoidalTrajectory(2.0, duration_s=5.0)
    )
    with pytest.raises(UsageError, match="4 s for m1, 5 s for m2"):
        group.start()
    group.set_trajectory(TrapezoidalTrajectory(0.5, duration_s=1.0), TrapezoidalTrajectory(3.0))
    with pytest.raises(LimitError, match=r"m2: duration 1 s, allowed is at least 2 s.*m1"):
        group.start()
    assert all(motor.hw.motion is None for motor in pair)


def test_motor_at_its_target_does_not_delay_the_others(runtime, pair):
    group = group_of(pair, 0.0, 3.0)
    group.start()
    group.wait_until_done()
    assert 2.0e9 <= runtime.now_ns() <= 2.001e9
    assert group.sync_quality().predicted_end_skew_s == 0.0


def test_all_are_armed_before_the_trigger_is_fired_once(pair):
    bus = pair[0].hw.bus
    order = []
    for motor in pair:
        act = motor.hw.act
        motor.hw.act = lambda name, *facts, act=act, motor=motor: (
            order.append((motor.name, name, bus.fired)),
            act(name, *facts),
        )
    group_of(pair, 1.0, 2.0).start()
    assert order == [
        *[("m1", "_enable", 0), ("m2", "_enable", 0)],
        *[("m1", "_arm", 0), ("m2", "_arm", 0)],
        *[("m1", "_confirm", 1), ("m2", "_confirm", 1)],
    ]
    assert [entry for motor in pair for entry in motor.hw.log if entry[0] == "_arm"] == [
        ("_arm", True),
        ("_arm", True),
    ]


def test_each_trigger_is_fired_once_in_the_order_of_motors(runtime):
    buses = [PlainBus("bus0"), PlainBus("bus1")]
    fired = []
    for bus in buses:
        fire = bus.fire
        bus.fire = lambda bus=bus, fire=fire: (fired.append(bus.name), fire())
    motors = [
        PlainMotor(PlainHwMotor(runtime, node, buses[bus]))
        for node, bus in ((1, 1), (2, 0), (3, 1))
    ]
    group_of(motors, 1.0, 1.0, 1.0).start()
    assert fired == ["bus1", "bus0"]
