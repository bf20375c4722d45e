"""Errors for generator requests that are impossible or have the wrong type."""

import pytest

from motorhil.motorapi import (
    ComplexTrajectory,
    DerivativeLimits,
    MotorModel,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.functions import Polynomial
from motorhil.motorapi.generation import (
    ProfileLimits,
    feasible,
    generate,
    jerk_limited,
    through_waypoints,
)

MODEL = MotorModel(name="wheel", velocity_max=2.0, acceleration_max=4.0)
COMPLEX = ComplexTrajectory(Polynomial((0.0, 0.0, 3.0, -2.0)), 0, 1)


@pytest.mark.parametrize(
    ("trajectory", "why"),
    [
        (
            TrapezoidalTrajectory(1.0, duration_s=1.0, limits=DerivativeLimits(third=1.0)),
            "with a limit of the third derivative",
        ),
        (TrapezoidalTrajectory(1.0, final_derivatives=(0.0, 1.0)), "with a second derivative"),
    ],
)
def test_feasible_of_a_request_beyond_trapezoids_raises(trajectory, why):
    for refuse in (feasible, generate):
        with pytest.raises(UnsupportedError, match=f"^wheel .*{why}.*jerk_limited"):
            refuse(trajectory, MODEL)


def test_waypoints_require_times_or_supported_limits():
    limits = DerivativeLimits(first=0.1, second=1.0)
    with pytest.raises(UsageError, match="limits of way-points with times are not met"):
        through_waypoints([0.0, 1.0, 2.0], [0.0, 1.0, 2.0], limits=limits)
    limits = DerivativeLimits(value=(0.0, 0.5), first=0.1, second=1.0)
    with pytest.raises(UsageError, match="limits of their value are not met"):
        through_waypoints([0.0, 1.0, 0.0], limits=limits)


def test_generators_with_wrong_types_name_the_expected_one():
    with pytest.raises(UsageError, match="a ComplexTrajectory needs no generation"):
        generate(COMPLEX, MODEL)
    with pytest.raises(UsageError, match="give a TrapezoidalTrajectory and a MotorModel"):
        generate(MODEL, TrapezoidalTrajectory(1.0))
    with pytest.raises(UsageError, match="is not a trajectory, a Profile or a function"):
        feasible(lambda time_s: time_s, MODEL)
    for motion in (COMPLEX, TrapezoidalTrajectory(1.0)):
        with pytest.raises(UsageError, match=r"ProfileLimits\(.* has no limits; give a MotorM"):
            feasible(motion, ProfileLimits(1.0, 1.0))
        with pytest.raises(UsageError, match="'position'; give a ControlVariable"):
            feasible(motion, MODEL, variable="position")
    limits = DerivativeLimits(first=1.0, second=1.0)
    with pytest.raises(UsageError, match="give ProfileLimits"):
        jerk_limited(1.0, limits, 20.0)
    with pytest.raises(UsageError, match="are DerivativeLimits, not"):
        through_waypoints([0.0, 1.0], limits=ProfileLimits(1.0, 1.0))
