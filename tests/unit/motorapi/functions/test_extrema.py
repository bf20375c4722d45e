"""Extrema and bounds: complete and attained."""

import itertools
from math import e, exp, inf, nextafter, pi, sqrt

import numpy as np
import pytest
from hypothesis import assume, event, example, given
from hypothesis import strategies as st

from motorhil.motorapi.errors import DomainError, UsageError
from motorhil.motorapi.functions import (
    Constant,
    Cosine,
    Exponential,
    Extrema,
    Function,
    Integral,
    Interpolation,
    Piecewise,
    Polynomial,
    Sampled,
    Sine,
)
from motorhil.motorapi.functions import numerics as search
from tests.support.mathematics import jets
from tests.support.mathematics.strategies import (
    ARGUMENTS,
    any_function,
    any_smooth,
    made_of_polynomials,
    polynomials,
    waves,
)


def samples(function, low, high, count=400):
    """Return many values, also at breaks and beside them."""
    x = [low + (high - low) * k / count for k in range(count)] + [high]
    for b in function.breaks_between(low, high):
        x += [nextafter(b, -inf), b, nextafter(b, inf)]
    return [(function.value(at), at) for at in x if low <= at <= high]


def ordered(function, *arguments):
    """Return the arguments in order, if they lie in the domain and are not too near."""
    low, high = sorted(arguments)
    assume(function.domain[0] <= low and high <= function.domain[1])
    assume(high - low > 1e-6)
    return low, high


@given(any_function, ARGUMENTS, ARGUMENTS)
def test_extrema_bound_every_sample_and_are_attained(function, one, other):
    low, high = ordered(function, one, other)
    event(type(function).__name__)
    found = function.extrema(low, high)
    assert low <= found.at_minimum <= high
    assert low <= found.at_maximum <= high
    size = max(jets.jet(function, x, 0)[1][0] for _, x in samples(function, low, high, 8))
    # The accuracy of the search, and the rounding of a value with terms of that size.
    slack = 1e-12 * max(abs(found.minimum), abs(found.maximum)) + 1e-14 * size
    values = [value for value, _ in samples(function, low, high)]
    assert found.minimum - slack <= min(values)
    assert max(values) <= found.maximum + slack
    assert abs(function.value(found.at_minimum) - found.minimum) <= slack
    assert abs(function.value(found.at_maximum) - found.maximum) <= slack


@given(any_function, ARGUMENTS, ARGUMENTS)
def test_bounds_contain_every_sample(function, one, other):
    low, high = ordered(function, one, other)
    least, most = function.bounds(low, high)
    size = max(jets.jet(function, x, 0)[1][0] for _, x in samples(function, low, high, 8))
    for value, _ in samples(function, low, high, 50):
        assert least - 1e-14 * size <= value <= most + 1e-14 * size


def test_polynomial_bounds_are_those_of_its_control_polygon():
    # By hand: t - t² has the Bernstein coefficients 0, 1/2, 0 over [0, 1].
    least, most = Polynomial((0.0, 1.0, -1.0)).bounds(0.0, 1.0)
    assert (least, most) == (pytest.approx(0.0, abs=1e-14), pytest.approx(0.5, abs=1e-14))
    assert Polynomial((1.0, 2.0)).bounds(-1.0, 3.0) == pytest.approx((-1.0, 7.0), rel=1e-14)
    least, most = Polynomial((0.0, 0.0, 0.0, 1.0), about=2.0).bounds(1.0, 3.0)
    assert (least, most) == (pytest.approx(-1.0), pytest.approx(1.0))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_integral_bounds_and_extrema_contain_its_values(sign):
    rising = Integral(sign * (Sine() * Sine() + 0.5))
    falling = Integral(sign * Sine() * Exponential(1.0, -0.1))
    for function in (rising, falling, Integral(Exponential(sign, 0.5))):
        values = [function.value(x) for x in np.linspace(1.0, 8.0, 50).tolist()]
        least, most = function.bounds(1.0, 8.0)
        assert least <= min(values)
        assert max(values) <= most
        found = function.extrema(1.0, 8.0)
        assert found.minimum <= min(values)
        assert max(values) <= found.maximum
    assert sorted((rising.extrema(1.0, 8.0).at_minimum, rising.extrema(1.0, 8.0).at_maximum)) == [
        1.0,
        8.0,
    ]
    # The integral of the damped sine has its extrema at the zeros of that function.
    found = falling.extrema(1.0, 8.0)
    at = found.at_maximum if sign > 0 else found.at_minimum
    assert at == pytest.approx(np.pi, abs=1e-6)


