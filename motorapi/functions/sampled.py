"""Functions through samples, with a choice of interpolations."""

from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from itertools import pairwise
from typing import Final, final

from motorapi.errors import UsageError
from motorapi.functions import splines
from motorapi.functions.function import Extrema, FloatArray, Function, finite
from motorapi.functions.piecewise import Piecewise
from motorapi.functions.splines import Ends

_SHOWN: Final = 5  # samples in a repr


class Interpolation(Enum):
    """Interpolation between two samples."""

    NEAREST = "nearest"
    """The value of the nearer sample; half-way, of the later one."""

    LINEAR = "linear"
    """A straight line."""

    CUBIC = "cubic"
    """A cubic spline: value, first and second derivative are continuous."""

    HERMITE = "Hermite"
    """A cubic with the given first derivatives at its ends; the second derivative may jump."""

    QUINTIC = "quintic"
    """A polynomial of degree 5, with the given derivatives at the samples. Without given
    derivatives, a spline with continuous derivatives up to the fourth.
    """


@final
class Sampled(Function):
    """A piecewise polynomial through samples, from the first to the last.

    Args:
        arguments: strictly ascending, at least two.
        values: one per argument; reproduced exactly there.
        kind: interpolation between the samples.
        first: first derivatives at the samples; for HERMITE, and QUINTIC if `second` is given.
        second: second derivatives; for QUINTIC.
        ends: end conditions of a spline (CUBIC, and QUINTIC without derivatives).

    Raises:
        UsageError: an argument violates these conditions, or does not apply to `kind`.
    """

    __slots__ = ("_last", "arguments", "curve", "ends", "first", "kind", "second", "values")

    arguments: tuple[float, ...]
    values: tuple[float, ...]
    kind: Interpolation
    first: tuple[float, ...] | None
    second: tuple[float, ...] | None
    ends: Ends
    curve: Piecewise
    _last: tuple[float, float]

    def __init__(
        self,
        arguments: Iterable[float],
        values: Iterable[float],
        kind: Interpolation = Interpolation.LINEAR,
        first: Iterable[float] | None = None,
        second: Iterable[float] | None = None,
        ends: Ends = Ends.NOT_A_KNOT,
    ) -> None:
        if not (isinstance(kind, Interpolation) and isinstance(ends, Ends)):
            raise UsageError(
                f"Sampled: {kind!r} is not an Interpolation, or {ends!r} is not an Ends"
            )
        x, y = _numbers("arguments", arguments), _numbers("values", values)
        if len(x) < 2:
            raise UsageError(f"Sampled: {len(x)} samples; expected at least 2")
        for i in range(len(x) - 1):
            if not x[i] < x[i + 1]:
                raise UsageError(
                    f"Sampled: argument {i + 1} is {x[i + 1]!r}, not above argument {i}, {x[i]!r}"
                )
        slopes = None if first is None else _numbers("first", first)
        bends = None if second is None else _numbers("second", second)
        for name, told in (("values", y), ("first", slopes), ("second", bends)):
            if told is not None and len(told) != len(x):
                raise UsageError(f"Sampled: {len(x)} arguments, but {len(told)} of {name}")
        _check_use(kind, slopes, bends, ends)
        try:
            curve = _MAKERS[kind](x, y, slopes, bends, ends)
        except (OverflowError, ZeroDivisionError) as error:
            raise UsageError(
                "Sampled: the distance of two samples is too small or too large"
            ) from error
        self._keep(
            arguments=x,
            values=y,
            kind=kind,
            first=slopes,
            second=bends,
            ends=ends,
            curve=curve,
            _last=(x[-1], y[-1]),
        )

    @property
    def domain(self) -> tuple[float, float]:
        """The interval from the first sample to the last."""
        return self.arguments[0], self.arguments[-1]

    def value(self, argument: float) -> float:
        """Return the value of the polynomial there; at a sample, exactly the sample."""
        if argument == self._last[0]:
            return self._last[1]
        return self.curve.value(argument)

    def _values(self, arguments: FloatArray) -> FloatArray:
        values = self.curve(arguments)
        values[arguments == self._last[0]] = self._last[1]
        return values

    def _derivative(self, order: int) -> Function:
        return self.curve.derivative(order)

    def integral(self) -> Function:
        """Return the integral as a piecewise polynomial."""
        return self.curve.integral()

    def _integrate(self, low: float, high: float) -> float:
        return self.curve.integrate(low, high)

    def _extrema(self, low: float, high: float) -> Extrema:
        found = self.curve.extrema(low, high)
        last = self.value(high)
        least = min((found.minimum, found.at_minimum), (last, high))
        most = (last, high) if last > found.maximum else (found.maximum, found.at_maximum)
        return Extrema(*least, *most)

    def _bounds(self, low: float, high: float) -> tuple[float, float]:
        least, most = self.curve.bounds(low, high)
        last = self.value(high)
        return min(least, last), max(most, last)

    def breaks_between(self, low: float, high: float) -> tuple[float, ...]:
        """Return the samples in the interval; for NEAREST, the points half-way between them."""
        return self.curve.breaks_between(low, high)

    def is_smooth(self, low: float, high: float) -> bool:
        """Return True if the interval lies in one polynomial."""
        return self.curve.is_smooth(low, high)

    def times(self, number: float) -> Function:
        """Return the function with every sample multiplied by `number`."""
        factor = finite("Sampled", "a factor", number)
        first, second = (
            None if told is None else [factor * one for one in told]
            for told in (self.first, self.second)
        )
        values = [factor * value for value in self.values]
        return Sampled(self.arguments, values, self.kind, first, second, self.ends)

    def shifted(self, offset: float) -> Function:
        """Return the function with every sample shifted."""
        way = finite("Sampled", "offset", offset)
        arguments = [x + way for x in self.arguments]
        return Sampled(arguments, self.values, self.kind, self.first, self.second, self.ends)

    def scaled(self, factor: float) -> Function:
        """Return the scaled function; derivatives are divided by the factor and its square."""
        number = finite("Sampled", "factor", factor)
        if number == 0.0:
            raise UsageError("Sampled: the argument cannot be scaled by 0")
        order = 1 if number > 0.0 else -1
        first, second = (
            None if told is None else [one / power for one in told[::order]]
            for told, power in ((self.first, number), (self.second, number * number))
        )
        arguments = [x * number for x in self.arguments[::order]]
        return Sampled(arguments, self.values[::order], self.kind, first, second, self.ends)

    def _parameters(self) -> tuple[object, ...]:
        return self.arguments, self.values, self.kind, self.first, self.second, self.ends

    def __repr__(self) -> str:
        if len(self.arguments) > _SHOWN:
            low, high = self.domain
            count = len(self.arguments)
            return f"<Sampled: {count} samples, {self.kind.value}, {low!r} to {high!r}>"
        told = [repr(self.arguments), repr(self.values), str(self.kind)]
        told += [
            f"{name}={derivatives!r}"
            for name, derivatives in (("first", self.first), ("second", self.second))
            if derivatives is not None
        ]
        if self.ends is not Ends.NOT_A_KNOT:
            told.append(f"ends={self.ends}")
        return f"Sampled({', '.join(told)})"


