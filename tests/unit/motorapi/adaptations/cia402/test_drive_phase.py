"""Straight lines as drives round them, in position, velocity and ramps."""

from hypothesis import event, example, given, settings
from hypothesis import strategies as st

from motorhil.motorapi import ControlMode, Motor, Synchronization, TrapezoidalTrajectory
from motorhil.motorapi.execution import Started, plan
from motorhil.motorapi.planning.groups import Common
from motorhil.motorapi.planning.path import Line, moving, predicted
from tests.support.motors.kinds import ACCELERATION_MAX, VELOCITY_MAX
from tests.support.motors.wheels import INCREMENT_RAD
from tests.unit.motorapi.adaptations.canopen.test_joint_stop import opened

WAYS = st.lists(
    st.floats(-20.0, 20.0)
    | st.floats(-1e-3, 1e-3)
    | st.sampled_from([0.0, INCREMENT_RAD, -INCREMENT_RAD, 0.4 * INCREMENT_RAD]),
    min_size=3,
    max_size=3,
)


def test_rounded_line_keeps_limits_and_five_increments():
    """Three increments at most were found in thousands of lines.

    The drive's velocities are rounded down, and its ramps flattened to fit the duration.
    """
    with opened(3) as (_, group):
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        group.synchronization = Synchronization.PHASE
        group.for_each(Motor.enable)
        motors = list(group)

        @settings(max_examples=200)
        @given(WAYS)
        @example([20.0, INCREMENT_RAD, 0.0])
        @example([0.004, 20.0, 0.0009266827130455925])
        def check(ways):
            group.set_trajectory(*map(TrapezoidalTrajectory, ways))
            motions = plan([m.logical for m in motors], Common(Synchronization.PHASE))
            going = moving(
                [
                    Started(m.logical, motion, m._quantise(motion))
                    for m, motion in zip(motors, motions, strict=True)
                ]
            )
            event(f"{len(going)} move")
            for one in going:
                made = one.quantised
                assert made.velocity <= VELOCITY_MAX
                assert made.acceleration <= ACCELERATION_MAX
                assert made.deceleration <= ACCELERATION_MAX
            if len(going) > 1:
                assert max(predicted(going)) <= 5 * INCREMENT_RAD

        check()


@settings(max_examples=8)
@given(st.lists(st.floats(0.01, 2.0), min_size=3, max_size=3))
def test_demands_deviate_from_the_line_as_predicted(ways):
    """Velocities have a resolution of 0.1 rad/s, so that there is a deviation to predict.

    Demands are also rounded to an increment at each tick. As the ticks of all drives are
    simultaneous, there is no other deviation.
    """
    with opened(3, velocity_unit_inc=2000) as (rig, group):
        group.for_each(Motor.enable)
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        group.synchronization = Synchronization.PHASE
        group.set_trajectory(*map(TrapezoidalTrajectory, ways))
        told = [one.predicted for one in group.sync_capability().path]
        names = [motor.name for motor in group]
        seen = []

        def look():
            truths = [rig.controllers[name].snapshot()["demand_inc"] for name in names]
            seen.append([inc * INCREMENT_RAD for inc in truths])

        look()
        group.start()
        rig.runtime.every(0.001, look)
        group.wait_until_done(timeout_s=10)
        line = Line(
            tuple(seen[0]), tuple(b - a for a, b in zip(seen[0], seen[-1], strict=True)), (2.0,) * 3
        )
        worst = [0.0] * 3
        for row in seen:
            worst = [max(w, abs(off)) for w, off in zip(worst, line.deviations(row), strict=True)]
        for most, found in zip(told, worst, strict=True):
            assert 0.9 * most - 1.5 * INCREMENT_RAD <= found <= most + 1.5 * INCREMENT_RAD
        event("further than an increment" if max(told) > INCREMENT_RAD else "nearer")


def test_rounding_again_of_an_equal_motion_computes_nothing():
    with opened(1) as (_, group):
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        (motor,) = group
        near, far = (TrapezoidalTrajectory(way, initial=0.0) for way in (1.0, 2.0))
        made = []
        for trajectory in (near, far, near, far):
            motor.set_trajectory(trajectory)
            made.append(motor._quantise(plan([motor.logical])[0]))
        assert made[0] is made[2]
        assert made[1] is made[3]
        assert made[0] != made[1]
