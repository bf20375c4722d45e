"""Integers of a motion in a drive, and its exact duration."""

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from motorhil.motorapi.adaptations.cia402.profile import (
    DriveLimits,
    as_motion,
    check_limits,
    check_target,
    profile_of,
)
from motorhil.motorapi.adaptations.cia402.units import DriveUnits
from motorhil.motorapi.commands import ControlMode, ControlVariable, DerivativeLimits
from motorhil.motorapi.errors import LimitError
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.planning import single_axis as planning
from motorhil.motorapi.trajectory import TrapezoidalTrajectory

MODEL = MotorModel(name="wheel", velocity_max=3.0, acceleration_max=9.0, deceleration_max=6.0)
NO_LIMITS = DriveLimits(None, None, None, None, None, has_deceleration=True)
COARSE = DriveUnits("wheel", "rad", 1000.0, 0.01, 0.1, ("", "", ""))


def trajectory(distance: float, duration_s: float | None = None, start: float = 0.0) -> Motion:
    asked = TrapezoidalTrajectory(distance, duration_s=duration_s)
    return planning.plan_trajectory("wheel", MODEL, ControlVariable.POSITION, asked, start)


def test_set_point_is_rounded_down_to_the_drives_steps():
    motion = Motion(ControlMode.SETPOINT, ControlVariable.POSITION, 0.0, 1.0004, 2.999, 8.99, 5.99)
    profile = profile_of(motion, MODEL, COARSE, NO_LIMITS)
    assert (profile.target, profile.speed) == (1000, 299)
    assert (profile.acceleration, profile.deceleration) == (89, 59)
    made = as_motion(motion, profile, COARSE)
    assert made.target == 1.0
    assert made.duration_s is None


def test_drive_without_6084h_has_equal_ramps():
    limits = DriveLimits(None, None, None, None, None, has_deceleration=False)
    profile = profile_of(trajectory(1.0), MODEL, COARSE, limits)
    assert profile.acceleration == profile.deceleration == 60


@given(
    st.floats(0.01, 50.0),
    st.floats(1.001, 20.0),
    st.sampled_from([1e-4, 1e-3, 0.01, 0.05]),
    st.sampled_from([1e-3, 0.01, 0.1, 0.5]),
)
def test_stretched_profile_is_nearest_within_limits(
    distance: float, factor: float, velocity_unit: float, acceleration_unit: float
):
    units = DriveUnits("wheel", "rad", 1e6, velocity_unit, acceleration_unit, ("", "", ""))
    shortest_s = trajectory(distance).duration_s
    assert shortest_s is not None
    motion = trajectory(distance, duration_s=shortest_s * factor)
    assume(motion.velocity >= velocity_unit)  # slower ones are refused
    profile = profile_of(motion, MODEL, units, NO_LIMITS)
    made = as_motion(motion, profile, units)

    assert made.acceleration <= motion.acceleration * (1 + 1e-9)
    assert made.deceleration <= motion.deceleration * (1 + 1e-9)
    assert made.velocity <= MODEL.velocity_max * (1 + 1e-9)
    assert made.velocity < motion.velocity * (1 + 1e-9) + velocity_unit
    # never worse than plain rounding down
    plain = Motion(
        motion.mode, motion.variable, motion.start, motion.target, motion.velocity,
        motion.acceleration, motion.deceleration,
    )  # fmt: skip
    down = as_motion(motion, profile_of(plain, MODEL, units, NO_LIMITS), units)
    assert made.duration_s is not None
    assert motion.duration_s is not None
    assert down.duration_s is not None
    assert abs(made.duration_s - motion.duration_s) <= abs(down.duration_s - motion.duration_s)


@given(st.floats(0.01, 50.0), st.floats(1.0, 20.0))
def test_rounded_profile_is_unchanged_by_rounding(distance: float, factor: float):
    shortest_s = trajectory(distance).duration_s
    assert shortest_s is not None
    motion = trajectory(distance, duration_s=shortest_s * factor)
    assume(motion.velocity >= COARSE.speed(1))  # slower ones are refused
    once = as_motion(motion, profile_of(motion, MODEL, COARSE, NO_LIMITS), COARSE)
    again = as_motion(once, profile_of(once, MODEL, COARSE, NO_LIMITS), COARSE)
    assert again == once


def test_profile_search_finds_a_better_fit_than_rounding():
    motion = trajectory(2.0, duration_s=1.5)  # peak 1.558: 155 steps of 0.01 are too slow
    profile = profile_of(motion, MODEL, COARSE, NO_LIMITS)
    made = as_motion(motion, profile, COARSE)
    assert profile.speed == 156
    assert profile.acceleration < 90
    assert made.duration_s is not None
    assert abs(made.duration_s - 1.5) < 1e-3  # 155, 90, 60 would take 5.6 ms longer


