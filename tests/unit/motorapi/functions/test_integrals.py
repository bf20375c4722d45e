"""Integrals: exact for piecewise polynomials, else compared with quadrature."""

import itertools
from fractions import Fraction
from math import exp, inf, log, sqrt

import numpy as np
import pytest
from hypothesis import assume, given, reject
from hypothesis import strategies as st

from motorhil.motorapi.errors import DomainError, UsageError
from motorhil.motorapi.functions import (
    Constant,
    Cosine,
    Exponential,
    Integral,
    Interpolation,
    Piecewise,
    Polynomial,
    Sampled,
    Scaled,
    Shifted,
    Sine,
)
from tests.support.mathematics import jets
from tests.support.mathematics.strategies import (
    ARGUMENTS,
    any_function,
    any_smooth,
    piecewise,
    polynomials,
    simple,
)


def exactly(function, low, high):
    """Return the integral of a polynomial in rational arithmetic, term by term."""
    a, b = (Fraction(x) - Fraction(function.about) for x in (low, high))
    return sum(
        Fraction(c) * (b ** (k + 1) - a ** (k + 1)) / (k + 1)
        for k, c in enumerate(function.coefficients)
    )


def of_size(function, low, high):
    """Return the integral of the absolute value, by many samples, as a scale of errors."""
    x = np.linspace(low, high, 1001)
    return abs(high - low) * float(np.abs(function(x)).mean())


@given(polynomials, ARGUMENTS, ARGUMENTS)
def test_polynomial_integral_is_the_nearest_double(function, low, high):
    assert function.integrate(low, high) == float(exactly(function, low, high))


@given(piecewise(), ARGUMENTS, ARGUMENTS)
def test_piecewise_integral_is_the_nearest_double(function, low, high):
    low, high = min(low, high), max(low, high)
    cuts = [low, *(b for b in function.breaks if low < b < high), high]
    exact = sum(exactly(jets.piece_at(function, a), a, b) for a, b in itertools.pairwise(cuts))
    assert function.integrate(low, high) == float(exact)
    assert function.integrate(high, low) == -float(exact)


@given(any_function, ARGUMENTS, ARGUMENTS)
def test_integrals_equal_quadpack(function, low, high):
    from scipy import integrate

    low, high = min(low, high), max(low, high)
    assume(high - low > 1e-3)
    assume(function.domain[0] <= low and high <= function.domain[1])
    cuts = [low, *function.breaks_between(low, high), high]
    parts = [
        integrate.quad(function.value, a, b, epsabs=0.0, epsrel=1e-13, limit=200, full_output=1)[0]
        for a, b in itertools.pairwise(cuts)
    ]
    # The accuracy of QUADPACK itself, where a function nearly cancels.
    slack = 1e-12 * of_size(function, low, high) + 1e-15
    assert abs(function.integrate(low, high) - sum(parts)) <= slack


@given(any_function, ARGUMENTS)
def test_derivative_of_the_integral_is_the_function(function, x):
    assume(function.domain[0] <= x <= function.domain[1])
    size = jets.jet(function, x, 0)[1][0]
    assert abs(function.integral().derivative().value(x) - function.value(x)) <= 1e-13 * size


@given(simple, ARGUMENTS, ARGUMENTS)
def test_integral_grows_by_the_definite_integral(function, low, high):
    whole = function.integral()
    grown = whole.value(high) - whole.value(low)
    size = abs(whole.value(high)) + abs(whole.value(low)) + of_size(function, low, high)
    if isinstance(function, Exponential | Sine | Cosine):
        rate = function.rate if isinstance(function, Exponential) else function.frequency_rad_s
        size += abs(function.value(0.0) / rate) + 4.0 * abs(function.amplitude / rate)
    assert abs(grown - function.integrate(low, high)) <= 1e-13 * (size + 1.0)


@given(any_function)
def test_integral_is_zero_at_the_domain_begin_or_at_zero(function):
    whole = function.integral()
    assert whole.domain == function.domain
    low, high = function.domain
    origin = low if low > -inf else min(0.0, high)
    size = 1.0 + abs(whole.value(min(max(1.0, low), high)))
    assert abs(whole.value(origin)) <= 1e-13 * size


