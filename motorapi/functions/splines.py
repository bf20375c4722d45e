"""Derivatives at samples for cubic and quintic splines.

The unknowns are the first derivative of a Hermite curve at each sample (quintic: the second
derivative too), chosen so that the next higher derivatives do not jump at the samples. They solve a
banded system of linear equations by elimination with pivots, in time proportional to the number of
samples.

Source: C. de Boor, A Practical Guide to Splines (2001), ch. IV, and the same for degree 5.
"""

from collections.abc import Sequence
from enum import Enum
from fractions import Fraction
from typing import TypeAlias

from motorapi.functions.exact import Exact, nearest

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


def cubic(x: Sequence[float], y: Sequence[float], ends: Ends) -> list[float]:
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


def quintic(x: Sequence[float], y: Sequence[float], ends: Ends) -> Derivatives:
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
