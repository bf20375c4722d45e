"""Polynomial arithmetic: extrema and ranges without a miss, exact coefficients.

*Extrema.* Between two neighbouring zeros of p'' the derivative p' is monotone and has at most one
zero. So the zeros of p' are found by their signs once those of p'' are known, those from p''' and
so on, down to a straight line. Each zero is refined by Newton steps within a bracket, until the
ends of the bracket are neighbours or the step is lost in rounding. A zero of p' without a sign
change is not an extremum. Nor is a zero whose neighbours have one sign through rounding alone, or
differ from it only by as much.

*Ranges.* The range comes from the Bernstein coefficients: their hull contains the curve (G. Farin,
Curves and Surfaces for CAGD, 4.3), and converges to it quadratically with the size of the interval.

*Exact coefficients.* They are rounded once, at the end. A double is a rational number, and so are
the coefficients of a polynomial. All operations here use integers over a common denominator. In
floating point, a change of the expansion point, a composition or an integration loses digits by
cancellation. Coefficients are in ascending order of a local argument: p = c0 + c1 t + c2 t² + ...,
where t is x minus the expansion point.
"""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from math import lcm
from typing import Final, final

_STEPS: Final = 200  # bisection reduces a bracket of doubles to neighbours in far fewer steps
_ROUNDING: Final = 4e-16  # rounding error of one operation, with a margin


def candidates(coefficients: Sequence[float], low: float, high: float) -> list[float]:
    """Return the arguments in [low, high], ascending, where p' changes its sign.

    Args:
        coefficients: ascending.
        low: local argument below `high`, finite.
        high: local argument, finite.
    """
    chain: list[list[float]] = []
    current = list(coefficients)
    while len(current) > 2:
        current = [k * c for k, c in enumerate(current)][1:]
        chain.append(current)
    found: list[float] = []  # zeros of the next higher derivative
    for derivative in reversed(chain):
        knots = [low, *found, high]
        values = [_horner(derivative, knot) for knot in knots]
        found = [
            _zero(derivative, knots[i], knots[i + 1], values[i], values[i + 1])
            for i in range(len(knots) - 1)
            if (values[i] < 0.0) != (values[i + 1] < 0.0)
        ]
    return found


def range_over(coefficients: Sequence[float], low: float, high: float) -> tuple[float, float]:
    """Return a range that contains all values over [low, high], rounding included."""
    degree = len(coefficients) - 1
    local = list(coefficients)
    size = 0.0  # magnitude of the terms that may have cancelled
    reach = abs(low) + (high - low)
    for c in reversed(coefficients):
        size = size * reach + abs(c)
    for start in range(degree):
        for k in range(degree - 1, start - 1, -1):
            local[k] += low * local[k + 1]
    width, power = high - low, 1.0
    for k in range(degree + 1):
        local[k] *= power
        power *= width
    # b_j = sum_k C(j, k) / C(n, k) a_k, by differences: a_k / C(n, k), then degree sums.
    choose = 1.0
    for k in range(degree + 1):
        local[k] /= choose
        choose = choose * (degree - k) / (k + 1)
    for start in range(degree, 0, -1):
        for k in range(degree, degree - start, -1):
            local[k] += local[k - 1]
    return _hull(local, size * _ROUNDING * (degree + 1))


def _hull(control: Sequence[float], slack: float) -> tuple[float, float]:
    return min(control) - slack, max(control) + slack


def _horner(coefficients: Sequence[float], local: float) -> float:
    value = 0.0
    for c in reversed(coefficients):
        value = value * local + c
    return value


def _zero(p: Sequence[float], low: float, high: float, at_low: float, at_high: float) -> float:
    """Return the zero of a monotone p between two arguments with different signs."""
    if at_low == 0.0:
        return low
    if at_high == 0.0:
        return high
    slope = [k * c for k, c in enumerate(p)][1:]
    rising = at_low < 0.0
    x = low + 0.5 * (high - low)
    step = before = high - low
    for _ in range(_STEPS):
        value, gradient = _horner(p, x), _horner(slope, x)
        if value == 0.0:
            return x
        if (value < 0.0) == rising:
            low = x
        else:
            high = x
        newton = x - value / gradient if gradient else low
        if low < newton < high and abs(2.0 * value) <= abs(before * gradient):
            following = newton
        else:
            following = low + 0.5 * (high - low)
            if not low < following < high:
                return x
        before, step = step, abs(following - x)
        if following == x:
            return x
        x = following
    return x


@final
class Exact:
    """A polynomial without rounding; immutable.

    Attributes:
        numbers: the coefficients, ascending, times the denominator.
        denominator: > 0.
    """

    __slots__ = ("denominator", "numbers")

    def __init__(self, numbers: list[int], denominator: int) -> None:
        self.numbers: list[int] = numbers
        self.denominator: int = denominator

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
