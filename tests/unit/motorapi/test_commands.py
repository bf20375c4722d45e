import pickle
from math import inf, nan

import pytest

from motorhil.motorapi import DerivativeLimits, LimitError, TrapezoidalTrajectory, UsageError


def test_limit_as_a_number_is_a_range_around_zero():
    limits = DerivativeLimits(first=2, second=(-1, 3))
    assert limits.first == (-2.0, 2.0)
    assert limits.second == (-1.0, 3.0)
    assert limits.third is None
    assert limits == DerivativeLimits(first=2.0, second=(-1.0, 3.0))


@pytest.mark.parametrize("bad", [0, -1.0, (0.0, 1.0), (-1.0, 0.0), (1.0, -1.0), nan, (-1.0, nan)])
def test_derivative_range_without_zero_raises(bad):
    with pytest.raises(UsageError, match="must contain 0 in its interior"):
        DerivativeLimits(first=bad)


def test_value_range_need_not_contain_zero():
    assert DerivativeLimits(value=(1, 2)).value == (1, 2)
    with pytest.raises(UsageError, match="empty"):
        DerivativeLimits(value=(2.0, 1.0))


def test_number_beyond_all_floats_raises_usage_error():
    assert DerivativeLimits(value=(-(10**400), 10**400)).value == (-inf, inf)
    with pytest.raises(UsageError, match="outside its own limits of the value, 2 to inf"):
        TrapezoidalTrajectory(1.0, 0.0, limits=DerivativeLimits(value=(2, 10**400)))


def test_trajectories_have_value_semantics():
    one = TrapezoidalTrajectory(1, limits=DerivativeLimits(first=0.5), duration_s=3)
    same = TrapezoidalTrajectory(1.0, limits=DerivativeLimits(first=0.5), duration_s=3.0)
    assert one == same
    assert hash(one) == hash(same)
    assert pickle.loads(pickle.dumps(one)) == one
    assert one != TrapezoidalTrajectory(1.0)
    with pytest.raises(AttributeError):
        one.final = 2.0  # type: ignore[misc]


def test_trajectory_without_initial_is_a_distance():
    assert TrapezoidalTrajectory(1.0).is_relative
    assert not TrapezoidalTrajectory(1.0, 0.0).is_relative


@pytest.mark.parametrize(
    ("trajectory", "shown"),
    [
        (TrapezoidalTrajectory(1.0), "<TrapezoidalTrajectory by 1.0, as fast as allowed>"),
        (
            TrapezoidalTrajectory(
                1.0, initial=0.25, duration_s=2.0, limits=DerivativeLimits(first=0.5)
            ),
            "<TrapezoidalTrajectory from 0.25 to 1.0, in 2.0 s, first derivative at most 0.5>",
        ),
        (
            TrapezoidalTrajectory(-1.0, limits=DerivativeLimits(second=(-2, 1), value=(-3, 0))),
            "<TrapezoidalTrajectory by -1.0, as fast as allowed, value -3.0 to 0.0, "
            "second derivative -2.0 to 1.0>",
        ),
    ],
)
def test_trajectory_repr_is_readable(trajectory, shown):
    assert repr(trajectory) == shown


@pytest.mark.parametrize(
    "arguments",
    [
        {"final": nan},
        {"final": inf},
        {"final": 1.0, "initial": nan},
        {"final": 1.0, "duration_s": 0.0},
        {"final": 1.0, "duration_s": -1.0},
        {"final": 1.0, "duration_s": inf},
        {"final": 1.0, "initial": 0.0, "limits": DerivativeLimits(value=(0.0, 0.5))},
    ],
)
def test_invalid_trajectory_raises(arguments):
    with pytest.raises(UsageError) as caught:
        TrapezoidalTrajectory(**arguments)
    assert not isinstance(caught.value, LimitError)  # without a motor, none of its limits apply


@pytest.mark.parametrize(
    ("limits", "told"),
    [
        ({"first": "fast"}, "first derivative, 'fast', is not a number or a pair"),
        ({"second": (1.0,)}, r"second derivative, \(1.0,\), is not a number or a pair"),
        ({"third": ("a", "b")}, "third derivative, "),
        ({"value": 5}, "the value, 5, is not a pair of numbers"),
        ({"value": (nan, 1.0)}, "is empty"),
    ],
)
def test_invalid_range_raises(limits, told):
    with pytest.raises(UsageError, match=told):
        DerivativeLimits(**limits)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"final": None}, "final is None, not a finite number"),
        ({"final": "1.0"}, "final is '1.0', not a finite number"),
        ({"final": 1.0, "initial": []}, r"initial is \[\], not a finite number"),
        ({"final": 1.0, "duration_s": inf}, "duration_s is inf, not a finite number"),
        ({"final": 1.0, "limits": 3.0}, "limits is 3.0, not DerivativeLimits"),
    ],
)
def test_invalid_trajectory_arguments_raise(arguments, told):
    with pytest.raises(UsageError, match=told):
        TrapezoidalTrajectory(**arguments)
