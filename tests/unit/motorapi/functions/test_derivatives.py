"""Derivatives of every kind and order, against power series and exact arithmetic."""

import pickle

import numpy as np
import pytest
from hypothesis import assume, event, given
from hypothesis import strategies as st

from motorhil.motorapi.functions import (
    Constant,
    Cosine,
    Exponential,
    Function,
    Interpolation,
    Piecewise,
    Polynomial,
    Sampled,
    Sine,
)
from tests.support.mathematics import jets
from tests.support.mathematics.strategies import (
    ARGUMENTS,
    HIGH,
    LOW,
    any_function,
    any_smooth,
    made_of_polynomials,
    polynomials,
)

ORDERS = st.integers(1, 4)


@given(any_function, ORDERS, ARGUMENTS)
def test_derivatives_equal_those_of_the_power_series(function, order, x):
    low, high = function.domain
    assume(low <= x <= high)
    event(type(function).__name__)
    expected, size = jets.derivative(function, order, x)
    # Rounding errors of the series grow with the order; the size counts its terms.
    assert abs(function.derivative(order).value(x) - expected) <= 1e-12 * size


@given(any_smooth, any_smooth, ARGUMENTS)
def test_sum_has_the_sum_of_the_derivatives(f, g, x):
    whole = (f + g).derivative().value(x)
    parts = f.derivative().value(x) + g.derivative().value(x)
    size = jets.derivative(f, 1, x)[1] + jets.derivative(g, 1, x)[1]
    assert abs(whole - parts) <= 1e-12 * size


@given(polynomials, ORDERS)
def test_polynomial_derivative_equals_numpy(function, order):
    expected = np.polynomial.Polynomial(function.coefficients).deriv(order)
    found = function.derivative(order)
    assert isinstance(found, Polynomial)
    # k!/(k-n)! is one product here, several in numpy: an ulp each.
    assert np.allclose(found.coefficients, expected.trim().coef, rtol=1e-15 * (order + 1), atol=0.0)


@given(made_of_polynomials, ORDERS)
def test_derivatives_of_polynomials_stay_polynomials(function, order):
    assert isinstance(function.derivative(order), Polynomial | Piecewise)
    assert isinstance(function.integral(), Polynomial | Piecewise)


def test_derivative_beyond_the_degree_is_zero():
    assert Polynomial((1.0, 2.0, 3.0), about=1.0).derivative(3) == Constant(0.0)
    assert Constant(5.0).derivative() == Constant(0.0)


def test_wave_turns_by_a_quarter_with_each_order():
    for order, expected in enumerate(
        [Sine(3.0, 2.0, 0.5), Cosine(6.0, 2.0, 0.5), Sine(-12.0, 2.0, 0.5), Cosine(-24.0, 2.0, 0.5)]
    ):
        assert Sine(3.0, 2.0, 0.5).derivative(order) == expected
    assert Sine(1.0, 1.0).derivative(4) == Sine(1.0, 1.0)
    assert Cosine(1.0, 1.0).derivative(4) == Cosine(1.0, 1.0)
    assert Exponential(3.0, -0.5).derivative(3) == Exponential(-0.375, -0.5)


def test_derivative_at_a_break_is_from_the_right():
    kink = Piecewise.of_polynomials((0.0, 1.0, 2.0), [(0.0, 1.0), (1.0, -2.0)])
    slope = kink.derivative()
    before = float(np.nextafter(1.0, 0.0))
    assert [slope.value(x) for x in (0.0, before, 1.0, 2.0)] == [1.0, 1.0, -2.0, -2.0]


def test_derivative_of_a_jump_has_no_impulse():
    step = Sampled((0.0, 1.0, 2.0), (5.0, 7.0, 6.0), Interpolation.NEAREST)
    assert step.derivative()(np.linspace(0.0, 2.0, 9)).tolist() == [0.0] * 9


class Square(Function):
    """A foreign class with the minimum of methods."""

    __slots__ = ()

    @property
    def domain(self):
        return -4.0, 4.0

    def value(self, argument):
        return self._inside(argument) ** 2

    def _values(self, arguments):
        return arguments**2

    def _derivative(self, order):
        return Polynomial((0.0, 0.0, 1.0)).derivative(order)

    def integral(self):
        return Polynomial((64.0 / 3.0, 0.0, 0.0, 1.0 / 3.0)).restricted(-4.0, 4.0)

    def _bounds(self, low, high):
        return (0.0 if low <= 0.0 <= high else min(low**2, high**2)), max(low**2, high**2)

    def _parameters(self):
        return ()


def test_foreign_function_class_supports_all_operations():
    square = Square()
    assert square == Square()
    assert hash(square) == hash(Square())
    assert repr(square) == "Square()"
    found = square.extrema(-1.0, 3.0)
    assert (found.maximum, found.at_maximum) == (9.0, 3.0)
    assert abs(found.minimum) <= 1e-11  # relative to 9, by the accuracy of the search
    assert square.integrate(0.0, 3.0) == pytest.approx(9.0, rel=1e-13)
    line = Polynomial((1.0, 2.0))
    assert (square * 2.0 + line).value(3.0) == 25.0
    assert (square * line).derivative().value(2.0) == 2 * 2 * 5 + 4 * 2
    assert square.shifted(1.0).value(3.0) == square.scaled(-2.0).value(-4.0) == 4.0
    assert square.scaled(2.0).derivative().value(2.0) == 1.0
    assert square.after(line).value(1.0) == 9.0
    assert line.after(square).value(2.0) == 9.0
    assert square.restricted(0.0, 1.0)(np.array([0.5, 1.0])).tolist() == [0.25, 1.0]


def test_derivatives_exist_everywhere_in_the_domain():
    for function in (Sampled((LOW, 0.0, HIGH), (1.0, 2.0, 0.0)), Sine()):
        for order in range(8):
            for x in (LOW, 0.0, HIGH):
                function.derivative(order).value(x)


def test_derivatives_of_many_pieces_are_made_once():
    x = [0.5 * k for k in range(200)]
    curve = Sampled(x, [(k % 7) * 0.25 for k in range(200)])
    for order in (1, 2, 3):
        assert curve.derivative(order) is curve.derivative(order)
    again = pickle.loads(pickle.dumps(curve))
    assert again == curve
    assert again.derivative(2) == curve.derivative(2)
    assert again.derivative(2) is not curve.derivative(2)
