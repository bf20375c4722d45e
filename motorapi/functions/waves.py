"""Sine, cosine and exponential functions: oscillation, decay and growth."""

from abc import abstractmethod
from math import ceil, cos, exp, expm1, floor, inf, isfinite, pi, sin
from typing import TypeVar, final

import numpy as np

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.functions.base import LARGEST, Extrema, FloatArray, Function, finite

_Wave = TypeVar("_Wave", bound="Wave")


class Wave(Function):
    """amplitude * wave(frequency_rad_s * (x - about) + phase_rad), for sine and cosine.

    Args:
        amplitude: in the unit of the values; any sign.
        frequency_rad_s: radians per unit of the argument, which need not be time; not 0.
        phase_rad: phase at `about`.
        about: argument at which the phase is `phase_rad`. Far from it the phase has only as many
            digits as the argument.

    Raises:
        UsageError: an argument is not finite, or the frequency is 0.
    """

    __slots__ = ("about", "amplitude", "frequency_rad_s", "phase_rad")

    amplitude: float
    frequency_rad_s: float
    phase_rad: float
    about: float

    @final
    def __init__(
        self,
        amplitude: float = 1.0,
        frequency_rad_s: float = 1.0,
        phase_rad: float = 0.0,
        about: float = 0.0,
    ) -> None:
        name = type(self).__name__
        frequency = finite(name, "frequency_rad_s", frequency_rad_s)
        if frequency == 0.0:
            raise UsageError(f"{name}: frequency_rad_s is 0; use a Constant for a constant value")
        self._keep(
            amplitude=finite(name, "amplitude", amplitude),
            frequency_rad_s=frequency,
            phase_rad=finite(name, "phase_rad", phase_rad),
            about=finite(name, "about", about),
        )

    @abstractmethod
    def _crest_rad(self) -> float:
        """Return a phase at which the wave, without its amplitude, is 1."""

    @property
    @final
    def domain(self) -> tuple[float, float]:
        """The real line."""
        return -inf, inf

    @final
    def _phase(self, argument: float) -> float:
        phase = self.frequency_rad_s * (argument - self.about) + self.phase_rad
        if not (-LARGEST <= argument <= LARGEST and isfinite(phase)):
            self._refuse(argument)
        return phase

    @final
    def _phases(self, arguments: FloatArray) -> FloatArray:
        phases = arguments - self.about
        phases *= self.frequency_rad_s
        phases += self.phase_rad
        known = np.isfinite(phases)
        if not known.all():
            self._refuse(float(arguments[np.argmin(known)]))
        return phases

    @final
    def _like(self, kind: type[_Wave], amplitude: float) -> _Wave:
        """Return a wave with the frequency and phase of this one."""
        return kind(amplitude, self.frequency_rad_s, self.phase_rad, self.about)

    @final
    def _extrema(self, low: float, high: float) -> Extrema:
        first, last = self._phase(low), self._phase(high)
        forward = 1 if first <= last else -1
        crest = self._crest_rad()
        number = ceil((first - crest) / pi) if forward > 0 else floor((first - crest) / pi)
        found = [(self.value(low), low), (self.value(high), high)]
        for k in (number, number + forward):
            phase = crest + k * pi
            if min(first, last) <= phase <= max(first, last):
                at = self.about + (phase - self.phase_rad) / self.frequency_rad_s
                size = -self.amplitude if k % 2 else self.amplitude
                found.append((size, min(max(at, low), high)))
        most = max(found, key=lambda one: (one[0], -one[1]))
        return Extrema(*min(found), *most)

    @final
    def _bounds(self, low: float, high: float) -> tuple[float, float]:
        found = self._extrema(low, high)
        return found.minimum, found.maximum

    @final
    def unit_amplitude(self) -> "Wave":
        """Return the same wave with amplitude 1."""
        return self._like(type(self), 1.0)

    @final
    def times(self, number: float) -> Function:
        """Return the wave with its amplitude multiplied by `number`."""
        factor = finite(type(self).__name__, "a factor", number)
        return self._like(type(self), self.amplitude * factor)

    @final
    def shifted(self, offset: float) -> Function:
        """Return the shifted wave, exact except for the rounding of about + offset."""
        about = self.about + finite(repr(self), "offset", offset)
        return type(self)(self.amplitude, self.frequency_rad_s, self.phase_rad, about)

    @final
    def scaled(self, factor: float) -> Function:
        """Return the wave with its frequency divided by `factor`."""
        number = finite(repr(self), "factor", factor)
        if number == 0.0:
            raise UsageError(f"{self!r}: the argument cannot be scaled by 0")
        frequency = self.frequency_rad_s / number
        return type(self)(self.amplitude, frequency, self.phase_rad, self.about * number)

    @final
    def _parameters(self) -> tuple[object, ...]:
        return self.amplitude, self.frequency_rad_s, self.phase_rad, self.about

    @final
    def __repr__(self) -> str:
        place = f", about={self.about!r}" if self.about else ""
        return (
            f"{type(self).__name__}({self.amplitude!r}, frequency_rad_s={self.frequency_rad_s!r},"
            f" phase_rad={self.phase_rad!r}{place})"
        )


