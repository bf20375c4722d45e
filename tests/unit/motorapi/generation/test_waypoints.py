from itertools import pairwise
from math import inf, nan
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.motorapi.commands import DerivativeLimits
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.generation import through_waypoints
from motorhil.motorapi.generation.waypoints import value_ranges

VALUE = st.floats(-100.0, 100.0)
STEP = st.floats(0.1, 5.0)  # rounding of quintics grows with the fourth power of the steps' ratio
LIMITS = DerivativeLimits(first=(-1.0, 2.0), second=3.0, third=40.0)


@st.composite
def courses(draw, most=8):
    values = draw(st.lists(VALUE, min_size=2, max_size=most))
    times = np.cumsum([draw(st.floats(-5.0, 5.0)), *(draw(STEP) for _ in values[1:])])
    return values, times.tolist()


def steps_of(function, order):
    """Return (jump, size) of a derivative at each inner break."""
    derivative = function.derivative(order)
    if len(function.pieces) == 1:
        return []
    found = derivative.extrema()
    size = max(abs(found.minimum), abs(found.maximum))
    pieces = zip(derivative.pieces, derivative.pieces[1:], function.breaks[1:-1], strict=False)
    return [(abs(left.value(at) - right.value(at)), size) for left, right, at in pieces]


def test_two_waypoints_equal_hand_results():
    # Rest to rest over 1 in 1 s: 3 t² - 2 t³, and 10 t³ - 15 t⁴ + 6 t⁵.
    (cubic,) = through_waypoints([0.0, 1.0], [0.0, 1.0]).pieces
    assert cubic.coefficients == (0.0, 0.0, 3.0, -2.0)
    (quintic,) = through_waypoints([0.0, 1.0], [0.0, 1.0], degree=5).pieces
    assert quintic.coefficients == (0.0, 0.0, 0.0, 10.0, -15.0, 6.0)


@given(courses(), st.sampled_from([3, 5]))
def test_curve_passes_all_points_smoothly_and_rests_at_ends(course, degree):
    values, times = course
    function = through_waypoints(values, times, degree=degree)
    size = max(abs(function.extrema().minimum), abs(function.extrema().maximum))
    for t, value in zip(times, values, strict=True):
        assert function.value(t) == pytest.approx(value, abs=1e-12 * size)
    rests = range(1, 2 if degree == 3 else 3)
    for order in rests:
        derivative = function.derivative(order)
        size = max(abs(derivative.extrema().minimum), abs(derivative.extrema().maximum))
        assert derivative.value(times[0]) == 0.0
        assert derivative.value(times[-1]) == pytest.approx(0.0, abs=1e-9 * size)
    for order in range(1, degree):
        for step, size in steps_of(function, order):
            # Required by the equations; rounding grows with the powers of the steps.
            assert step <= 1e-7 * size


@given(courses(12), st.booleans())
def test_cubics_equal_the_spline_of_scipy(course, natural):
    from scipy import interpolate

    values, times = course
    if natural and len(values) > 2:
        ours = through_waypoints(values, times, first=[None] * len(values))
        theirs = interpolate.CubicSpline(times, values, bc_type="natural")
    else:
        ours = through_waypoints(values, times)
        theirs = interpolate.CubicSpline(times, values, bc_type="clamped")
    at = np.linspace(times[0], times[-1], 50)
    size = np.abs(theirs(at)).max() + np.abs(values).max()
    np.testing.assert_allclose(ours(at), theirs(at), rtol=0.0, atol=1e-12 * size)


@given(courses(), st.data())
def test_given_derivatives_are_reproduced(course, data):
    values, times = course
    free = st.none() | st.floats(-3.0, 3.0)
    first = [data.draw(free) for _ in values]
    second = [data.draw(free) for _ in values]
    for end in (0, -1):  # a free derivative at an end of a quintic is not determined otherwise
        first[end], second[end] = 1.0, -2.0
    for degree, orders in ((3, (first,)), (5, (first, second))):
        extra = {"second": second} if degree == 5 else {}
        function = through_waypoints(values, times, first=first, degree=degree, **extra)
        for order, given_ in enumerate(orders, start=1):
            derivative = function.derivative(order)
            size = max(abs(derivative.extrema().minimum), abs(derivative.extrema().maximum), 1.0)
            for t, number in zip(times, given_, strict=True):
                if number is not None:
                    assert derivative.value(t) == pytest.approx(number, abs=1e-9 * size)
    # If one of both is free, one more derivative of a quintic is continuous.
    for order, free_one in ((3, second), (4, first)):
        for place, (step, size) in enumerate(steps_of(function, order), start=1):
            if free_one[place] is None:
                assert step <= 1e-6 * size


