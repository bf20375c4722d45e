"""Taylor coefficients of a function without its derivatives: an oracle.

Arithmetic of truncated power series (automatic differentiation, forward): Griewank & Walther,
Evaluating Derivatives, 2nd ed. (2008), ch. 13. Each jet has a companion with the sizes of all
terms, which bounds the digits lost by rounding.
"""

from fractions import Fraction
from math import comb, cos, exp, factorial, pi, sin

from motorhil.motorapi.functions import (
    Composition,
    Cosine,
    Exponential,
    Piecewise,
    Polynomial,
    Product,
    Sampled,
    Scaled,
    Shifted,
    Sine,
    Sum,
)


def derivative(function, order, x):
    """Return (the derivative of that order at x, the size of its terms)."""
    values, sizes = jet(function, x, order)
    return values[order] * factorial(order), sizes[order] * factorial(order)


def jet(function, x, order):
    if isinstance(function, Polynomial):
        return polynomial(function, x, order)
    if isinstance(function, Piecewise):
        return jet(piece_at(function, x), x, order)
    if isinstance(function, Sampled):
        return jet(function.curve, x, order)
    if isinstance(function, Sine | Cosine):
        return wave(function, x, order)
    if isinstance(function, Exponential):
        top = function.amplitude * exp(function.rate * (x - function.about))
        values = [top * function.rate**k / factorial(k) for k in range(order + 1)]
        return values, [abs(v) for v in values]
    if isinstance(function, Sum):
        jets = [jet(term, x, order) for term in function.terms]
        return tuple(
            [sum(column) for column in zip(*side, strict=True)] for side in zip(*jets, strict=True)
        )
    if isinstance(function, Product):
        whole = [1.0] + [0.0] * order, [1.0] + [0.0] * order
        for factor in function.factors:
            its = jet(factor, x, order)
            whole = times(whole[0], its[0]), times(whole[1], its[1])
        return whole
    if isinstance(function, Composition):
        return composed(function, x, order)
    if isinstance(function, Shifted):
        return jet(function.function, x - function.offset, order)
    assert isinstance(function, Scaled)
    values, sizes = jet(function.function, x / function.factor, order)
    powers = [function.factor**-k for k in range(order + 1)]
    return (
        [v * p for v, p in zip(values, powers, strict=True)],
        [s * abs(p) for s, p in zip(sizes, powers, strict=True)],
    )


def piece_at(function, x):
    """Return the piece at x: from the right at a break, from the left at the end."""
    number = 0
    while number < len(function.pieces) - 1 and x >= function.breaks[number + 1]:
        number += 1
    return function.pieces[number]


def polynomial(function, x, order):
    local = Fraction(x) - Fraction(function.about)
    values, sizes = [], []
    for k in range(order + 1):
        terms = [
            Fraction(c) * comb(j, k) * local ** (j - k)
            for j, c in enumerate(function.coefficients)
            if j >= k
        ]
        values.append(float(sum(terms)))
        sizes.append(float(sum(abs(term) for term in terms)))
    return values, sizes


def wave(function, x, order):
    phase = function.frequency_rad_s * (x - function.about) + function.phase_rad
    shape = sin if isinstance(function, Sine) else cos
    sizes = [
        abs(function.amplitude * function.frequency_rad_s**k) / factorial(k)
        for k in range(order + 1)
    ]
    sign = 1.0 if function.frequency_rad_s > 0 else -1.0
    sign_0 = 1.0 if function.amplitude > 0 else -1.0
    values = [sign_0 * sign**k * size * shape(phase + k * pi / 2) for k, size in enumerate(sizes)]
    return values, [size * (1.0 + abs(phase)) for size in sizes]


def times(left, right):
    return [sum(left[i] * right[k - i] for i in range(k + 1)) for k in range(len(left))]


def composed(function, x, order):
    inner, inner_sizes = jet(function.inner, x, order)
    outer, outer_sizes = jet(function.outer, inner[0], order)
    # The uncertainty of the inner value moves the outer one by its slope.
    slope = jet(function.outer, inner[0], order + 1)[1]
    outer_sizes = [
        size + (k + 1) * slope[k + 1] * inner_sizes[0] for k, size in enumerate(outer_sizes)
    ]
    return (
        series([*outer], [0.0, *inner[1:]]),
        series(outer_sizes, [0.0, *inner_sizes[1:]]),
    )


def series(outer, inner):
    """Return outer(inner(h)), by Horner's scheme."""
    total = [outer[-1]] + [0.0] * (len(inner) - 1)
    for coefficient in reversed(outer[:-1]):
        total = times(total, inner)
        total[0] += coefficient
    return total