@given(any_smooth, st.floats(-1.5, 1.5))
def test_bounds_converge_as_the_interval_shrinks(function, x):
    for width in (2.0**-4, 2.0**-8, 2.0**-12, 2.0**-16):
        least, most = function.bounds(x, x + width)
        _, (size, slope) = jets.jet(function, x, 1)
        # First order at least: by the slopes of all terms (4 times, for they vary and multiply).
        assert most - least <= 64.0 * width * (slope + size) + 1e-12 * size + 64.0 * width


@given(polynomials, ARGUMENTS, ARGUMENTS)
def test_polynomial_extrema_are_at_roots_of_the_derivative(function, one, other):
    low, high = ordered(function, one, other)
    slope = np.polynomial.Polynomial(function.coefficients).deriv()
    roots = slope.roots() if slope.degree() > 0 else np.array([])
    at = [low, high] + [
        float(r.real) + function.about for r in roots if low <= r.real + function.about <= high
    ]
    values = [function.value(x) for x in at]
    found = function.extrema(low, high)
    # A value near its extremum has an error of the square of the root's error: eps of the size.
    size = max(jets.jet(function, x, 0)[1][0] for x in (low, high))
    assert abs(found.minimum - min(values)) <= 1e-13 * size
    assert abs(found.maximum - max(values)) <= 1e-13 * size


@pytest.mark.parametrize("degree", range(1, 16))
def test_extrema_of_chebyshev_polynomials_are_all_found(degree):
    # T_n has n + 1 extrema on [-1, 1], all of them +-1 (Rivlin, Chebyshev Polynomials, 1.1).
    p = Polynomial(np.polynomial.chebyshev.cheb2poly([0] * degree + [1]))
    extremes = [np.cos(np.pi * k / degree) for k in range(degree, -1, -1)]
    size = sum(abs(c) for c in p.coefficients)
    for a, b in itertools.pairwise(extremes):
        middle, width = (a + b) / 2, (b - a) / 2
        found = p.extrema(max(-1.0, middle - 1.01 * width), min(1.0, middle + 1.01 * width))
        assert abs(found.minimum + 1.0) <= 4e-16 * size
        assert abs(found.maximum - 1.0) <= 4e-16 * size
        assert min(abs(found.at_minimum - a), abs(found.at_minimum - b)) <= 1e-6
        assert min(abs(found.at_maximum - a), abs(found.at_maximum - b)) <= 1e-6


@pytest.mark.parametrize("width", [1e-2, 1e-5, 1e-9])
@pytest.mark.parametrize("number", [0, 137, 499])
def test_extrema_find_a_narrow_spike_in_a_long_interval(width, number):
    """Search for a parabola of width 1e-9 among 500 pieces over 500, invisible to samples."""
    breaks, rows = [0.0], []
    for i in range(500):
        if i == number:
            up = [0.0, 4.0 / width, -4.0 / width**2]
            breaks += [i + width, i + 2 * width, i + 1.0]
            rows += [up, [-2.0 * c for c in up], [0.0]]
        else:
            breaks.append(i + 1.0)
            rows.append([0.0, 0.5, -0.5])
    for function in (
        Piecewise.of_polynomials(breaks, rows),
        Piecewise.of_polynomials(breaks, rows) + Constant(0.0).restricted(-1.0, 501.0),
    ):
        found = function.extrema()
        # The argument of the maximum may differ by one double: 1.2e-13 near 500.
        off = 8.0 * (1.2e-13 / width) ** 2 + 1e-15
        assert found.maximum == pytest.approx(1.0, abs=off)
        assert found.minimum == pytest.approx(-2.0, abs=2.0 * off)
        assert abs(found.at_maximum - (number + 0.5 * width)) <= 1e-7 * width + 1e-13
        assert abs(found.at_minimum - (number + 1.5 * width)) <= 1e-7 * width + 1e-13