def test_integral_is_continuous_over_jumps():
    step = Sampled((0.0, 2.0, 4.0), (1.0, 3.0, -2.0), Interpolation.NEAREST)
    assert step.integral()(np.array([0.0, 1.0, 2.0, 3.0, 4.0])).tolist() == [0, 1, 4, 7, 5]


def test_half_open_domain_has_an_integral():
    held = Piecewise((-inf, 0.0, inf), (Constant(1.0), Polynomial((1.0, 1.0))))
    whole = held.integral()
    assert [whole.value(x) for x in (-2.0, 0.0, 2.0)] == [-2.0, 0.0, 4.0]
    early = Piecewise((-inf, -3.0), (Constant(2.0),)).integral()
    assert [early.value(x) for x in (-4.0, -3.0)] == [-2.0, 0.0]
    assert held.integrate(-2.0, 2.0) == 6.0
    slow = Integral(Piecewise((-inf, -3.0), (Constant(2.0),)))
    assert [slow.value(x) for x in (-4.0, -3.0)] == [-2.0, 0.0]


def test_integral_of_small_distant_steps_keeps_its_digits():
    # A difference of antiderivatives would lose all digits.
    for at in (1e6, 1e9):
        for function, slope in ((Sine(1.0, 1e-3), 0.0), (Polynomial((0.0, 0.0, 1.0)), 2.0)):
            width = 2.0**-10
            middle = function.value(at + 0.5 * width)
            expected = width * middle + slope * width**3 / 24.0
            assert function.integrate(at, at + width) == pytest.approx(expected, rel=1e-12)
    decay = Exponential(1.0, -1.0)
    assert decay.integrate(30.0, 30.0 + 2.0**-20) == pytest.approx(
        exp(-30.0) * (2.0**-20 - 2.0**-41), rel=1e-12
    )
    assert Exponential(1.0, -100.0).integrate(0.0, 1e3) == pytest.approx(0.01, rel=1e-15)
    assert Exponential(1e-300, 1.0).integrate(0.0, 700.0) == pytest.approx(
        1e-300 * exp(700.0), rel=1e-15
    )


def test_integrals_without_closed_form_equal_known_values():
    # The Gaussian over the line (from -8 to 8, with less than 1e-28 outside), and others.
    gauss = Exponential(1.0, -1.0).after(Polynomial((0.0, 0.0, 1.0)))
    assert gauss.integrate(-8.0, 8.0) == pytest.approx(sqrt(np.pi), rel=1e-13)
    damped = Sine(1.0, 3.0) * Exponential(1.0, -0.5)
    exact = 3.0 / 9.25  # integral of e^(-x/2) sin 3x from 0 to infinity: b / (a² + b²)
    assert damped.integrate(0.0, 150.0) == pytest.approx(exact, rel=1e-13)
    wedge = Polynomial((0.0, 1.0)) * Cosine(1.0, 100.0)
    exact = (np.cos(1000.0) - 1.0) / 1e4 + 10.0 * np.sin(1000.0) / 100.0
    assert wedge.integrate(0.0, 10.0) == pytest.approx(exact, abs=1e-13 * 50.0 * 2 / np.pi)
    logistic = Exponential(1.0, -1.0) + 1.0
    assert logistic.integrate(0.0, 2.0) == pytest.approx(3.0 - exp(-2.0), rel=1e-15)
    assert log(logistic.integrate(0.0, 1.0)) == pytest.approx(log(2.0 - exp(-1.0)), rel=1e-15)


