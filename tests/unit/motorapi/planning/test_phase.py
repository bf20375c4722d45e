"""Phase synchronisation: the common profile, against its definition and ruckig."""

import pytest
from hypothesis import assume, event, example, given
from hypothesis import strategies as st

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.motorapi import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    LimitError,
    Motor,
    MotorGroup,
    MotorModel,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.execution import Started, plan
from motorhil.motorapi.generation import shortest
from motorhil.motorapi.planning.groups import Common, Move, proportional
from motorhil.motorapi.planning.path import line_of, moving, predicted
from motorhil.motorapi.synchronization.quality import FaultReaction, Synchronization
from tests.support.motors.plain import PlainBus, PlainHwMotor, PlainMotor

PHASE = Common(Synchronization.PHASE)
POSITIVE = st.floats(0.01, 100.0)
LIMITS = st.tuples(POSITIVE, POSITIVE, POSITIVE)
# A distance below 1e-100 counts as none: its square, used by every profile, vanishes.
WAY = st.floats(-50.0, 50.0).map(lambda way: way if abs(way) > 1e-100 else 0.0)
WAY |= st.sampled_from([0.0, 1e-12, -1e-100, 1e-9])
MEMBERS = st.lists(st.tuples(WAY, LIMITS), min_size=2, max_size=6)
STEPS = st.tuples(*[st.sampled_from([0.0, 1e-4, 1e-3, 0.01])] * 3)


def motors_of(limits, steps=None):
    runtime, bus = VirtualRuntime(EventQueue()), PlainBus()
    motors = []
    for node, (velocity, acceleration, deceleration) in enumerate(limits):
        position, speed, ramp = (0.0, 0.0, 0.0) if steps is None else steps[node]
        hardware = PlainHwMotor(
            *(runtime, node, bus),
            position_step=position,
            velocity_step=speed,
            acceleration_step=ramp,
        )
        model = MotorModel(
            name="plain",
            velocity_max=velocity,
            acceleration_max=acceleration,
            deceleration_max=deceleration,
        )
        motors.append(PlainMotor(hardware, model))
    return motors


def logical(motors):
    return [motor.logical for motor in motors]


def planned(motors, ways, common=PHASE, **options):
    for motor, way in zip(motors, ways, strict=True):
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(TrapezoidalTrajectory(way, **options))
    motions = plan(logical(motors), common)
    return [
        Started(motor.logical, motion, motor._quantise(motion))
        for motor, motion in zip(motors, motions, strict=True)
    ]


def profile(one):
    motion = one.quantised
    return shortest(motion.distance, motion.velocity, motion.acceleration, motion.deceleration)


@given(MEMBERS)
@example([(1.0, (2.0, 4.0, 4.0)), (-0.25, (0.1, 9.0, 1.0))])
def test_motors_cover_equal_fractions_at_every_instant(members):
    ways = [way for way, _ in members]
    found = planned(motors_of([limits for _, limits in members]), ways)
    going = moving(found)
    event(f"{len(going)} of {len(found)} move")
    assert {one.motor.name for one in found} - {one.motor.name for one in going} == {
        one.motor.name for one, way in zip(found, ways, strict=True) if way == 0.0
    }
    if not going:
        return
    duration_s = max(profile(one).duration_s for one in going)
    for one in going:
        assert one.motion.duration_s == pytest.approx(duration_s, rel=1e-9)  # one sum each
    for place in range(21):
        time_s = duration_s * place / 20
        parts = [profile(one).position(time_s) / one.motion.distance for one in going]
        assert max(parts) - min(parts) <= 1e-9
    for one, way in zip(found, ways, strict=True):
        assert one.motion.distance == way


@given(MEMBERS, st.lists(STEPS, min_size=6, max_size=6))
def test_rounded_profiles_exceed_no_limit(members, steps):
    motors = motors_of([limits for _, limits in members], steps)
    found = planned(motors, [w for w, _ in members])
    for motor, one in zip(motors, found, strict=True):
        model = motor.model
        made = one.quantised
        # A hardware step larger than the limit cannot be transmitted: refused elsewhere. 1e-11: the
        # hardware accepts values within floating-point error of a whole step.
        velocity_step, ramp_step = motor.hw.steps[1:]
        for value, limit, step in (
            (made.velocity, model.velocity_max, velocity_step),
            (made.acceleration, model.acceleration_max, ramp_step),
            (made.deceleration, model.deceleration, ramp_step),
            (one.motion.velocity, model.velocity_max, velocity_step),
        ):
            assert value <= max(limit * (1.0 + 1e-11), step)