@final
class Sine(Wave):
    """amplitude * sin(frequency_rad_s * (x - about) + phase_rad); see `Wave`."""

    __slots__ = ()

    def value(self, argument: float) -> float:
        """Return the value, computed by the C library."""
        return self.amplitude * sin(self._phase(argument))

    def _values(self, arguments: FloatArray) -> FloatArray:
        return self.amplitude * np.sin(self._phases(arguments))

    def _derivative(self, order: int) -> Function:
        size = self.amplitude * self.frequency_rad_s**order
        if order % 2:
            return self._like(Cosine, -size if order % 4 == 3 else size)
        return self._like(Sine, -size if order % 4 == 2 else size)

    def integral(self) -> Function:
        """Return the integral, the sum of a cosine and a constant."""
        wave = self._like(Cosine, -self.amplitude / self.frequency_rad_s)
        return wave - wave.value(0.0)

    def _integrate(self, low: float, high: float) -> float:
        # cos a - cos b = 2 sin((a + b) / 2) sin((b - a) / 2), without cancellation
        turn = 0.5 * self.frequency_rad_s * (high - low)
        middle = self._phase(low) + turn
        return 2.0 * self.amplitude / self.frequency_rad_s * sin(middle) * sin(turn)

    def _crest_rad(self) -> float:
        return 0.5 * pi


@final
class Cosine(Wave):
    """amplitude * cos(frequency_rad_s * (x - about) + phase_rad); see `Wave`."""

    __slots__ = ()

    def value(self, argument: float) -> float:
        """Return the value, computed by the C library."""
        return self.amplitude * cos(self._phase(argument))

    def _values(self, arguments: FloatArray) -> FloatArray:
        return self.amplitude * np.cos(self._phases(arguments))

    def _derivative(self, order: int) -> Function:
        size = self.amplitude * self.frequency_rad_s**order
        if order % 2:
            return self._like(Sine, -size if order % 4 == 1 else size)
        return self._like(Cosine, -size if order % 4 == 2 else size)

    def integral(self) -> Function:
        """Return the integral, the sum of a sine and a constant."""
        wave = self._like(Sine, self.amplitude / self.frequency_rad_s)
        return wave - wave.value(0.0)

    def _integrate(self, low: float, high: float) -> float:
        # sin b - sin a = 2 cos((a + b) / 2) sin((b - a) / 2), without cancellation
        turn = 0.5 * self.frequency_rad_s * (high - low)
        middle = self._phase(low) + turn
        return 2.0 * self.amplitude / self.frequency_rad_s * cos(middle) * sin(turn)

    def _crest_rad(self) -> float:
        return 0.0


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
