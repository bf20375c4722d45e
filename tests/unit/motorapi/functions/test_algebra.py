"""Operators on functions: correct values, and the simplest form."""

from fractions import Fraction
from math import inf, nan

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from motorhil.motorapi.errors import DomainError, UsageError
from motorhil.motorapi.functions import (
    Composition,
    Constant,
    Cosine,
    Exponential,
    Interpolation,
    Piecewise,
    Polynomial,
    Product,
    Sampled,
    Sine,
    Sum,
)
from tests.support.mathematics import jets
from tests.support.mathematics.strategies import (
    ARGUMENTS,
    NUMBERS,
    any_function,
    any_smooth,
    made_of_polynomials,
    polynomials,
    tame,
)

RAMP = Piecewise.of_polynomials((0.0, 1.0, 3.0), [(0.0, 0.0, 0.5), (0.5, 1.0)])


def at(function, x):
    """Return (value, size of its terms), or None outside the domain."""
    assume(function.domain[0] <= x <= function.domain[1])
    (value, *_), (size, *_) = jets.jet(function, x, 0)
    return value, size


@given(any_function, any_function, ARGUMENTS)
def test_operators_on_functions_apply_to_their_values(f, g, x):
    (left, left_size), (right, right_size) = at(f, x), at(g, x)
    # Coefficients of merged polynomials are rounded at their expansion point; jets count the terms.
    assert abs((f + g).value(x) - (left + right)) <= 1e-12 * (left_size + right_size + 1.0)
    assert abs((f - g).value(x) - (left - right)) <= 1e-12 * (left_size + right_size + 1.0)
    size = max(1.0, left_size) * max(1.0, right_size)
    assert abs((f * g).value(x) - left * right) <= 1e-12 * size


@given(any_function, NUMBERS, ARGUMENTS)
def test_operators_accept_numbers(f, number, x):
    value, size = at(f, x)
    slack = 1e-12 * (size + abs(number)) * max(1.0, abs(number))
    for made, expected in (
        (f + number, value + number),
        (number + f, value + number),
        (f - number, value - number),
        (number - f, number - value),
        (number * f, number * value),
        (f * np.float64(number), number * value),
        (np.float64(number) * f, number * value),
        (np.float64(number) + f, value + number),
        (-f, -value),
        (+f, value),
    ):
        assert abs(made.value(x) - expected) <= slack
        assert made.domain == f.domain
    if abs(number) > 1e-3:
        assert abs((f / number).value(x) - value / number) <= 1e-12 * (size / abs(number))


@given(any_smooth, tame, ARGUMENTS)
def test_after_calls_the_outer_function_with_the_inner_value(outer, inner, x):
    made = Composition(outer, inner)
    expected, size = at(made, x)
    assert abs(outer.after(inner).value(x) - expected) <= 1e-12 * (size + 1.0)


@given(made_of_polynomials, made_of_polynomials)
def test_combinations_of_polynomials_stay_polynomials(f, g):
    for made in (f + g, f - g, f * g, 2.0 * f, f + 1.0, f.shifted(0.5), f.scaled(2.0)):
        assert isinstance(made, Polynomial | Piecewise | Sampled)
        assert not isinstance(made, Piecewise) or made.is_polynomial
    line = Polynomial((0.5, -2.0), about=0.25)
    assert isinstance(f.after(line), Polynomial | Piecewise)
    assert isinstance(Polynomial((1.0, 2.0, 3.0)).after(f), Polynomial | Piecewise)


@given(polynomials, polynomials, ARGUMENTS)
def test_combined_polynomials_are_rounded_once(f, g, x):
    point = Fraction(x)
    for made, expected in (
        (f + g, exactly(f, point) + exactly(g, point)),
        (f * g, exactly(f, point) * exactly(g, point)),
        (f.after(g), exactly(f, exactly(g, point))),
    ):
        terms = [
            abs(Fraction(c) * (point - Fraction(made.about)) ** k)
            for k, c in enumerate(made.coefficients)
        ]
        # Every coefficient is the nearest double: half an ulp of each term, evaluated exactly; or
        # nothing, if it is below all doubles.
        lost = Fraction(5e-324) * sum(abs(point - Fraction(made.about)) ** k for k in range(26))
        assert abs(exactly(made, point) - expected) <= Fraction(1, 2**53) * sum(terms) + lost
        assert made.about in (f.about, g.about) or made.degree == 0


