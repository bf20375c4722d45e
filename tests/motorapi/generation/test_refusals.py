"""What is asked of a generator and cannot be kept to, or is of another type, is refused aloud."""

import pytest

from motorapi import (
    ComplexTrajectory,
    DerivativeLimits,
    MotorModel,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
)
from motorapi.functions import Polynomial
from motorapi.generation import (
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
def test_nothing_is_called_feasible_that_no_trapezoid_can_be(trajectory, why):
    for refuse in (feasible, generate):
        with pytest.raises(UnsupportedError, match=f"^wheel .*{why}.*jerk_limited"):
            refuse(trajectory, MODEL)


def test_way_points_have_times_or_limits_that_are_kept_to():
    limits = DerivativeLimits(first=0.1, second=1.0)
    with pytest.raises(UsageError, match="limits of way-points with times are not kept to"):
        through_waypoints([0.0, 1.0, 2.0], [0.0, 1.0, 2.0], limits=limits)
    limits = DerivativeLimits(value=(0.0, 0.5), first=0.1, second=1.0)
    with pytest.raises(UsageError, match="limits of their value are not kept to"):
        through_waypoints([0.0, 1.0, 0.0], limits=limits)


def test_what_is_of_another_type_is_refused_with_what_to_give():
    with pytest.raises(UsageError, match="a ComplexTrajectory is generated already"):
        generate(COMPLEX, MODEL)
    with pytest.raises(UsageError, match="give a TrapezoidalTrajectory and a MotorModel"):
        generate(MODEL, TrapezoidalTrajectory(1.0))
    with pytest.raises(UsageError, match="is no trajectory, no Profile and no function"):
        feasible(lambda time_s: time_s, MODEL)
    for motion in (COMPLEX, TrapezoidalTrajectory(1.0)):
        with pytest.raises(UsageError, match=r"ProfileLimits\(.* limits nothing; give a MotorM"):
            feasible(motion, ProfileLimits(1.0, 1.0))
        with pytest.raises(UsageError, match="'position'; give a ControlVariable"):
            feasible(motion, MODEL, variable="position")
    limits = DerivativeLimits(first=1.0, second=1.0)
    with pytest.raises(UsageError, match="give ProfileLimits"):
        jerk_limited(1.0, limits, 20.0)
    with pytest.raises(UsageError, match="are DerivativeLimits, not"):
        through_waypoints([0.0, 1.0], limits=ProfileLimits(1.0, 1.0))
