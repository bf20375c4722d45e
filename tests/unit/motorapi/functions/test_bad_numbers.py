"""Numbers beyond all floats, and non-numbers: always an error of our own."""

import pytest

from motorhil.motorapi import UsageError
from motorhil.motorapi.functions import (
    DomainError,
    Exponential,
    Integral,
    Interpolation,
    Piecewise,
    Polynomial,
    Sampled,
    Sine,
)

HUGE = 10**400
FUNCTIONS = (
    Sine(2.0, 3.0),
    Exponential(1.0, -2.0),
    Polynomial((0.0, 1.0)),
    Polynomial((0.0, 1.0)).restricted(-1.0, 1.0),
    Sine() * Exponential(),
    Sine().after(Polynomial((0.0, 0.0, 1.0))),
)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_integer_beyond_all_floats_is_outside_every_domain(function):
    with pytest.raises(DomainError, match="the argument -inf lies outside"):
        function(-HUGE)
    with pytest.raises(UsageError, match="is not an array of numbers"):
        function([0.0, HUGE])
    with pytest.raises(DomainError, match="the argument inf lies outside"):
        function.restricted(-1.0, 1.0).value(HUGE)


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("factor", [HUGE, "1", None, [1.0, 2.0], 1j])
def test_factor_must_be_a_finite_number(function, factor):
    with pytest.raises(UsageError, match="not a finite number"):
        function.times(factor)


@pytest.mark.parametrize("function", [Sine(1.0, 1e200), Exponential(1.0, 1e200)])
def test_derivative_beyond_all_floats_raises(function):
    with pytest.raises(UsageError, match="its derivative of this order is too large"):
        function.derivative(2)


def test_integral_beyond_all_floats_raises():
    product = Sine() * Exponential()
    with pytest.raises(UsageError, match=r"integral from 0\.0 to 1e\+308 is too large"):
        product.integrate(0.0, 1e308)
    with pytest.raises(UsageError, match="is too large"):
        Integral(product).value(1e308)


def test_samples_too_near_or_too_far_raise():
    for apart in (1e-300, 1e308):
        with pytest.raises(UsageError, match="distance of two samples is too small or too large"):
            Sampled([0.0, apart], [1.0, 2.0], Interpolation.QUINTIC)


def test_breaks_and_coefficients_must_be_sequences():
    with pytest.raises(UsageError, match="give two sequences"):
        Piecewise.of_polynomials(1.0, [[1.0]])
    with pytest.raises(UsageError, match="give two sequences"):
        Piecewise.of_polynomials([0.0, 1.0], None)
