"""Antiderivatives without a closed form that keeps its digits."""

from fractions import Fraction
from math import inf
from typing import Final, final

import numpy as np

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.functions.base import FloatArray, Function
from motorhil.motorapi.functions.polynomial import Polynomial
from motorhil.motorapi.functions.polynomial_math import nearest

_STEPS: Final = 64
_STEPS_MAX: Final = 4096


@final
class Integral(Function):
    """x -> the integral of a function up to x, from the lower end of its domain (or from 0).

    The integral up to the nearest of equal steps is computed once by quadrature, and the rest for
    each value. A value does not depend on earlier calls. A bounded domain has 64 steps; otherwise
    steps have length 1, up to the first 4096.
    """

    __slots__ = ("_sums", "function")

    function: Function
    _sums: dict[
        int, tuple[Fraction, ...]
    ]  # by direction, the integrals up to each step computed so far

    def __init__(self, function: Function) -> None:
        if not isinstance(function, Function):
            raise UsageError(f"Integral: {function!r} is not a function")
        self._keep(function=function, _sums={1: (Fraction(0),), -1: (Fraction(0),)})

    @property
    def domain(self) -> tuple[float, float]:
        """The domain of the function."""
        return self.function.domain

    def value(self, argument: float) -> float:
        """Return the value by quadrature from the preceding step."""
        x, origin = self._inside(argument), self._origin()
        low, high = self.domain
        length = (high - low) / _STEPS if high - low < inf else 1.0
        way = abs(x - origin) / length
        if way >= _STEPS_MAX:
            return self.function.integrate(origin, x)
        direction = 1 if x >= origin else -1
        step = min(int(way), _STEPS - 1) if high - low < inf else int(way)
        rest = self.function.integrate(origin + direction * step * length, x)
        return nearest(self._sum(direction, step, length) + Fraction(rest))

    def _sum(self, direction: int, step: int, length: float) -> Fraction:
        """Return the integral up to a step; the integrals of all steps before it are cached."""
        sums, origin = self._sums[direction], self._origin()
        if step >= len(sums):
            found = list(sums)
            for k in range(len(sums), step + 1):
                edges = [origin + direction * n * length for n in (k - 1, k)]
                found.append(found[-1] + Fraction(self.function.integrate(*edges)))
            self._sums[direction] = sums = tuple(found)
        return sums[step]

    def _values(self, arguments: FloatArray) -> FloatArray:
        return np.fromiter(map(self.value, arguments.tolist()), np.float64, len(arguments))

    def _derivative(self, order: int) -> Function:
        return self.function.derivative(order - 1)

    def integral(self) -> Function:
        """Return the integral by parts: way * F - integral of way * f, way from the origin."""
        way = Polynomial((0.0, 1.0), self._origin())
        return way * self - Integral(way * self.function)

    def _bounds(self, low: float, high: float) -> tuple[float, float]:
        start = self.value(low)
        least, most = self.function.bounds(low, high)
        width = high - low
        return start + min(0.0, least * width), start + max(0.0, most * width)

    def breaks_between(self, low: float, high: float) -> tuple[float, ...]:
        """Return the breaks of the function."""
        return self.function.breaks_between(low, high)

    def is_smooth(self, low: float, high: float) -> bool:
        """Return True if the function is smooth in ]low, high]."""
        return self.function.is_smooth(low, high)

    def times(self, number: float) -> Function:
        """Return the integral of the function multiplied by `number`."""
        return Integral(self.function.times(number))

    def _parameters(self) -> tuple[object, ...]:
        return (self.function,)


def anchored(antiderivative: Function, origin: float) -> Function:
    """Return the antiderivative that is 0 at `origin`."""
    value = antiderivative.value(origin)
    return antiderivative - value if value else antiderivative
