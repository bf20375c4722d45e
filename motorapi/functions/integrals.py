"""Antiderivatives that have no closed form, or none that keeps its digits."""

from fractions import Fraction
from math import inf
from typing import Final, final

import numpy as np

from motorapi.errors import UsageError
from motorapi.functions.exact import nearest
from motorapi.functions.function import FloatArray, Function
from motorapi.functions.polynomial import Polynomial

_STEPS: Final = 64
_STEPS_MAX: Final = 4096


@final
class Integral(Function):
    """x -> the integral of a function up to x, from where its domain begins (or from 0).

    By quadrature (`motorapi.functions.quadrature`): up to the nearest of equal steps once, and from
    there for each value. What a value is does not depend on which were asked for before. There are
    64 steps in a domain with two ends; otherwise they are 1 long, as far as the first 4096 reach.
    """

    __slots__ = ("_sums", "function")

    function: Function
    _sums: dict[int, tuple[Fraction, ...]]  # by direction, up to each step: those found so far

    def __init__(self, function: Function) -> None:
        if not isinstance(function, Function):
            raise UsageError(f"Integral: {function!r} is no function")
        self._keep(function=function, _sums={1: (Fraction(0),), -1: (Fraction(0),)})

    @property
    def domain(self) -> tuple[float, float]:
        """That of the function."""
        return self.function.domain

    def value(self, argument: float) -> float:
        """By quadrature, from the step before."""
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
        """The integral up to a step; all the steps before it are kept."""
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
        """By parts: with x counted from the beginning, x times this less that of x times f."""
        way = Polynomial((0.0, 1.0), self._origin())
        return way * self - Integral(way * self.function)

    def _bounds(self, low: float, high: float) -> tuple[float, float]:
        start = self.value(low)
        least, most = self.function.bounds(low, high)
        width = high - low
        return start + min(0.0, least * width), start + max(0.0, most * width)

    def breaks_between(self, low: float, high: float) -> tuple[float, ...]:
        """Those of the function."""
        return self.function.breaks_between(low, high)

    def is_smooth(self, low: float, high: float) -> bool:
        """Whether the function is."""
        return self.function.is_smooth(low, high)

    def times(self, number: float) -> Function:
        """The integral of so many times the function."""
        return Integral(self.function.times(number))

    def _parameters(self) -> tuple[object, ...]:
        return (self.function,)


def anchored(antiderivative: Function, origin: float) -> Function:
    """The antiderivative that is 0 at `origin`."""
    value = antiderivative.value(origin)
    return antiderivative - value if value else antiderivative