@given(waves, ARGUMENTS, st.floats(0.01, 40.0))
@example(Sine(2.0, 3.0), 0.0, 1.0)
@example(Cosine(-2.0, -3.0, 1.0), -1.0, 1.0)
def test_extrema_of_waves_are_at_their_crests(function, low, length):
    high = low + length
    found = function.extrema(low, high)
    assert found.maximum <= abs(function.amplitude)
    x = np.linspace(low, high, 2001)
    # Between samples h apart a wave rises by less than A (w h)² / 8 above both.
    rise = abs(function.amplitude) * (function.frequency_rad_s * length / 2000) ** 2 / 8
    for sign, value, at in (
        (1.0, found.maximum, found.at_maximum),
        (-1.0, found.minimum, found.at_minimum),
    ):
        highest = float((sign * function(x)).max())
        assert -1e-14 <= sign * value - highest <= rise * (1 + 1e-9) + 1e-14
        assert abs(function.value(at) - value) <= 1e-13
    if length * abs(function.frequency_rad_s) >= 2.001 * pi:
        assert found.maximum == abs(function.amplitude)
        assert found.minimum == -abs(function.amplitude)


def test_equal_extrema_return_the_first():
    assert Sine().extrema(0.0, 50.0) == Extrema(-1.0, 1.5 * pi, 1.0, 0.5 * pi)
    assert Sine(-1.0).extrema(0.0, 50.0) == Extrema(-1.0, 0.5 * pi, 1.0, 1.5 * pi)
    assert Cosine(2.0, 2.0).extrema(-0.5, 50.0) == Extrema(-2.0, 0.5 * pi, 2.0, 0.0)
    assert Constant(3.0).extrema(-1.0, 2.0) == Extrema(3.0, -1.0, 3.0, -1.0)
    bump = Polynomial((1.0, 0.0, -2.0, 0.0, 1.0))
    assert bump.extrema(-2.0, 2.0) == Extrema(0.0, -1.0, 9.0, -2.0)
    teeth = Piecewise.of_polynomials(range(5), [[0.0, 1.0], [1.0, -1.0]] * 2)
    assert teeth.extrema() == Extrema(0.0, 0.0, 1.0, 1.0)
    assert teeth.extrema(0.5, 3.5) == Extrema(0.0, 2.0, 1.0, 1.0)


def test_equal_searched_extrema_return_one_of_them():
    for first, step, function in (
        (0.0, pi, Cosine() * Cosine()),
        (0.5 * pi, 2 * pi, Exponential().after(Sine())),
    ):
        at = function.extrema(1.0, 60.0).at_maximum
        number = round((at - first) / step)
        assert number >= 0
        assert at == pytest.approx(first + number * step, abs=1e-6)


def test_extrema_of_other_functions_equal_hand_results():
    wedge = Polynomial((0.0, 1.0)) * Exponential(1.0, -1.0)
    found = wedge.extrema(0.0, 20.0)
    assert found.maximum == pytest.approx(1.0 / e, rel=1e-12)
    assert found.at_maximum == pytest.approx(1.0, abs=1e-6)
    assert (found.minimum, found.at_minimum) == (0.0, 0.0)
    gauss = Exponential(1.0, -1.0).after(Polynomial((0.0, 0.0, 1.0)))
    steepest = gauss.derivative().extrema(-5.0, 5.0)
    assert steepest.maximum == pytest.approx(sqrt(2.0 / e), rel=1e-12)
    assert steepest.at_maximum == pytest.approx(-sqrt(0.5), abs=1e-6)
    damped = Exponential(1.0, -0.1) * Cosine(1.0, 2.0)
    found = damped.extrema(0.5, 30.0)  # extreme where tan 2x = -0.05
    assert found.at_minimum == pytest.approx((pi - np.arctan(0.05)) / 2, abs=1e-6)
    assert found.minimum == pytest.approx(damped.value((pi - np.arctan(0.05)) / 2), rel=1e-12)


