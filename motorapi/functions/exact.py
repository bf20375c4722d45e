"""Coefficients of polynomials in exact arithmetic: every result is rounded once.

A double is a rational number; so are a polynomial's coefficients, and what is written here is
done in rational numbers. Shifting a polynomial to another place by floats instead loses digits
by cancellation, as do composing and integrating it. Coefficients ascend; `about` is where the
local argument is 0: p(x) = c0 + c1 (x - about) + c2 (x - about)² + ...
"""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import TypeAlias

Rationals: TypeAlias = list[Fraction]


def rational(coefficients: Iterable[float]) -> Rationals:
    """The coefficients as what they are."""
    return [Fraction(c) for c in coefficients]


def rounded(coefficients: Iterable[Fraction]) -> tuple[float, ...]:
    """The nearest doubles; infinite where there is none."""
    return tuple(nearest(c) for c in coefficients)


def nearest(number: Fraction) -> float:
    """The nearest double; infinite if it is too large."""
    try:
        return float(number)
    except OverflowError:
        return float("inf") if number > 0 else float("-inf")


def moved(coefficients: Rationals, way: Fraction) -> Rationals:
    """The coefficients about a place `way` further to the right (Horner's scheme, n²/2 steps)."""
    shifted = list(coefficients)
    if not way:
        return shifted
    for start in range(len(shifted) - 1):
        for k in range(len(shifted) - 2, start - 1, -1):
            shifted[k] += way * shifted[k + 1]
    return shifted


def plus(left: Rationals, right: Rationals) -> Rationals:
    """The coefficients of the sum, both about one place."""
    longer, shorter = (left, right) if len(left) >= len(right) else (right, left)
    return [c + shorter[k] if k < len(shorter) else c for k, c in enumerate(longer)]


def times(left: Rationals, right: Rationals) -> Rationals:
    """The coefficients of the product, both about one place."""
    product = [Fraction(0)] * (len(left) + len(right) - 1)
    for i, a in enumerate(left):
        if a:
            for j, b in enumerate(right):
                product[i + j] += a * b
    return product


def composed(outer: Rationals, inner: Rationals) -> Rationals:
    """The coefficients of outer(inner(t)); outer is about 0."""
    result = [outer[-1]]
    for c in reversed(outer[:-1]):
        result = times(result, inner)
        result[0] += c
    return result


def integral_between(coefficients: Sequence[float], low: Fraction, high: Fraction) -> Fraction:
    """The definite integral between two local arguments."""
    total_low = total_high = Fraction(0)
    for k in range(len(coefficients) - 1, -1, -1):
        term = Fraction(coefficients[k]) / (k + 1)
        total_low = (total_low * low) + term
        total_high = (total_high * high) + term
    return total_high * high - total_low * low