def test_nearest_profile_never_exceeds_the_velocity_limit():
    limits = DriveUnits("wheel", "rad", 1000.0, 0.07, 0.1, ("", "", ""))
    motion = trajectory(20.0)
    made = as_motion(motion, profile_of(motion, MODEL, limits, NO_LIMITS), limits)
    assert made.velocity <= 3.0


@given(st.integers(-2000, 2000), st.integers(-2000, 2000))
def test_duration_is_that_of_the_distance_in_increments(start_inc: int, distance_inc: int):
    assume(distance_inc != 0)
    start = start_inc / 1000 + 0.0003
    motion = trajectory(distance_inc / 1000, start=start)
    made = as_motion(motion, profile_of(motion, MODEL, COARSE, NO_LIMITS), COARSE)
    assert made.target == round(motion.target * 1000) / 1000
    assert made.duration_s == planning.duration_of(made)


def test_motion_clipped_by_the_drive_is_refused_by_object():
    profile = profile_of(trajectory(1.0), MODEL, COARSE, NO_LIMITS)
    for name, limits in {
        "607Fh": DriveLimits(None, 299, None, None, None, has_deceleration=True),
        "60C5h": DriveLimits(None, None, 89, None, None, has_deceleration=True),
        "60C6h": DriveLimits(None, None, None, 59, None, has_deceleration=True),
    }.items():
        with pytest.raises(LimitError, match=name):
            check_limits("wheel", profile, COARSE, limits)
    exact = DriveLimits(None, 300, 90, 60, None, has_deceleration=True)
    check_limits("wheel", profile, COARSE, exact)


def test_software_position_limits_hold_at_their_ends():
    limits = DriveLimits((-500, 1000), None, None, None, None, has_deceleration=True)
    check_target("wheel", 1000, COARSE, limits)
    check_target("wheel", -500, COARSE, limits)
    for target in (1001, -501):
        with pytest.raises(LimitError, match=r"-0\.5 to 1 rad \(607Dh"):
            check_target("wheel", target, COARSE, limits)
    check_target("wheel", 5000, COARSE, NO_LIMITS)


@pytest.mark.parametrize(
    ("motion", "told"),
    [
        (
            Motion(ControlMode.SETPOINT, ControlVariable.POSITION, 0.0, 1.0, 0.005, 9.0, 6.0),
            r"wheel: velocity limit 0\.005 rad/s, allowed is at least 0\.01 rad/s \(it is "
            r"below the smallest step of the drive's units\)",
        ),
        (
            Motion(ControlMode.SETPOINT, ControlVariable.POSITION, 0.0, 1.0, 1.0, 0.05, 6.0),
            r"acceleration limit 0\.05 rad/s², allowed is at least 0\.1",
        ),
        (
            Motion(ControlMode.SETPOINT, ControlVariable.VELOCITY, 0.0, 1.0, 3.0, 9.0, 0.05),
            r"deceleration limit 0\.05 rad/s², allowed is at least 0\.1",
        ),
    ],
)
def test_limit_below_the_smallest_step_is_refused(motion: Motion, told: str):
    with pytest.raises(LimitError, match=told):
        profile_of(motion, MODEL, COARSE, NO_LIMITS)


def test_trajectory_limit_below_the_smallest_step_is_refused():
    asked = TrapezoidalTrajectory(1.0, limits=DerivativeLimits(first=0.005))
    motion = planning.plan_trajectory("wheel", MODEL, ControlVariable.POSITION, asked, 0.0)
    with pytest.raises(LimitError, match=r"velocity limit 0\.005 rad/s"):
        profile_of(motion, MODEL, COARSE, NO_LIMITS)


def test_duration_beyond_the_smallest_step_is_refused():
    """A former version made 1 rad in 1000 s within 100 s, at 0.01 rad/s, without an error."""
    with pytest.raises(
        LimitError, match=r"duration 1000 s, allowed is at most 100.* lowest velocity"
    ):
        profile_of(trajectory(1.0, duration_s=1000.0), MODEL, COARSE, NO_LIMITS)
    profile = profile_of(trajectory(1.0, duration_s=105.0), MODEL, COARSE, NO_LIMITS)
    assert profile.speed == 1  # 0.01 rad/s: 100 s and a ramp, the nearest possible


def test_group_member_too_fast_at_smallest_step_ends_early():
    motion = planning.stretch(trajectory(1.0), 1000.0)
    profile = profile_of(motion, MODEL, COARSE, NO_LIMITS)
    assert profile.speed == 1  # reported as the predicted end skew