def test_extrema_find_a_narrow_pulse_among_waves():
    """Search for a pulse narrower than any sampling, found by bounds."""
    pulse = Exponential(3.0, -1e8).after(Polynomial((0.0, 0.0, 1.0), about=7.123))
    found = (Sine(1.0, 5.0) + pulse).extrema(0.0, 10.0)
    top = Sine(1.0, 5.0).value(7.123) + 3.0
    assert found.maximum == pytest.approx(top, rel=1e-6)
    assert found.at_maximum == pytest.approx(7.123, abs=1e-6)
    assert found.minimum == -1.0


def test_extrema_at_a_jump_include_the_left_limit():
    saw = Piecewise.of_polynomials((0.0, 1.0, 2.0), [(0.0, 1.0), (0.0, 1.0)])
    for function in (saw, saw + Sine(1e-9), saw * (Exponential(1e-12) + 1.0)):
        found = function.extrema(0.25, 1.5)
        assert found.maximum == pytest.approx(1.0, abs=1e-8)
        assert found.at_maximum == nextafter(1.0, 0.0)
        assert abs(found.minimum) <= 1e-8
        assert found.at_minimum == 1.0
    assert saw.extrema(0.25, 1.0) == Extrema(0.0, 1.0, nextafter(1.0, 0.0), nextafter(1.0, 0.0))
    assert saw.extrema(0.25, 1.0 - 2.0**-20).minimum == 0.25


def test_extrema_find_a_jump_in_a_composition():
    step = Sampled((0.0, 1.0, 2.0), (0.0, 5.0, 1.0), Interpolation.NEAREST)
    narrow = step.after(Cosine(0.25 + 1e-6, 1.0) + 0.25)  # above 1/2 near 0 only
    found = narrow.extrema(-1.0, 2.0)
    assert (found.minimum, found.maximum) == (0.0, 5.0)
    assert abs(found.at_maximum) <= 0.003


@given(made_of_polynomials, ARGUMENTS)
def test_extrema_at_a_single_argument_are_its_value(function, x):
    assume(function.domain[0] <= x <= function.domain[1])
    value = function.value(x)
    assert function.extrema(x, x) == Extrema(value, x, value, x)
    assert function.bounds(x, x) == (value, value)


def test_extrema_default_to_the_whole_domain():
    ramp = Piecewise.of_polynomials((0.0, 1.0, 3.0), [(0.0, 0.0, 0.5), (0.5, 1.0)])
    assert ramp.extrema() == ramp.extrema(0.0, 3.0) == Extrema(0.0, 0.0, 2.5, 3.0)
    assert ramp.extrema(high=1.0).maximum == 0.5
    assert ramp.extrema(2.0).minimum == 1.5


def test_extrema_over_unbounded_or_reversed_interval_raise():
    with pytest.raises(DomainError):
        Sine().extrema()
    with pytest.raises(DomainError):
        Polynomial((1.0, 2.0)).bounds(0.0)
    with pytest.raises(UsageError, match="is empty"):
        Sine().extrema(2.0, 1.0)


def test_extrema_with_cancelling_terms_are_less_accurate(monkeypatch):
    monkeypatch.setattr(search, "ACCURACIES", ((64, 1e-12), (128, 1e-9), (2048, 1e-6)))
    one = Sine(1.0, 2.0) * Sine(1.0, 2.0) + Cosine(1.0, 2.0) * Cosine(1.0, 2.0)
    found = one.extrema(0.0, 1.0)
    assert found.minimum == pytest.approx(1.0, abs=1e-6)
    assert found.maximum == pytest.approx(1.0, abs=1e-6)


class Unbounded(Function):
    """A function without knowledge of its values between two arguments."""

    __slots__ = ()

    @property
    def domain(self):
        return 0.0, 1.0

    def value(self, argument):
        return exp(argument)

    def _values(self, arguments):
        return np.exp(arguments)

    def _derivative(self, order):
        return self

    def integral(self):
        return self

    def _bounds(self, low, high):
        return -inf, inf

    def _parameters(self):
        return ()


def test_extrema_without_bounds_raise(monkeypatch):
    monkeypatch.setattr(search, "ACCURACIES", ((64, 1e-12), (128, 1e-6)))
    with pytest.raises(UsageError, match="its bounds are too wide"):
        Unbounded().extrema()