@given(MEMBERS)
def test_common_profile_is_as_fast_as_one_motor_allows(members):
    """Check that any faster profile exceeds a limit: each bound is the limit of one motor."""
    moves = [Move(abs(way), *limits) for way, limits in members if way != 0.0]
    assume(moves)
    _, made = proportional(moves)
    for quantity in ("velocity", "acceleration", "deceleration"):
        used = [
            getattr(its, quantity) / getattr(move, quantity)
            for its, move in zip(made, moves, strict=True)
        ]
        assert max(used) == pytest.approx(1.0, rel=1e-12)


WAYS_TO_GO = st.lists(
    st.tuples(st.floats(0.01, 50.0), st.sampled_from([1.0, -1.0])).map(lambda way: way[0] * way[1]),
    min_size=2,
    max_size=6,
)
SYMMETRIC = st.tuples(POSITIVE, POSITIVE).map(lambda limits: (*limits, limits[1]))


@given(WAYS_TO_GO, st.lists(SYMMETRIC, min_size=6, max_size=6), st.booleans())
def test_common_duration_equals_that_of_ruckig(ways, limits, alike):
    """Compare with Ruckig 0.19.4, third derivative unlimited.

    If the profile of the slowest motor is within the limits of all, Ruckig uses it for all; no line
    is then faster. Otherwise its motors only end together, and a line is not faster. (For limits of
    the second derivative that differ by sign, it often finds no solution; so they do not differ
    here.)
    """
    ruckig = pytest.importorskip("ruckig")
    limits = [limits[0] if alike else one for one in limits[: len(ways)]]
    asked = ruckig.InputParameter(len(ways))
    asked.current_position = [0.0] * len(ways)
    asked.target_position = ways
    asked.max_velocity = [one[0] for one in limits]
    asked.max_acceleration = [one[1] for one in limits]
    asked.max_jerk = [float("inf")] * len(ways)
    asked.synchronization = ruckig.Synchronization.Phase
    theirs = ruckig.Trajectory(len(ways))
    try:
        assert ruckig.Ruckig(len(ways)).calculate(asked, theirs) == ruckig.Result.Working
    except ruckig.RuckigError:
        event("Ruckig finds no motion")  # its second step, in which all end together
        return
    ours_s, made = proportional([Move(abs(w), *one) for w, one in zip(ways, limits, strict=True)])
    instants = [part * theirs.duration for part in (0.1, 0.25, 0.6, 0.9)]
    parts = [
        [at / way for at, way in zip(theirs.at_time(t)[0], ways, strict=True)] for t in instants
    ]
    is_line = all(max(part) - min(part) < 1e-7 for part in parts)
    event(f"Ruckig's is a line: {is_line}")
    assert ours_s >= theirs.duration * (1.0 - 1e-7)  # accuracy of Ruckig: 1e-8 of a distance
    if not is_line:
        return
    assert ours_s <= theirs.duration * (1.0 + 1e-7)
    for t, part in zip(instants, parts, strict=True):
        for way, its in zip(ways, made, strict=True):
            own = shortest(its.way, its.velocity, its.acceleration, its.deceleration)
            assert own.position(t) / abs(way) == pytest.approx(part[0], abs=1e-6)


@given(MEMBERS, st.lists(STEPS, min_size=6, max_size=6))
def test_deviation_by_rounding_is_predicted(members, steps):
    """Measure the rounded profiles at 400 instants."""
    found = moving(
        planned(motors_of([limits for _, limits in members], steps), [w for w, _ in members])
    )
    assume(len(found) > 1)
    bound, line = predicted(found), line_of(found)
    duration_s = max(profile(one).duration_s for one in found)
    worst = [0.0] * len(found)
    for place in range(401):
        at = [
            one.quantised.start + profile(one).position(duration_s * place / 400) for one in found
        ]
        worst = [max(w, abs(off)) for w, off in zip(worst, line.deviations(at), strict=True)]
    for most, measured, one in zip(bound, worst, found, strict=True):
        rounding = 1e-12 * max(1.0, abs(one.quantised.distance))
        assert measured <= most + rounding
        event("met within 1 %" if measured >= 0.99 * most - rounding else "not met")


