"""Sampled functions against scipy's interpolation, and in exact arithmetic."""

from fractions import Fraction
from math import inf, nan, nextafter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.functions import Constant, Ends, Interpolation, Piecewise, Sampled
from motorhil.motorapi.functions.sampled import solved
from tests.support.mathematics.strategies import NUMBERS, sampled

NEAREST, LINEAR, CUBIC, HERMITE, QUINTIC = Interpolation


@pytest.fixture(scope="module")
def scipy():
    from scipy import interpolate

    return interpolate


@st.composite
def data(draw, least=2, rows=1):
    """Return arguments with gaps of 1/4 to 1, and rows of values."""
    gaps = draw(st.lists(st.floats(0.25, 1.0), min_size=least - 1, max_size=12))
    x = np.cumsum([draw(st.floats(-5.0, 5.0)), *gaps])
    numbers = st.lists(NUMBERS, min_size=len(x), max_size=len(x))
    return x, *(np.array(draw(numbers)) for _ in range(rows))


def agrees(ours, theirs, orders, x, accuracy=1e-12):
    """Compare values and derivatives, relative to the samples over the gap's power."""
    at = np.linspace(x[0], x[-1], 301)
    for order in orders:
        expected = theirs(at, order)
        size = np.abs(ours(x)).max() / np.diff(x).min() ** order
        scale = max(np.abs(expected).max(), size)
        assert np.abs(ours.derivative(order)(at) - expected).max() <= accuracy * scale


SPLINES = [(Ends.NOT_A_KNOT, "not-a-knot"), (Ends.NATURAL, "natural"), (Ends.AT_REST, "clamped")]


@pytest.mark.parametrize(("ends", "theirs"), SPLINES)
@given(samples=data())
def test_cubic_splines_equal_scipy(scipy, samples, ends, theirs):
    x, y = samples
    agrees(Sampled(x, y, CUBIC, ends=ends), scipy.CubicSpline(x, y, bc_type=theirs), (0, 1, 2), x)


NATURAL_5 = ([(3, 0.0), (4, 0.0)], [(3, 0.0), (4, 0.0)])
AT_REST_5 = ([(1, 0.0), (2, 0.0)], [(1, 0.0), (2, 0.0)])


@pytest.mark.parametrize(
    ("ends", "theirs"),
    [(Ends.NOT_A_KNOT, None), (Ends.NATURAL, NATURAL_5), (Ends.AT_REST, AT_REST_5)],
)
@given(samples=data(least=6))
def test_quintic_splines_equal_scipy(scipy, samples, ends, theirs):
    x, y = samples
    spline = scipy.make_interp_spline(x, y, k=5, bc_type=theirs)
    # Against an exact solution of 60 such systems: 7e-14 of the largest value in scipy, 3e-15 here.
    agrees(Sampled(x, y, QUINTIC, ends=ends), spline, (0, 1, 2, 3), x)


def test_quintic_spline_with_equal_gaps_has_full_accuracy(scipy):
    x = np.arange(12.0)
    y = np.sin(x) * 3 + x
    for ends, theirs in ((Ends.NOT_A_KNOT, None), (Ends.NATURAL, NATURAL_5)):
        spline = scipy.make_interp_spline(x, y, k=5, bc_type=theirs)
        agrees(Sampled(x, y, QUINTIC, ends=ends), spline, (0, 1, 2), x)


@given(samples=data(rows=2))
def test_hermite_curves_equal_scipy(scipy, samples):
    x, y, first = samples
    theirs = scipy.CubicHermiteSpline(x, y, first)
    agrees(Sampled(x, y, HERMITE, first), theirs, (0, 1, 2, 3), x)


@given(samples=data(rows=3))
def test_quintic_curves_with_derivatives_equal_scipy(scipy, samples):
    x, y, first, second = samples
    theirs = scipy.BPoly.from_derivatives(x, np.column_stack([y, first, second]))
    agrees(Sampled(x, y, QUINTIC, first, second), theirs, (0, 1, 2), x)


@given(samples=data())
def test_linear_interpolation_equals_numpy(samples):
    x, y = samples
    at = np.linspace(x[0], x[-1], 301)
    assert np.abs(Sampled(x, y)(at) - np.interp(at, x, y)).max() <= 1e-14 * (1 + np.abs(y).max())


