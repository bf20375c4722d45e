"""Sampled functions, with a choice of interpolations; splines.

The unknowns of a spline are the first derivative of a Hermite curve at each sample (quintic: the
second derivative too), chosen so that the next higher derivatives do not jump at the samples. They
solve a banded system of linear equations by elimination with pivots, in time proportional to the
number of samples.

Source: C. de Boor, A Practical Guide to Splines (2001), ch. IV, and the same for degree 5.
"""

from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from fractions import Fraction
from itertools import pairwise
from typing import Final, TypeAlias, final

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.functions.base import Extrema, FloatArray, Function, finite
from motorhil.motorapi.functions.piecewise import Piecewise
from motorhil.motorapi.functions.polynomial_math import Exact, nearest

_SHOWN: Final = 5  # samples in a repr

Equation: TypeAlias = tuple[int, list[float], float]  # first unknown, coefficients, right side
Derivatives: TypeAlias = tuple[list[float], list[float]]


class Ends(Enum):
    """End conditions of a spline."""

    NOT_A_KNOT = "not a knot"
    """No derivative jumps at the samples next to the ends: best for samples of a smooth function.
    With fewer than 4 samples (quintic: 6), the polynomial through all of them.
    """

    NATURAL = "natural"
    """The second derivative is 0 at the ends; quintic: the third and the fourth."""

    AT_REST = "at rest"
    """The first derivative is 0 at the ends (quintic: the second too), as for motors at rest."""


def _slopes(x: Sequence[float], y: Sequence[float], ends: Ends) -> list[float]:
    """Return the first derivatives at the samples; at least two samples, x ascending."""
    n = len(x)
    if ends is Ends.NOT_A_KNOT and n < 4:
        return _through_all(x, y)[0]
    h = [x[i + 1] - x[i] for i in range(n - 1)]
    d = [(y[i + 1] - y[i]) / h[i] for i in range(n - 1)]
    rows: list[Equation] = [
        (
            i - 1,
            [h[i], 2.0 * (h[i - 1] + h[i]), h[i - 1]],
            3.0 * (h[i] * d[i - 1] + h[i - 1] * d[i]),
        )
        for i in range(1, n - 1)
    ]
    if ends is Ends.AT_REST:
        rows += [(0, [1.0], 0.0), (n - 1, [1.0], 0.0)]
    elif ends is Ends.NATURAL:
        rows += [(0, [2.0, 1.0], 3.0 * d[0]), (n - 2, [1.0, 2.0], 3.0 * d[-1])]
    else:
        for i in (1, n - 2):  # the third derivative does not jump there
            a, b = h[i] * h[i], h[i - 1] * h[i - 1]
            right = 2.0 * (a * d[i - 1] - b * d[i])
            rows.append((i - 1, [a, a - b, -b], right))
    return solved(rows, n)


def _states(x: Sequence[float], y: Sequence[float], ends: Ends) -> Derivatives:
    """Return the first and second derivatives at the samples, at least two; x ascending."""
    n = len(x)
    if n < 6 and ends is Ends.NOT_A_KNOT:
        return _through_all(x, y)
    unit = (x[-1] - x[0]) / (n - 1)  # in this unit the unknowns have similar size
    h = [(x[i + 1] - x[i]) / unit for i in range(n - 1)]
    rows: list[Equation] = []
    for i in range(1, n - 1):
        rows += [_no_jump(order, i, h, y) for order in (3, 4)]
    if ends is Ends.AT_REST:
        rows += [(k, [1.0], 0.0) for k in (0, 1, 2 * n - 2, 2 * n - 1)]
    elif ends is Ends.NATURAL:
        for order in (3, 4):
            coefficients, constant = _at_end(order, False, h[0], y[1] - y[0])
            rows.append((0, coefficients, -constant))
            coefficients, constant = _at_end(order, True, h[-1], y[-1] - y[-2])
            rows.append((2 * (n - 2), coefficients, -constant))
    else:
        rows += [_no_jump(5, i, h, y) for i in (1, 2, n - 3, n - 2)]
    found = solved(rows, 2 * n)
    return [m / unit for m in found[0::2]], [a / unit / unit for a in found[1::2]]


