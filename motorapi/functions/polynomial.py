"""Polynomials, with constants as the simplest case."""

from collections.abc import Iterable
from fractions import Fraction
from math import factorial, inf, isfinite
from typing import Final, TypeAlias, final

import numpy as np

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.functions.base import LARGEST, Extrema, FloatArray, Function, finite
from motorhil.motorapi.functions.polynomial_math import Exact, candidates, nearest, range_over

Horner: TypeAlias = tuple[float, float, tuple[float, ...]]
_SHOWN: Final = 8  # coefficients in a repr


class Polynomial(Function):
    """c0 + c1 (x - about) + c2 (x - about)² + ...; trailing zeros are dropped.

    Sums, products, derivatives, integrals and compositions of polynomials are polynomials. Every
    coefficient is the nearest double to the exact one. The sum or product of two polynomials about
    different points is about that of the higher degree (the left one if equal). Choose `about` near
    the arguments in use: terms cancel at arguments far from it.

    Args:
        coefficients: ascending, at least one; finite.
        about: expansion point, where the local argument is 0; finite.

    Raises:
        UsageError: an argument violates these conditions.
    """

    __slots__ = ("_rest", "_top", "about", "coefficients")

    coefficients: tuple[float, ...]
    about: float
    _top: float
    _rest: tuple[float, ...]

    def __init__(self, coefficients: Iterable[float], about: float = 0.0) -> None:
        try:
            told = tuple(coefficients)
        except TypeError as error:
            raise UsageError(
                f"Polynomial: coefficients are {coefficients!r}, not a sequence of numbers"
            ) from error
        numbers = [finite("Polynomial", f"coefficient {k}", c) + 0.0 for k, c in enumerate(told)]
        if not numbers:
            raise UsageError("Polynomial: no coefficients; use Constant(0.0) for 0")
        while len(numbers) > 1 and numbers[-1] == 0.0:
            numbers.pop()
        self._keep(
            coefficients=tuple(numbers),
            about=finite("Polynomial", "about", about) + 0.0,
            _top=numbers[-1],
            _rest=tuple(reversed(numbers[:-1])),
        )

    @property
    @final
    def domain(self) -> tuple[float, float]:
        """The real line."""
        return -inf, inf

    @property
    @final
    def degree(self) -> int:
        """The highest power with a coefficient other than 0; 0 for constants."""
        return len(self.coefficients) - 1

    @property
    @final
    def horner(self) -> Horner:
        """Data for Horner's scheme: about, the highest coefficient, the others descending."""
        return self.about, self._top, self._rest

    def value(self, argument: float) -> float:
        """Return the value by Horner's scheme in x - about."""
        if not -LARGEST <= argument <= LARGEST:
            self._refuse(argument)
        local = argument - self.about
        value = self._top
        for coefficient in self._rest:
            value = value * local + coefficient
        return value

    def _values(self, arguments: FloatArray) -> FloatArray:
        local = arguments - self.about
        value = np.full_like(local, self._top)
        for coefficient in self._rest:
            value *= local
            value += coefficient
        return value

    def _derivative(self, order: int) -> Function:
        scaled = [
            c * (factorial(k) // factorial(k - order))
            for k, c in enumerate(self.coefficients)
            if k >= order
        ]
        return polynomial(scaled or [0.0], self.about)

    def integral(self) -> Function:
        """Return the antiderivative that is 0 at 0, about the same point."""
        raised = self.exact().integral()
        start = Exact.of([-raised.value(-Fraction(self.about))])
        return polynomial(raised.plus(start).rounded(), self.about)

    def _integrate(self, low: float, high: float) -> float:
        return nearest(self.exact_integral(low, high))

    def exact_integral(self, low: float, high: float) -> Fraction:
        """Return the definite integral, unrounded."""
        raised, about = self.exact().integral(), Fraction(self.about)
        return raised.value(Fraction(high) - about) - raised.value(Fraction(low) - about)

    def _extrema(self, low: float, high: float) -> Extrema:
        points = candidates(self.coefficients, low - self.about, high - self.about)
        at = sorted({low, high, *(min(max(p + self.about, low), high) for p in points)})
        values = [self.value(x) for x in at]
        least, most = min(values), max(values)
        return Extrema(least, at[values.index(least)], most, at[values.index(most)])

    def _bounds(self, low: float, high: float) -> tuple[float, float]:
        return range_over(self.coefficients, low - self.about, high - self.about)

    def _parameters(self) -> tuple[object, ...]:
        return self.coefficients, self.about

    def moved_to(self, about: float) -> "Polynomial":
        """Return the same polynomial about another point, its coefficients rounded once."""
        if about == self.about:
            return self
        return polynomial(self.exact(about).rounded(), about)

    def exact(self, about: float | None = None) -> Exact:
        """Return the unrounded coefficients, about another point if `about` is given."""
        coefficients = Exact.of(self.coefficients)
        if about is None or about == self.about:
            return coefficients
        return coefficients.moved(Fraction(about) - Fraction(self.about))

    @final
    def times(self, number: float) -> Function:
        """Return the polynomial with every coefficient multiplied by `number`."""
        factor = finite("Polynomial", "a factor", number)
        return polynomial([c * factor for c in self.coefficients], self.about)

    @final
    def shifted(self, offset: float) -> Function:
        """Return the shifted polynomial, exact except for the rounding of about + offset."""
        about = self.about + finite(repr(self), "offset", offset)
        return self if self.degree == 0 else polynomial(self.coefficients, about)

    @final
    def scaled(self, factor: float) -> Function:
        """Return the polynomial with coefficients c_k / factor^k."""
        number = finite(repr(self), "factor", factor)
        if number == 0.0:
            raise UsageError(f"{self!r}: the argument cannot be scaled by 0")
        power = Fraction(number)
        scaled = [nearest(Fraction(c) / power**k) for k, c in enumerate(self.coefficients)]
        return polynomial(scaled, self.about * number)

    def __repr__(self) -> str:
        if self.degree >= _SHOWN:
            return f"<Polynomial: degree {self.degree}, about {self.about!r}>"
        place = f", about={self.about!r}" if self.about else ""
        return f"Polynomial({self.coefficients!r}{place})"


@final
class Constant(Polynomial):
    """A constant function."""

    __slots__ = ()

    def __init__(self, value: float) -> None:
        super().__init__((finite("Constant", "value", value),))

    def value(self, argument: float) -> float:
        """Return the constant for any finite argument."""
        if not -LARGEST <= argument <= LARGEST:
            self._refuse(argument)
        return self._top

    def _parameters(self) -> tuple[object, ...]:
        return (self._top,)

    def __repr__(self) -> str:
        return f"Constant({self._top!r})"


def polynomial(coefficients: Iterable[float], about: float) -> Polynomial:
    """Return the polynomial, as a `Constant` if its degree is 0.

    Raises:
        UsageError: a coefficient is too large for a double.
    """
    numbers = tuple(coefficients)
    if not all(isfinite(c) for c in numbers):
        raise UsageError(f"a polynomial about {about!r} would have coefficients beyond 1.8e308")
    count = len(numbers)
    while count > 1 and numbers[count - 1] == 0.0:
        count -= 1
    return Constant(numbers[0]) if count == 1 else Polynomial(numbers[:count], about)