@pytest.mark.parametrize("degree", [3, 5])
@pytest.mark.parametrize("ends", [None, (0.5, -0.25)])
def test_shortest_times_meet_the_limits_and_reach_one(degree, ends):
    random = Random(f"motorhil:shortest times {degree}")
    bounds = ((1, LIMITS.first), (2, LIMITS.second), (3, LIMITS.third))
    for count in (2, 3, 5, 7):
        values = [random.uniform(-3.0, 3.0) for _ in range(count)]
        first = None if ends is None else [ends[0], *([None] * (len(values) - 2)), ends[1]]
        function = through_waypoints(
            values, limits=LIMITS, degree=degree, first=first, initial_argument=2.0
        )
        assert function.domain[0] == 2.0
        used = []
        for order, (low, high) in bounds:
            found = function.derivative(order).extrema()
            used += [found.minimum / low, found.maximum / high]
        assert max(used) == pytest.approx(1.0, rel=1e-9)


def test_no_searched_time_division_is_shorter_by_1_percent():
    from scipy import optimize

    random = Random("motorhil:division")
    bounds = ((1, LIMITS.first), (2, LIMITS.second), (3, LIMITS.third))
    for _ in range(4):
        values = [random.uniform(-3.0, 3.0) for _ in range(4)]
        ours = through_waypoints(values, limits=LIMITS)

        def lasts(logs, values=values):
            steps = np.exp(np.clip(logs, -10.0, 10.0))
            function = through_waypoints(values, np.cumsum([0.0, *steps]))
            factor = 0.0
            for order, (low, high) in bounds:
                found = function.derivative(order).extrema()
                used = max(found.minimum / low, found.maximum / high)
                factor = max(factor, used ** (1.0 / order))
            return factor * steps.sum()

        start = np.log(np.diff(ours.breaks))
        assert lasts(start) == pytest.approx(ours.domain[1], rel=1e-9)
        found = optimize.minimize(lasts, start, method="Nelder-Mead", options={"maxiter": 200})
        assert found.fun >= 0.99 * ours.domain[1]


def test_forty_points_meet_the_limits_and_reach_one():
    """Use forty points, where the ratios of the times are not searched."""
    random = Random("motorhil:many pieces")
    values = [random.uniform(-3.0, 3.0) for _ in range(40)]
    ours = through_waypoints(values, limits=LIMITS)
    used = [
        max(found.minimum / low, found.maximum / high)
        for order, (low, high) in ((1, LIMITS.first), (2, LIMITS.second), (3, LIMITS.third))
        for found in [ours.derivative(order).extrema()]
    ]
    assert max(used) == pytest.approx(1.0, rel=1e-9)
    chords = sum(max(b - a, 2.0 * (a - b)) / 2.0 for a, b in pairwise(values))
    assert ours.domain[1] < 3.0 * chords  # the time at the velocity limit


@given(st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=6), st.floats(0.01, 10.0))
def test_ranges_of_polynomials_contain_all_values(coefficients, length):
    low, high = value_ranges(np.array([coefficients]), np.array([length]))
    at = np.linspace(0.0, length, 400)
    values = np.polynomial.polynomial.polyval(at, coefficients)
    slack = 1e-9 * (np.abs(values).max() + 1e-300)
    assert low[0] <= values.min() + slack
    assert high[0] >= values.max() - slack
    near = (
        0.5
        * (length / 399) ** 2
        * np.abs(
            np.polynomial.polynomial.polyval(at, np.polynomial.polynomial.polyder(coefficients, 2))
        ).max()
    )
    assert low[0] >= values.min() - near - slack - 1e-3 * np.ptp(values)
    assert high[0] <= values.max() + near + slack + 1e-3 * np.ptp(values)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"values": [1.0]}, "at least two"),
        ({"values": [1.0, nan]}, "finite numbers"),
        ({"times": [0.0, 0.0, 1.0]}, "times must be finite numbers and ascend"),
        ({"times": [0.0, 1.0, inf]}, "times must be finite numbers and ascend"),
        ({"times": [0.0, 1.0]}, "times have shape"),
        ({"times": None}, "need times, or limits"),
        ({"times": None, "limits": DerivativeLimits()}, "must be a limit of a derivative"),
        ({"times": None, "limits": LIMITS, "values": [1.0] * 3}, "all the same take no time"),
        (
            {"times": None, "limits": LIMITS, "first": [2.5, None, 0.0]},
            "no times keep the derivatives",
        ),
        ({"degree": 4}, "of degree 3 or 5, not 4"),
        ({"second": [0.0] * 3}, "to pieces of degree 5 only"),
        ({"first": [inf, None, 0.0]}, "finite, or nan"),
        ({"initial_argument": nan}, "initial argument"),
    ],
)
def test_impossible_waypoints_raise(arguments, told):
    arguments = {"values": [0.0, 1.0, 3.0], "times": [0.0, 1.0, 2.0]} | arguments
    with pytest.raises(UsageError, match=told):
        through_waypoints(arguments.pop("values"), **arguments)