def _no_jump(order: int, i: int, h: Sequence[float], y: Sequence[float]) -> Equation:
    """Return the equation for continuity of a derivative at sample i of a quintic Hermite curve."""
    left, left_constant = _at_end(order, True, h[i - 1], y[i] - y[i - 1])
    right, right_constant = _at_end(order, False, h[i], y[i + 1] - y[i])
    middle = [left[2] - right[0], left[3] - right[1]]
    return (
        2 * (i - 1),
        [left[0], left[1], *middle, -right[2], -right[3]],
        right_constant - left_constant,
    )


def _at_end(order: int, at_right: bool, h: float, rise: float) -> tuple[list[float], float]:
    """Return a derivative at one end of a quintic piece of length h, as a linear form.

    Its variables are the first and second derivatives at the left and the right end, in that order,
    plus a constant.
    """
    if order == 3:
        a, b, c, d = -36.0 / h**2, -9.0 / h, -24.0 / h**2, 3.0 / h
        constant = 60.0 * rise / h**3
        return ([c, -d, a, -b] if at_right else [a, b, c, d]), constant
    if order == 4:
        a, b, c, d = 192.0 / h**3, 36.0 / h**2, 168.0 / h**3, -24.0 / h**2
        constant = -360.0 * rise / h**4
        return ([-c, d, -a, b], -constant) if at_right else ([a, b, c, d], constant)
    a, b = -360.0 / h**4, 60.0 / h**3
    return [a, -b, a, b], 720.0 * rise / h**5


def _through_all(x: Sequence[float], y: Sequence[float]) -> Derivatives:
    """Return the derivatives of the polynomial through all samples (Newton's form, exact)."""
    knots, table = [Fraction(k) for k in x], [Fraction(value) for value in y]
    newton = [table[0]]
    for k in range(1, len(x)):
        table = [
            (table[i + 1] - table[i]) / (knots[i + k] - knots[i]) for i in range(len(table) - 1)
        ]
        newton.append(table[0])
    power = Exact.of(newton[-1:])
    for k in range(len(x) - 2, -1, -1):
        power = power.times(Exact.of([-knots[k], 1.0])).plus(Exact.of([newton[k]]))
    local = [power.moved(knot) for knot in knots]
    first = [nearest(c.coefficient(1)) for c in local]
    return first, [nearest(2 * c.coefficient(2)) for c in local]


def solved(rows: list[Equation], unknowns: int) -> list[float]:
    """Solve a banded system by elimination with the largest pivot of each column."""
    waiting = sorted(((f, _even(c, r)) for f, c, r in rows), key=lambda row: row[0], reverse=True)
    active: list[list[float]] = []  # [coefficients from this column on ..., right side]
    reduced: list[list[float]] = []
    for column in range(unknowns):
        while waiting and waiting[-1][0] == column:
            active.append(waiting.pop()[1])
        best = max(range(len(active)), key=lambda i: abs(active[i][0]))
        pivot = active.pop(best)
        reduced.append(pivot)
        active = [_without_first(row, pivot) for row in active]
    solution = [0.0] * unknowns
    for column in range(unknowns - 1, -1, -1):
        first, *others, right = reduced[column]
        for k, coefficient in enumerate(others, column + 1):
            right -= coefficient * solution[k]
        solution[column] = right / first
    return solution


def _even(coefficients: list[float], right: float) -> list[float]:
    """Return the equation scaled to 1 as its largest coefficient."""
    size = max(abs(c) for c in coefficients)
    return [c / size for c in (*coefficients, right)]


def _without_first(row: list[float], pivot: list[float]) -> list[float]:
    """Return the row with its first unknown eliminated by the pivot row."""
    share = row[0] / pivot[0]
    length = max(len(row), len(pivot)) - 1
    mine = [*row[:-1], *[0.0] * (length - len(row) + 1)]
    its = [*pivot[:-1], *[0.0] * (length - len(pivot) + 1)]
    return [
        *(a - share * b for a, b in zip(mine[1:], its[1:], strict=True)),
        row[-1] - share * pivot[-1],
    ]


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
    return _hermite(x, y, _slopes(x, y, ends), None, ends)


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
    m, a = _states(x, y, ends) if first is None or second is None else (first, second)
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