def test_zero_distances_alone_take_no_time():
    found = planned(motors_of([(1.0, 1.0, 1.0)] * 2), [0.0, 0.0])
    assert [one.motion.duration_s for one in found] == [0.0, 0.0]
    assert moving(found) == []


def test_requested_duration_holds_for_the_line():
    # By hand: 1 and 2 with 2 rad/s, 4 rad/s^2: as fast as the longer one: 2/2 + 2/4 = 1.5 s.
    motors = motors_of([(2.0, 4.0, 4.0)] * 2)
    found = planned(motors, [1.0, 2.0])
    assert [one.motion.duration_s for one in found] == [1.5, 1.5]
    assert [one.motion.velocity for one in found] == [1.0, 2.0]
    assert [one.motion.acceleration for one in found] == [2.0, 4.0]
    group = MotorGroup(*motors)
    group.set_trajectory(TrapezoidalTrajectory(1.0, duration_s=3.0), TrapezoidalTrajectory(-2.0))
    found = plan(logical(motors), PHASE)
    assert [motion.duration_s for motion in found] == [3.0, 3.0]
    # v' = (a T - sqrt(a^2 T^2 - 4 a D)) / 2 = (12 - sqrt(144 - 32)) / 2 for the longer one
    assert found[1].velocity == pytest.approx((12 - 112**0.5) / 2, rel=1e-12)
    assert found[0].velocity == pytest.approx(found[1].velocity / 2, rel=1e-12)
    group.set_trajectory(TrapezoidalTrajectory(1.0, duration_s=1.2), TrapezoidalTrajectory(-2.0))
    with pytest.raises(LimitError, match=r"m1: duration 1.2 s, allowed is at least 1.5.*of m0"):
        plan(logical(motors), PHASE)
    group.set_trajectory(
        TrapezoidalTrajectory(1.0, duration_s=2.0), TrapezoidalTrajectory(2.0, duration_s=3.0)
    )
    with pytest.raises(UsageError, match="durations differ"):
        plan(logical(motors), PHASE)


def test_command_limits_apply_to_the_line():
    motors = motors_of([(2.0, 4.0, 4.0)] * 2)
    for motor in motors:
        motor.set_control_mode(ControlMode.TRAJECTORY)
    motors[0].set_trajectory(TrapezoidalTrajectory(1.0, limits=DerivativeLimits(first=0.25)))
    motors[1].set_trajectory(TrapezoidalTrajectory(2.0))
    first, second = plan(logical(motors), PHASE)
    assert (first.velocity, second.velocity) == (0.25, 0.5)


def test_motion_without_a_scalable_profile_raises():
    motors = motors_of([(2.0, 4.0, 4.0)] * 2)
    motors[0].set_control_mode(ControlMode.TRAJECTORY)
    motors[0].set_trajectory(TrapezoidalTrajectory(1.0))
    motors[1].set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
    motors[1].set_setpoint(1.0)
    with pytest.raises(UnsupportedError, match=r"m1.*a setpoint of velocity in a phase-synchron"):
        plan(logical(motors), PHASE)


def test_reaction_together_without_a_path_raises():
    motors = motors_of([(2.0, 4.0, 4.0)] * 2)
    group = MotorGroup(*motors)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(1.0), TrapezoidalTrajectory(1.0))
    group.fault_reaction = FaultReaction.TOGETHER
    with pytest.raises(UsageError, match=r"stops along the common path.*synchronization is TIME"):
        group.start()
    group.synchronization = Synchronization.PHASE
    group.start()
    group.wait_until_done()


def test_rounded_limit_slows_the_whole_line():
    motors = motors_of([(2.0, 4.0, 4.0)] * 2, [(0.0, 0.0, 0.0), (0.0, 0.75, 0.0)])
    fine, coarse = planned(motors, [1.0, 3.0])
    # By hand: coarse has 1.5 of 2 rad/s, and fine a third of that, not of 2.
    assert (fine.motion.velocity, coarse.motion.velocity) == (0.5, 1.5)
    assert predicted([fine, coarse]) == pytest.approx([0.0, 0.0], abs=1e-12)  # floating point
