"""Functions of a shifted or scaled argument.

`f.shifted(...)` and `f.scaled(...)` create these for functions without a simpler form.
"""

from abc import abstractmethod
from math import inf, nextafter
from typing import final

import numpy as np

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.functions.base import (
    LARGEST,
    Extrema,
    FloatArray,
    Function,
    finite,
    operations,
)
from motorhil.motorapi.functions.numerics import extrema


class _Moved(Function):
    """The common part of both: a bijection between outer and inner arguments."""

    __slots__ = ("_ends", "_inner_ends", "function")

    function: Function
    _ends: tuple[float, float]
    _inner_ends: tuple[float, float]

    def _set(self, function: Function) -> None:
        if not isinstance(function, Function):
            raise UsageError(f"{type(self).__name__}: {function!r} is not a function")
        self._keep(function=function, _inner_ends=function.domain)
        low, high = sorted(self._out(end) + 0.0 for end in function.domain)
        self._keep(_ends=(low, high))
        if not low < high:
            raise UsageError(f"{self!r}: the domain is empty")

    @abstractmethod
    def _in(self, argument: float) -> float:
        """Return the inner argument of an outer argument."""

    @abstractmethod
    def _out(self, argument: float) -> float:
        """Return the outer argument of an inner argument."""

    @property
    @final
    def domain(self) -> tuple[float, float]:
        """The domain of the function, moved."""
        return self._ends

    @final
    def _inner(self, argument: float) -> float:
        """Return the inner argument, clipped to the domain against rounding."""
        low, high = self._inner_ends
        return min(max(self._in(argument), low, -LARGEST), high, LARGEST)

    @final
    def value(self, argument: float) -> float:
        """Return the value of the function at the inner argument."""
        low, high = self._ends
        if not (low <= argument <= high and -LARGEST <= argument <= LARGEST):
            self._refuse(argument)
        return self.function.value(self._inner(argument))

    @final
    def _span(self, low: float, high: float) -> tuple[float, float]:
        one, other = self._inner(low), self._inner(high)
        return min(one, other), max(one, other)

    @final
    def _bounds(self, low: float, high: float) -> tuple[float, float]:
        return self.function.bounds(*self._span(low, high))

    @final
    def breaks_between(self, low: float, high: float) -> tuple[float, ...]:
        """Return the breaks of the function, moved."""
        inner = self.function.breaks_between(*self._span(low, high))
        moved = sorted(self._out(b) for b in inner)
        return tuple(b for b in moved if low < b < high)

    @final
    def is_smooth(self, low: float, high: float) -> bool:
        """Return True if the function is smooth in the interval, rounding included."""
        first, last = self._span(low, high)
        lowest, highest = self._inner_ends
        first, last = nextafter(first, -inf), nextafter(last, inf)
        return self.function.is_smooth(max(first, lowest), min(last, highest))


@final
class Shifted(_Moved):
    """x -> function(x - offset).

    Raises:
        UsageError: `offset` is not finite, or `function` is not a function.
    """

    __slots__ = ("offset",)

    offset: float

    def __init__(self, function: Function, offset: float) -> None:
        self._keep(offset=finite("Shifted", "offset", offset))
        self._set(function)

    def _in(self, argument: float) -> float:
        return argument - self.offset

    def _out(self, argument: float) -> float:
        return argument + self.offset

    def _values(self, arguments: FloatArray) -> FloatArray:
        inner = arguments - self.offset
        np.clip(inner, *self._inner_ends, out=inner)
        return self.function(inner)

    def _derivative(self, order: int) -> Function:
        return self.function.derivative(order).shifted(self.offset)

    def integral(self) -> Function:
        """Return the shifted integral of the function, set to 0 at the origin."""
        whole = self.function.integral().shifted(self.offset)
        return whole - whole.value(self._origin()) if self._ends[0] == -inf else whole

    def _integrate(self, low: float, high: float) -> float:
        return self.function.integrate(*self._span(low, high))

    def _extrema(self, low: float, high: float) -> Extrema:
        found = self.function.extrema(*self._span(low, high))
        return Extrema(
            found.minimum,
            min(max(self._out(found.at_minimum), low), high),
            found.maximum,
            min(max(self._out(found.at_maximum), low), high),
        )

    def times(self, number: float) -> Function:
        """Return the shifted function multiplied by `number`."""
        return Shifted(self.function.times(number), self.offset)

    def shifted(self, offset: float) -> Function:
        """Return the function shifted once by the sum of both offsets."""
        return Shifted(self.function, self.offset + finite(repr(self), "offset", offset))

    def _parameters(self) -> tuple[object, ...]:
        return self.function, self.offset


@final
class Scaled(_Moved):
    """x -> function(x / factor), reversed if the factor is below 0.

    Raises:
        UsageError: `factor` is 0 or not finite, or `function` is not a function.
    """

    __slots__ = ("factor",)

    factor: float

    def __init__(self, function: Function, factor: float) -> None:
        number = finite("Scaled", "factor", factor)
        if number == 0.0:
            raise UsageError(f"Scaled: the argument of {function!r} cannot be scaled by 0")
        self._keep(factor=number)
        self._set(function)

    def _in(self, argument: float) -> float:
        return argument / self.factor

    def _out(self, argument: float) -> float:
        return argument * self.factor

    def _values(self, arguments: FloatArray) -> FloatArray:
        inner = arguments / self.factor
        np.clip(inner, *self._inner_ends, out=inner)
        return self.function(inner)

    def _derivative(self, order: int) -> Function:
        return self.function.derivative(order).scaled(self.factor) * self.factor**-order

    def integral(self) -> Function:
        """Return the scaled integral of the function, set to 0 at the origin."""
        whole = self.function.integral().scaled(self.factor) * self.factor
        value = whole.value(self._origin())
        return whole - value if value else whole

    def _integrate(self, low: float, high: float) -> float:
        return abs(self.factor) * self.function.integrate(*self._span(low, high))

    def _extrema(self, low: float, high: float) -> Extrema:
        return extrema(self, low, high)

    def times(self, number: float) -> Function:
        """Return the scaled function multiplied by `number`."""
        return Scaled(self.function.times(number), self.factor)

    def scaled(self, factor: float) -> Function:
        """Return the function scaled once by the product of both factors."""
        return Scaled(self.function, self.factor * finite(repr(self), "factor", factor))

    def _parameters(self) -> tuple[object, ...]:
        return self.function, self.factor


operations.shift = Shifted
operations.scale = Scaled
