"""Exact arithmetic for polynomial coefficients, with one final rounding.

A double is a rational number, and so are the coefficients of a polynomial. All operations here use
integers over a common denominator. In floating point, a change of the expansion point, a
composition or an integration loses digits by cancellation. Coefficients are in ascending order of a
local argument: p = c0 + c1 t + c2 t² + ..., where t is x minus the expansion point.
"""

from collections.abc import Iterable
from fractions import Fraction
from math import lcm
from typing import final


@final
class Exact:
    """A polynomial without rounding; immutable.

    Attributes:
        numbers: the coefficients, ascending, times the denominator.
        denominator: > 0.
    """

    __slots__ = ("denominator", "numbers")

    def __init__(self, numbers: list[int], denominator: int) -> None:
        self.numbers = numbers
        self.denominator = denominator

    @classmethod
    def of(cls, coefficients: Iterable[float | Fraction]) -> "Exact":
        """Return the polynomial with these coefficients, at least one, taken exactly."""
        ratios = [c.as_integer_ratio() for c in coefficients]
        common = lcm(*(d for _, d in ratios))
        return cls([n * (common // d) for n, d in ratios], common)

    def rounded(self) -> tuple[float, ...]:
        """Return the nearest doubles; infinite on overflow."""
        return tuple(_nearest(n, self.denominator) for n in self.numbers)

    def coefficient(self, power: int) -> Fraction:
        """Return the coefficient of `power`; 0 beyond the degree."""
        if power >= len(self.numbers):
            return Fraction(0)
        return Fraction(self.numbers[power], self.denominator)

    def moved(self, way: float | Fraction) -> "Exact":
        """Return the same polynomial about a point that lies `way` further to the right."""
        p, q = way.as_integer_ratio()
        if p == 0 or len(self.numbers) == 1:
            return self
        # In t = s / q the coefficients are integers, and s moves by an integer.
        degree = len(self.numbers) - 1
        numbers = [n * q ** (degree - k) for k, n in enumerate(self.numbers)]
        for start in range(degree):
            for k in range(degree - 1, start - 1, -1):
                numbers[k] += p * numbers[k + 1]
        return Exact([n * q**k for k, n in enumerate(numbers)], self.denominator * q**degree)

    def plus(self, other: "Exact") -> "Exact":
        """Return the sum of two polynomials about the same point."""
        common = lcm(self.denominator, other.denominator)
        left = [n * (common // self.denominator) for n in self.numbers]
        right = [n * (common // other.denominator) for n in other.numbers]
        longer, shorter = (left, right) if len(left) >= len(right) else (right, left)
        for k, n in enumerate(shorter):
            longer[k] += n
        return Exact(longer, common)

    def times(self, other: "Exact") -> "Exact":
        """Return the product of two polynomials about the same point."""
        product = [0] * (len(self.numbers) + len(other.numbers) - 1)
        for i, a in enumerate(self.numbers):
            if a:
                for j, b in enumerate(other.numbers):
                    product[i + j] += a * b
        return Exact(product, self.denominator * other.denominator)

    def after(self, inner: "Exact") -> "Exact":
        """Return the composition of this polynomial, about 0, with `inner`."""
        total = Exact(self.numbers[-1:], self.denominator)
        for n in reversed(self.numbers[:-1]):
            total = total.times(inner).plus(Exact([n], self.denominator))
        return total

    def integral(self) -> "Exact":
        """Return the antiderivative that is 0 at 0."""
        common = lcm(*range(1, len(self.numbers) + 1))
        raised = [n * (common // k) for k, n in enumerate(self.numbers, 1)]
        return Exact([0, *raised], self.denominator * common)

    def value(self, local: Fraction) -> Fraction:
        """Return the value at a local argument."""
        p, q = local.as_integer_ratio()
        total, power = 0, 1
        for n in reversed(self.numbers):
            total = total * p + n * power
            power *= q
        return Fraction(total * q, self.denominator * power)


def nearest(number: Fraction) -> float:
    """Return the nearest double; infinite on overflow."""
    return _nearest(number.numerator, number.denominator)


def _nearest(numerator: int, denominator: int) -> float:
    try:
        return numerator / denominator  # for integers, Python's division gives the nearest double
    except OverflowError:
        return float("inf") if numerator > 0 else float("-inf")