def exactly(p, point):
    return sum(Fraction(c) * (point - Fraction(p.about)) ** k for k, c in enumerate(p.coefficients))


def test_sums_and_products_of_polynomials_equal_numpy():
    draw = np.random.default_rng(3)
    for _ in range(50):
        a, b = draw.normal(size=draw.integers(1, 6)), draw.normal(size=draw.integers(1, 6))
        f, g = np.polynomial.Polynomial(a), np.polynomial.Polynomial(b)
        for ours, theirs in (
            (Polynomial(a) + Polynomial(b), f + g),
            (Polynomial(a) * Polynomial(b), f * g),
            (Polynomial(a).after(Polynomial(b)), f(g)),
        ):
            found = np.zeros(len(theirs.coef))
            found[: len(ours.coefficients)] = ours.coefficients
            size = max(np.abs(theirs.coef).max(), 1.0)
            assert np.abs(found - theirs.coef).max() <= 1e-12 * size


def test_operators_make_the_simplest_function():
    assert Polynomial((1.0, 2.0)) - Polynomial((0.0, 2.0)) == Constant(1.0)
    assert Constant(2.0) * Constant(3.0) == Constant(6.0)
    assert Sine() * 2.0 == Sine(2.0)
    assert -Cosine(2.0) == Cosine(-2.0)
    assert 3.0 * Exponential(2.0, -1.0) == Exponential(6.0, -1.0)
    assert Sine() + 0.0 == Sine()
    assert Sine() * 1.0 == Sine()
    assert Sine(2.0, 3.0) + Sine(-0.5, 3.0) == Sine(1.5, 3.0)
    assert Sine(2.0, 3.0) - Sine(2.0, 3.0) == Constant(0.0)
    assert Exponential(1.0, 2.0) + Exponential(1.0, 2.0) == Exponential(2.0, 2.0)
    assert Sine() + Cosine() == Sum(Sine(), Cosine())
    assert Sine() + Cosine() + Exponential() == Sum(Sine(), Cosine(), Exponential())
    assert 1.0 + (Sine() + 2.0) + RAMP == Sum(Sine(), RAMP + 3.0)
    assert 2.0 * (Sine() + 1.0) == Sum(Sine(2.0), Constant(2.0))
    assert Sine() * Cosine() * RAMP * 2.0 == Product(Sine(2.0), Cosine(), RAMP)
    assert Sine() * RAMP * RAMP == Product(Sine(), RAMP * RAMP)
    assert Sine().after(Cosine()) * 2.0 == Composition(Sine(2.0), Cosine())


def test_combined_pieces_have_the_breaks_of_both():
    steps = Sampled((0.5, 1.5, 2.5), (1.0, 2.0, 3.0), Interpolation.NEAREST)
    made = RAMP + steps
    assert made.domain == (0.5, 2.5)
    assert made.breaks == (0.5, 1.0, 2.0, 2.5)
    assert made([0.5, 1.0, 2.0, 2.5]).tolist() == [1.125, 2.5, 4.5, 5.0]
    assert (RAMP * steps).value(2.0) == 4.5
    assert all(p.about == b for p, b in zip(made.pieces, made.breaks, strict=False) if p.degree)


def test_linear_inner_function_moves_the_breaks():
    twice = RAMP.after(Polynomial((1.0, 2.0)))
    assert twice.breaks == (-0.5, 0.0, 1.0)
    assert twice([-0.25, 0.0, 0.5]).tolist() == [0.125, 0.5, 1.5]
    back = RAMP.after(Polynomial((3.0, -1.0)))
    assert back.breaks == (0.0, 2.0, 3.0)
    assert back([0.0, 1.0, 2.5]).tolist() == [2.5, 1.5, 0.125]
    held = Piecewise((-inf, 0.0, inf), (Constant(1.0), Constant(2.0)))
    assert held.after(Polynomial((1.0, -1.0))).breaks == (-inf, 1.0, inf)