@pytest.mark.parametrize("factor", [2.0, -0.5])
@pytest.mark.parametrize("bounded", [True, False])
def test_moved_functions_have_moved_integrals(factor, bounded):
    inner = Sine(1.0, 3.0) * Exponential(1.0, 0.25)
    if bounded:
        inner = Integral(inner.restricted(-8.0, 8.0))
    for function in (Scaled(inner, factor), Shifted(inner, factor), Shifted(inner, 1.0)):
        whole = function.integral()
        low = function.domain[0]
        assert abs(whole.value(low if bounded else 0.0)) <= 1e-12
        for x in (-1.5, 0.0, 2.5):
            assert whole.derivative().value(x) == pytest.approx(function.value(x), rel=1e-13)
            grown = whole.value(x) - whole.value(-2.0)
            assert grown == pytest.approx(function.integrate(-2.0, x), rel=1e-11, abs=1e-12)
            for one in (factor, 1.0 / factor):
                # Substitution: a scaled function covers as much as its argument.
                wide = function.scaled(one).integrate(-0.5 * abs(one), 0.5 * abs(one))
                assert wide == pytest.approx(
                    abs(one) * function.integrate(-0.5, 0.5), rel=1e-11, abs=1e-12
                )


def test_integral_includes_a_known_spike():
    # A spike of width 1e-9: no quadrature node would hit it by chance.
    breaks = (0.0, 0.7, 0.7 + 1e-9, 2.0)
    spike = Piecewise(breaks, (Constant(1.0), Constant(1e9), Constant(1.0)))
    width = breaks[2] - breaks[1]
    exact = exp(2.0) - 1.0 + (1e9 - 1.0) * width * exp(0.7 + 0.5e-9)
    assert (spike * Exponential()).integrate(0.0, 2.0) == pytest.approx(exact, rel=1e-13)


def test_integral_finds_an_unknown_jump():
    # The places where the inner function meets the breaks of the outer one are unknown.
    stairs = Sampled((0.0, 1.0, 2.0), (0.0, 1.0, 4.0), Interpolation.NEAREST)
    over = stairs.after(Sine(1.0, 1.0) + 1.0)  # 0 below sin = -1/2, 4 from sin = 1/2
    exact = 1.0 * (2 * np.pi / 3) + 4.0 * (2 * np.pi / 3)
    assert over.integrate(0.0, 2 * np.pi) == pytest.approx(exact, rel=1e-12)


@given(any_smooth, st.floats(-1.0, 1.0))
def test_integral_can_be_integrated_again(function, x):
    twice = Integral(function).integral()
    # Cauchy: the repeated integral is that of (x - t) f(t).
    way = Polynomial((x, -1.0))
    size = of_size(function, 0.0, x or 1.0)
    assert abs(twice.value(x) - (way * function).integrate(0.0, x)) <= 1e-12 * (size + 1e-3)


@given(any_smooth, st.floats(-3.0, 70.0), st.booleans())
def test_integral_values_do_not_depend_on_earlier_calls(function, x, bounded):
    if bounded:
        function = function.restricted(-3.0, 70.0)
    begin = -3.0 if bounded else 0.0
    try:
        for end in (-3.0, 70.0):
            function.integrate(begin, end)
    except UsageError as beyond:
        if "is too large" not in str(beyond):
            raise
        reject()  # e to a power above 709: no float holds the value
    fresh, used = Integral(function), Integral(function)
    for other in (-2.9, 69.0, 0.0, 33.3):
        used.value(other)
    assert used.value(x) == fresh.value(x)
    size = max(of_size(function, begin, at) for at in (x, 1.0, 70.0))
    assert abs(fresh.value(x) - function.integrate(begin, x)) <= 1e-12 * size


def test_integral_is_defined_at_its_ends_and_far_away():
    whole = Integral(Polynomial((1.0, 2.0)).restricted(-1.0, 3.0))
    assert [whole.value(x) for x in (-1.0, 1.0, 3.0)] == pytest.approx([0.0, 2.0, 12.0], abs=1e-14)
    far = Integral(Polynomial((1.0, 2.0)))
    for x in (-1e6, -4096.0, -4095.5, -1.0, 0.0, 0.5, 4095.5, 4096.0, 1e6):
        assert far.value(x) == pytest.approx(x + x * x, rel=1e-13)


def test_integral_beyond_the_domain_raises():
    with pytest.raises(DomainError):
        Sampled((0.0, 1.0), (0.0, 1.0)).integrate(0.0, 1.5)