def _numbers(name: str, told: Iterable[float]) -> tuple[float, ...]:
    try:
        listed = tuple(told)
    except TypeError as error:
        raise UsageError(f"Sampled: {name} is {told!r}, not a sequence of numbers") from error
    return tuple(finite("Sampled", f"{name}[{i}]", one) + 0.0 for i, one in enumerate(listed))


def _check_use(
    kind: Interpolation,
    first: Sequence[float] | None,
    second: Sequence[float] | None,
    ends: Ends,
) -> None:
    is_spline = kind is Interpolation.CUBIC or (
        kind is Interpolation.QUINTIC and first is None and second is None
    )
    if kind is Interpolation.HERMITE:
        if first is None or second is not None:
            raise UsageError("Sampled: HERMITE takes first derivatives, and no second derivatives")
    elif kind is Interpolation.QUINTIC:
        if (first is None) is not (second is None):
            raise UsageError("Sampled: QUINTIC takes first and second derivatives, or neither")
    elif first is not None or second is not None:
        raise UsageError(f"Sampled: {kind.name} takes no derivatives")
    if ends is not Ends.NOT_A_KNOT and not is_spline:
        raise UsageError(f"Sampled: {kind.name} as given is not a spline; omit ends=")


# --- pieces of each kind

_Samples = Sequence[float]
_Maker = Callable[[_Samples, _Samples, _Samples | None, _Samples | None, Ends], Piecewise]


def _nearest(
    x: _Samples, y: _Samples, first: _Samples | None, second: _Samples | None, ends: Ends
) -> Piecewise:
    halves = [a + 0.5 * (b - a) for a, b in pairwise(x)]
    return Piecewise.of_polynomials([x[0], *halves, x[-1]], [[value] for value in y])


def _linear(
    x: _Samples, y: _Samples, first: _Samples | None, second: _Samples | None, ends: Ends
) -> Piecewise:
    rows = [[y[i], (y[i + 1] - y[i]) / (x[i + 1] - x[i])] for i in range(len(x) - 1)]
    return Piecewise.of_polynomials(x, rows)


def _cubic(
    x: _Samples, y: _Samples, first: _Samples | None, second: _Samples | None, ends: Ends
) -> Piecewise:
    return _hermite(x, y, splines.cubic(x, y, ends), None, ends)


def _hermite(
    x: _Samples, y: _Samples, first: _Samples | None, second: _Samples | None, ends: Ends
) -> Piecewise:
    assert first is not None
    rows = []
    for i in range(len(x) - 1):
        h, begin, end = x[i + 1] - x[i], first[i], first[i + 1]
        slope = (y[i + 1] - y[i]) / h
        bend = (begin + end - 2.0 * slope) / h
        rows.append([y[i], begin, (slope - begin) / h - bend, bend / h])
    return Piecewise.of_polynomials(x, rows)


def _quintic(
    x: _Samples, y: _Samples, first: _Samples | None, second: _Samples | None, ends: Ends
) -> Piecewise:
    m, a = splines.quintic(x, y, ends) if first is None or second is None else (first, second)
    rows = []
    for i in range(len(x) - 1):
        h = x[i + 1] - x[i]
        # Differences of values and derivatives at the right end from those of a parabola.
        rise = (y[i + 1] - y[i]) / h - m[i] - 0.5 * a[i] * h
        slope = m[i + 1] - m[i] - a[i] * h
        bend = (a[i + 1] - a[i]) * h
        rows.append(
            [
                y[i],
                m[i],
                0.5 * a[i],
                (10.0 * rise - 4.0 * slope + 0.5 * bend) / h**2,
                (-15.0 * rise + 7.0 * slope - bend) / h**3,
                (6.0 * rise - 3.0 * slope + 0.5 * bend) / h**4,
            ]
        )
    return Piecewise.of_polynomials(x, rows)


_MAKERS: Final[dict[Interpolation, _Maker]] = {
    Interpolation.NEAREST: _nearest,
    Interpolation.LINEAR: _linear,
    Interpolation.CUBIC: _cubic,
    Interpolation.HERMITE: _hermite,
    Interpolation.QUINTIC: _quintic,
}