def test_operators_without_common_domain_raise():
    for make in (
        lambda: RAMP + RAMP.shifted(3.0),
        lambda: RAMP * RAMP.shifted(-4.0),
        lambda: Sum(RAMP, Sine(), RAMP.shifted(5.0)),
        lambda: (RAMP * Sine()) + (RAMP * Sine()).shifted(3.0),
    ):
        with pytest.raises(UsageError, match="no interval in common"):
            make()


def test_compose_with_inner_leaving_outer_domain_raises():
    Composition(RAMP, Sine(1.5, 1.0, 0.0) + 1.5)  # permitted with an unbounded domain
    with pytest.raises(DomainError, match=r"the argument 3\.5 lies outside") as raised:
        RAMP.after((Sine(2.0) + 1.5).restricted(0.0, 2.0))
    assert (raised.value.argument, raised.value.low, raised.value.high) == (3.5, 0.0, 3.0)
    assert repr(0.5 * np.pi) in str(raised.value)


def test_inner_value_outside_error_names_both_arguments():
    far = RAMP.after(Sine(4.0))
    for ask in (far.value, lambda x: far([0.1, x]), lambda x: far.extrema(0.0, x)):
        with pytest.raises(DomainError) as raised:
            ask(0.5 * np.pi)
        assert raised.value.argument == 4.0
        assert repr(0.5 * np.pi) in str(raised.value)
        assert "Sine(4.0" in str(raised.value)


def test_inner_value_outside_by_rounding_counts_as_the_end():
    outer = Piecewise((0.0, 0.3), (Sine(),))
    inner = Polynomial((0.0, 0.1)).after(Cosine(1.0) + 2.0)  # 0.1 * 3 is slightly above 0.3
    assert inner.value(0.0) > 0.3
    made = outer.after(inner)
    assert made.value(0.0) == outer.value(0.3)
    assert made([0.0, 1.0])[0] == outer([0.3])[0]
    assert made.extrema(0.0, 1.0).maximum == outer.value(0.3)


@pytest.mark.parametrize("bad", ["2", None, [1.0, 2.0], np.array([1.0, 2.0]), nan])
def test_operators_reject_other_operands(bad):
    for apply in (
        lambda f, x: f + x,
        lambda f, x: x + f,
        lambda f, x: f * x,
        lambda f, x: x * f,
        lambda f, x: f - x,
        lambda f, x: x - f,
    ):
        with pytest.raises(TypeError):
            apply(RAMP, bad)


@pytest.mark.parametrize("bad", [0.0, nan, "2", RAMP])
def test_functions_are_divisible_by_numbers_only(bad):
    with pytest.raises(UsageError):
        RAMP / bad


@pytest.mark.parametrize(
    "make",
    [
        lambda: Constant(nan),
        lambda: Constant(inf),
        lambda: Constant("1"),
        lambda: Polynomial(()),
        lambda: Polynomial(3.0),
        lambda: Polynomial((1.0, inf)),
        lambda: Polynomial((1.0,), nan),
        lambda: Sine(nan),
        lambda: Sine(1.0, 0.0),
        lambda: Cosine(1.0, 1.0, inf),
        lambda: Exponential(0.0),
        lambda: Exponential(1.0, 0.0),
        lambda: Exponential(1.0, 1.0, nan),
        lambda: Sum(),
        lambda: Sum(Sine(), 1.0),
        lambda: Product(1.0, Sine()),
        lambda: Composition(Sine(), 2.0),
        lambda: RAMP + inf,
        lambda: Polynomial((1.0, 1e300)) * Polynomial((1.0, 1e300)),
    ],
)
def test_functions_with_invalid_parameters_raise(make):
    with pytest.raises(UsageError):
        make()


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_addition_of_distant_polynomials_keeps_the_digits(place, other):
    cubic = Polynomial((1.0, -2.0, 3.0, 0.5), about=place)
    made = cubic + Polynomial((0.25, 1.0), about=other)
    for local in (0.0, 0.125, 1.0):
        x = place + local
        exact = exactly(cubic, Fraction(x)) + exactly(Polynomial((0.25, 1.0), other), Fraction(x))
        assert abs(made.value(x) - exact) <= 1e-14 * (10.0 + abs(place) + abs(other))