def test_nearest_changes_half_way_to_the_later_sample():
    steps = Sampled((0.0, 1.0, 4.0), (5.0, 6.0, 7.0), NEAREST)
    at = [0.0, nextafter(0.5, 0), 0.5, 1.0, nextafter(2.5, 0), 2.5, 4.0]
    assert [steps.value(x) for x in at] == [5, 5, 6, 6, 6, 7, 7]


@given(sampled())
def test_samples_are_reproduced_exactly_with_the_last(function):
    assert [function.value(x) for x in function.arguments] == list(function.values)
    assert function(np.array(function.arguments)).tolist() == list(function.values)


@given(sampled(QUINTIC) | sampled(HERMITE))
def test_given_derivatives_are_reproduced(function):
    for order, given_ones in ((1, function.first), (2, function.second)):
        if given_ones is not None:
            slope = function.derivative(order)
            for x, expected in zip(function.arguments, given_ones, strict=True):
                assert slope.value(x) == pytest.approx(expected, abs=1e-7)
            begins = slope.value(function.arguments[0])
            assert begins == given_ones[0]


@pytest.mark.parametrize(
    ("kind", "ends", "smooth"),
    [(CUBIC, ends, 2) for ends in Ends] + [(QUINTIC, ends, 4) for ends in Ends],
)
@given(samples=data(least=7))
def test_splines_do_not_jump_at_their_samples(samples, kind, ends, smooth):
    x, y = samples
    spline = Sampled(x, y, kind, ends=ends)
    for order in range(smooth + 1):
        pieces = spline.curve.derivative(order).pieces
        scale = 1.0 + max(abs(piece.value(at)) for piece, at in zip(pieces, x[:-1], strict=True))
        for i, at in enumerate(x[1:-1].tolist()):
            # The jump by rounding grows with the power of 1/gap.
            assert abs(pieces[i].value(at) - pieces[i + 1].value(at)) <= 1e-9 * scale


@given(samples=data(least=7))
def test_splines_meet_their_end_conditions(samples):
    x, y = samples
    both = [x[0], x[-1]]
    size = 1.0 + np.abs(y).max()
    rest = Sampled(x, y, CUBIC, ends=Ends.AT_REST)
    assert np.abs(rest.derivative()(both)).max() <= 1e-12 * size
    rest = Sampled(x, y, QUINTIC, ends=Ends.AT_REST)
    assert np.abs(rest.derivative()(both)).max() <= 1e-10 * size
    assert np.abs(rest.derivative(2)(both)).max() <= 1e-9 * size
    natural = Sampled(x, y, CUBIC, ends=Ends.NATURAL)
    assert np.abs(natural.derivative(2)(both)).max() <= 1e-10 * size


@pytest.mark.parametrize(("kind", "most"), [(CUBIC, 4), (QUINTIC, 6)])
@given(samples=data(least=6))
def test_spline_of_few_samples_is_their_polynomial(samples, kind, most):
    x, y = samples
    for count in range(2, most + 1):
        curve = Sampled(x[:count], y[:count], kind)
        for at in np.linspace(x[0], x[count - 1], 7).tolist():
            exact, size = lagrange(x[:count], y[:count], at)
            assert abs(curve.value(at) - exact) <= 1e-12 * (1.0 + size)


def lagrange(x, y, at):
    """Return the exact value of the polynomial through all points, and the size of its terms."""
    knots, at = [Fraction(k) for k in x.tolist()], Fraction(at)
    total = size = Fraction(0)
    for i, knot in enumerate(knots):
        term = Fraction(y.tolist()[i])
        for j, other in enumerate(knots):
            if i != j:
                term *= (at - other) / (knot - other)
        total, size = total + term, size + abs(term)
    return float(total), float(size)


def test_spline_of_a_polynomial_reproduces_it():
    x = np.array([0.0, 0.4, 1.0, 1.7, 2.1, 3.0, 3.3])
    for kind, degree in ((CUBIC, 3), (QUINTIC, 5)):
        p = np.polynomial.Polynomial(np.arange(1.0, degree + 2))
        at = np.linspace(0.0, 3.3, 100)
        assert np.allclose(Sampled(x, p(x), kind)(at), p(at), rtol=1e-11, atol=0.0)


