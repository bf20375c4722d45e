"""The exponential function, for decay or growth at a constant rate."""

from math import exp, expm1, inf
from typing import final

import numpy as np

from motorapi.errors import UsageError
from motorapi.functions.function import LARGEST, Extrema, FloatArray, Function, finite


@final
class Exponential(Function):
    """amplitude * exp(rate * (x - about)); infinite on overflow.

    A first-order step response of time constant T is `1.0 - Exponential(1.0, -1.0 / T)`.

    Args:
        amplitude: the value at `about`, in the unit of the values.
        rate: per unit of the argument; not 0.
        about: argument at which the value is `amplitude`.

    Raises:
        UsageError: an argument is not finite, or amplitude or rate is 0.
    """

    __slots__ = ("about", "amplitude", "rate")

    amplitude: float
    rate: float
    about: float

    def __init__(self, amplitude: float = 1.0, rate: float = 1.0, about: float = 0.0) -> None:
        for name, number in (("amplitude", amplitude), ("rate", rate)):
            if finite("Exponential", name, number) == 0.0:
                raise UsageError(f"Exponential: {name} is 0; use a Constant for a constant value")
        self._keep(
            amplitude=float(amplitude),
            rate=float(rate),
            about=finite("Exponential", "about", about),
        )

    @property
    def domain(self) -> tuple[float, float]:
        """The real line."""
        return -inf, inf

    def value(self, argument: float) -> float:
        """Return the value, computed by the C library."""
        if not -LARGEST <= argument <= LARGEST:
            self._refuse(argument)
        try:
            return self.amplitude * exp(self.rate * (argument - self.about))
        except OverflowError:
            return self.amplitude * inf

    def _values(self, arguments: FloatArray) -> FloatArray:
        powers = arguments - self.about
        powers *= self.rate
        np.exp(powers, out=powers)
        powers *= self.amplitude
        return powers

    def _derivative(self, order: int) -> Function:
        return self.times(self.rate**order)

    def integral(self) -> Function:
        """Return the integral, the sum of an exponential and a constant."""
        part = Exponential(self.amplitude / self.rate, self.rate, self.about)
        return part - part.value(0.0)

    def _integrate(self, low: float, high: float) -> float:
        way = self.rate * (high - low)  # from the larger end, with expm1, no cancellation occurs
        if way > 0.0:
            return -self.value(high) / self.rate * expm1(-way)
        return self.value(low) / self.rate * expm1(way)

    def _extrema(self, low: float, high: float) -> Extrema:
        first, last = self.value(low), self.value(high)
        if first <= last:
            return Extrema(first, low, last, low if first == last else high)
        return Extrema(last, high, first, low)

    def _bounds(self, low: float, high: float) -> tuple[float, float]:
        first, last = self.value(low), self.value(high)
        return min(first, last), max(first, last)

    def unit_amplitude(self) -> "Exponential":
        """Return the same function with amplitude 1."""
        return Exponential(1.0, self.rate, self.about)

    def times(self, number: float) -> Function:
        """Return the function with its amplitude multiplied by `number`."""
        factor = finite("Exponential", "a factor", number)
        if factor == 0.0:
            return super().times(factor)
        return Exponential(self.amplitude * factor, self.rate, self.about)

    def shifted(self, offset: float) -> Function:
        """Return the shifted function, exact except for the rounding of about + offset."""
        about = self.about + finite(repr(self), "offset", offset)
        return Exponential(self.amplitude, self.rate, about)

    def scaled(self, factor: float) -> Function:
        """Return the function with its rate divided by `factor`."""
        number = finite(repr(self), "factor", factor)
        if number == 0.0:
            raise UsageError(f"{self!r}: the argument cannot be scaled by 0")
        return Exponential(self.amplitude, self.rate / number, self.about * number)

    def _parameters(self) -> tuple[object, ...]:
        return self.amplitude, self.rate, self.about

    def __repr__(self) -> str:
        place = f", about={self.about!r}" if self.about else ""
        return f"Exponential({self.amplitude!r}, rate={self.rate!r}{place})"
