"""Antiderivatives that have no closed form, or none that keeps its digits."""

from typing import final

import numpy as np

from motorapi.errors import UsageError
from motorapi.functions.function import FloatArray, Function
from motorapi.functions.polynomial import Polynomial


@final
class Integral(Function):
    """x -> the integral of a function up to x, from where its domain begins (or from 0).

    Every value is found by quadrature (`motorapi.functions.quadrature`), from the beginning.
    """

    __slots__ = ("function",)

    function: Function

    def __init__(self, function: Function) -> None:
        if not isinstance(function, Function):
            raise UsageError(f"Integral: {function!r} is no function")
        self._keep(function=function)

    @property
    def domain(self) -> tuple[float, float]:
        """That of the function."""
        return self.function.domain

    def value(self, argument: float) -> float:
        """By quadrature."""
        return self.function.integrate(self._origin(), self._inside(argument))

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