def test_spline_of_ten_thousand_samples_is_accurate():
    x = np.arange(10_000) * 1e-3
    wave = np.sin(x)
    spline = Sampled(x, wave, CUBIC)
    at = np.linspace(0.0, x[-1], 5000)
    assert np.abs(spline(at) - np.sin(at)).max() <= 1e-13  # h^4 / 384 and rounding
    assert isinstance(spline.derivative(), Piecewise)


def test_banded_solver_pivots():
    # By hand: without a swap the first pivot has no digits left; x = (1, 2, 3).
    rows = [
        (0, [1e-30, 1.0], 2.0),
        (0, [1.0, 1.0, 1.0], 6.0),
        (1, [1.0, -1.0], -1.0),
    ]
    for order in (rows, rows[::-1]):
        assert solved(order, 3) == pytest.approx([1.0, 2.0, 3.0], rel=1e-15)


@given(sampled(), st.sampled_from([0.5, 2.0, -0.25, -4.0]), st.floats(-2.0, 2.0))
def test_scaled_samples_stretch_or_reverse_the_curve(function, factor, x):
    scaled = function.scaled(factor)
    assert isinstance(scaled, Sampled)
    if (
        function.kind is not NEAREST or x not in function.curve.breaks
    ):  # half-way, the other side counts
        size = 1e3 * (1.0 + max(abs(c) for p in function.curve.pieces for c in p.coefficients))
        assert abs(scaled.value(x * factor) - function.value(x)) <= 1e-12 * size


def test_samples_move_with_their_function():
    curve = Sampled((0.0, 1.0, 3.0), (1.0, 2.0, 0.0), CUBIC, ends=Ends.AT_REST)
    assert curve.shifted(2.0) == Sampled((2.0, 3.0, 5.0), (1, 2, 0), CUBIC, ends=Ends.AT_REST)
    assert curve * 2.0 == Sampled((0.0, 1.0, 3.0), (2, 4, 0), CUBIC, ends=Ends.AT_REST)
    given_ones = Sampled((0.0, 1.0), (1.0, 2.0), QUINTIC, (1.0, 2.0), (3.0, 4.0))
    assert given_ones / -2 == Sampled((0, 1), (-0.5, -1), QUINTIC, (-0.5, -1), (-1.5, -2))
    assert isinstance(curve + Constant(1.0), Piecewise)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (((0.0,), (1.0,)), "expected at least 2"),
        (((), ()), "expected at least 2"),
        (((0.0, 1.0), (1.0,)), "2 arguments, but 1 of values"),
        (((0.0, 0.0), (1.0, 2.0)), "argument 1 is 0.0, not above argument 0, 0.0"),
        (((0.0, 1.0, 0.5), (1.0, 2.0, 3.0)), "argument 2 is 0.5"),
        (((0.0, nan), (1.0, 2.0)), "arguments\\[1\\] is nan"),
        (((0.0, inf), (1.0, 2.0)), "arguments\\[1\\] is inf"),
        (((0.0, 1.0), (1.0, nan)), "values\\[1\\]"),
        (((0.0, 1.0), (1.0, "2")), "values\\[1\\]"),
        ((3.0, (1.0, 2.0)), "not a sequence"),
        (((0.0, 1.0), (1.0, 2.0), "cubic"), "not an Interpolation"),
        (((0.0, 1.0), (1.0, 2.0), CUBIC, None, None, "natural"), "not an Ends"),
        (((0.0, 1.0), (1.0, 2.0), HERMITE), "first derivatives"),
        (((0.0, 1.0), (1.0, 2.0), HERMITE, (1.0,)), "but 1 of first"),
        (((0.0, 1.0), (1.0, 2.0), HERMITE, (1, 2), (1, 2)), "no second derivatives"),
        (((0.0, 1.0), (1.0, 2.0), QUINTIC, (1.0, 2.0)), "or neither"),
        (((0.0, 1.0), (1.0, 2.0), CUBIC, (1.0, 2.0)), "CUBIC takes no derivatives"),
        (((0.0, 1.0), (1.0, 2.0), LINEAR, None, None, Ends.AT_REST), "not a spline"),
        (((0.0, 1.0), (1, 2), QUINTIC, (1, 2), (1, 2), Ends.NATURAL), "not a spline"),
    ],
)
def test_invalid_samples_raise(arguments, told):
    with pytest.raises(UsageError, match=told):
        Sampled(*arguments)
