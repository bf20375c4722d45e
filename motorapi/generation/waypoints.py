"""Smooth curves through way-points, at given times or as fast as limits allow.

A piece between two way-points is determined by the states at both. Values and first derivatives
make it cubic; with second derivatives it is quintic. Free derivatives are chosen so that as many
derivatives as possible are continuous. For cubics this is the second one (the classical spline).
For quintics it is the fourth where the first is free, and the third where the second is free. These
conditions give the least integral of the squared second or third derivative. Each is a linear
equation between neighbours, so all are solved in one forward and one backward sweep.

Slowing a motion from rest to rest by a factor s divides its first derivative by s, its second by
s², its third by s³. So for given *ratios* of the times the shortest times follow at once. The
initial ratios are those of the shortest times of the single pieces. Then a pattern search tries
each time longer and shorter, with a shrinking step. With more than 32 pieces the initial ratios
are kept. The result is near the optimum, without proof; the limits are met to rounding.

Many candidates of the search are computed at once: k is their number, m that of the way-points.

Source: Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), 4.4
and 4.5 (cubic splines), 2.1.5 and 4.6 (polynomials of degree 5).
"""

from collections.abc import Sequence
from math import isfinite
from typing import Final, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from motorhil.motorapi.commands import DerivativeLimits, Range
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.functions.piecewise import Piecewise

FloatArray: TypeAlias = NDArray[np.float64]

_CUBIC: Final = 3
_QUINTIC: Final = 5
_HALVINGS: Final = 36  # of the bracket of a zero; an extremum is known to the square of the rest
_ROUNDS: Final = 40  # of the pattern search
_PIECES_MAX: Final = 32  # for a search; the effort grows with the square
_REACH: Final = 0.4  # first relative change of a step
_REACH_MIN: Final = 0.01
_SLOWEST: Final = 2.0**40  # the largest factor tried with given velocities


def through_waypoints(
    values: Sequence[float],
    times: Sequence[float] | None = None,
    *,
    limits: DerivativeLimits | None = None,
    first: Sequence[float | None] | None = None,
    second: Sequence[float | None] | None = None,
    degree: int = _CUBIC,
    initial_argument: float = 0.0,
) -> Piecewise:
    """Return a smooth function through way-points, one polynomial per interval.

    Pieces of degree 3 have a continuous second derivative (the cubic spline), those of degree 5
    continuous third and fourth ones. Given derivatives are reproduced. At a given derivative, the
    second derivative of a cubic may jump. In a quintic the fourth may jump where the first is
    given, the third where the second is given.

    Args:
        values: at least two [U].
        times: one per value, ascending [s]; None: as short as `limits` allow. The limits are met to
            rounding, and one is reached; the division of the time among the pieces is not proven to
            be optimal.
        limits: of first, second and third derivative, without `times`; others raise an error.
        first: first derivatives at the way-points [U/s], None for a free one; by default 0 at both
            ends and free in between.
        second: second derivatives [U/s²], likewise, for degree 5.
        degree: 3 or 5.
        initial_argument: argument at the beginning, without `times`.

    Raises:
        UsageError: there are too few values, a number is not finite, times do not ascend, no
            argument determines the duration, or no times keep given derivatives within the limits.
    """
    if not isfinite(initial_argument):
        raise UsageError(f"the initial argument is {initial_argument}, not a finite number")
    points = np.asarray(values, dtype=np.float64)
    if points.ndim != 1 or len(points) < 2 or not np.isfinite(points).all():
        raise UsageError("invalid way-points; expected at least two finite numbers")
    if degree not in (_CUBIC, _QUINTIC):
        raise UsageError(f"pieces are of degree 3 or 5, not {degree}")
    if second is not None and degree == _CUBIC:
        raise UsageError("second derivatives are given to pieces of degree 5 only")
    course = _Course(
        points,
        _derivatives("first", first, points),
        _derivatives("second", second, points) if degree == _QUINTIC else None,
    )
    if times is None:
        edges = _shortest_times(course, _bounds(limits))
        coefficients = course.coefficients(np.diff(edges)[None])[0]
        edges = edges + initial_argument
    else:
        if limits is not None:
            raise _not_met("way-points with times")
        edges = _fitting("times", times, points)
        steps = np.diff(edges)
        if not (np.isfinite(edges).all() and (steps > 0.0).all()):
            raise UsageError("times must be finite numbers and ascend")
        coefficients = course.coefficients(steps[None])[0]
    return _function(edges, coefficients)


def _derivatives(name: str, given: Sequence[float | None] | None, points: FloatArray) -> FloatArray:
    """Return the derivatives at the way-points; nan for a free one."""
    if given is None:
        found = np.full(points.shape, np.nan)
        found[0] = found[-1] = 0.0
        return found
    found = _fitting(f"{name} derivatives", given, points)  # None becomes nan
    if np.isinf(found).any():
        raise UsageError(f"{name} derivatives are finite, or nan where they are free")
    return found


def _fitting(name: str, given: Sequence[float | None], points: FloatArray) -> FloatArray:
    array = np.array(given, dtype=np.float64)
    if array.shape != points.shape:
        raise UsageError(f"{name} have shape {array.shape}, way-points {points.shape}")
    return array


def _bounds(limits: DerivativeLimits | None) -> list[tuple[int, Range]]:
    """Return (order, range) of each limited derivative."""
    if limits is None:
        raise UsageError("way-points need times, or limits that determine the shortest ones")
    if not isinstance(limits, DerivativeLimits):
        raise UsageError(f"limits of way-points are DerivativeLimits, not {limits!r}")
    if limits.value is not None:
        raise _not_met("their value")
    bounds = [(k, x) for k, x in ((1, limits.first), (2, limits.second), (3, limits.third)) if x]
    if not any(isfinite(low) or isfinite(high) for _, (low, high) in bounds):
        raise UsageError("without times there must be a limit of a derivative")
    return bounds


def _not_met(what: str) -> UsageError:
    return UsageError(
        f"limits of {what} are not met by this generator; check the function with"
        " motorhil.motorapi.generation.feasible"
    )


def _function(edges: FloatArray, coefficients: FloatArray) -> Piecewise:
    """Return the pieces as a function, without those below the resolution of the argument."""
    breaks, rows = [float(edges[0])], []
    for edge, terms in zip(edges[1:].tolist(), coefficients.tolist(), strict=True):
        if edge > breaks[-1]:
            breaks.append(edge)
            rows.append(terms)
    return Piecewise.of_polynomials(breaks, rows)


# ---- pieces through the way-points ----


@final
class _Course:
    """Way-points with their derivatives, shape (m,); nan: free. Cubic without `second`."""

    def __init__(self, values: FloatArray, first: FloatArray, second: FloatArray | None) -> None:
        self.values: Final = values
        self.rise: Final = np.diff(values)
        self._first: Final = first
        self._second: Final = second
        given = first if second is None else np.concatenate([first, second])
        self.is_moving: Final = bool(np.nan_to_num(given).any())
        """True if a given derivative is not 0: the curve does not scale with the time."""

    def coefficients(self, steps: FloatArray) -> FloatArray:
        """Return the coefficients of the pieces, of the time since each began [s].

        Shapes: steps (k, m - 1), the result (k, m - 1, degree + 1), ascending powers.

        Raises:
            UsageError: free derivatives are not determined.
        """
        # In units of the mean step no power of a step is too large or too small.
        unit = steps.mean(axis=1, keepdims=True)
        h, rise, start = steps / unit, self.rise, np.broadcast_to(self.values[:-1], steps.shape)
        if self._second is None:
            v = _cubic_slopes(rise, h, self._first * unit)
            c2 = (3.0 * rise / h - 2.0 * v[:, :-1] - v[:, 1:]) / h
            c3 = (v[:, :-1] + v[:, 1:] - 2.0 * rise / h) / h**2
            rows = [start, v[:, :-1], c2, c3]
        else:
            v, a = _quintic_states(rise, h, self._first * unit, self._second * unit * unit)
            v0, v1, a0, a1 = v[:, :-1] * h, v[:, 1:] * h, a[:, :-1] * h * h, a[:, 1:] * h * h
            c3 = (20.0 * rise - (12.0 * v0 + 8.0 * v1) - (3.0 * a0 - a1)) / (2.0 * h**3)
            c4 = (-30.0 * rise + (16.0 * v0 + 14.0 * v1) + (3.0 * a0 - 2.0 * a1)) / (2.0 * h**4)
            c5 = (12.0 * rise - 6.0 * (v0 + v1) - (a0 - a1)) / (2.0 * h**5)
            rows = [start, v[:, :-1], 0.5 * a[:, :-1], c3, c4, c5]
        found = np.stack(rows, axis=-1)
        scaled: FloatArray = found / unit[:, :, None] ** np.arange(len(rows))
        return scaled


def _cubic_slopes(rise: FloatArray, h: FloatArray, first: FloatArray) -> FloatArray:
    """Return the first derivatives, with the free ones chosen."""
    count, points = first.shape
    lower, middle, upper = (np.zeros((count, points, 1, 1)) for _ in range(3))
    right = np.zeros((count, points, 1))
    inverse = 1.0 / h
    lower[:, 1:, 0, 0] = inverse
    upper[:, :-1, 0, 0] = inverse
    middle[:, 1:, 0, 0] += 2.0 * inverse
    middle[:, :-1, 0, 0] += 2.0 * inverse
    right[:, 1:, 0] += 3.0 * rise * inverse**2
    right[:, :-1, 0] += 3.0 * rise * inverse**2
    _fix(lower, middle, upper, right, first[..., None])
    return _solved(lower, middle, upper, right)[..., 0]


def _quintic_states(
    rise: FloatArray, h: FloatArray, first: FloatArray, second: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the first and second derivatives, with the free ones chosen."""
    count, points = first.shape
    lower, middle, upper = (np.zeros((count, points, 2, 2)) for _ in range(3))
    right = np.zeros((count, points, 2))
    # Row 0: the fourth derivative is continuous; row 1: the third. Of a piece, at its end:
    # p'''' = 360 D/h⁴ - 168 v0/h³ - 192 v1/h³ - 24 a0/h² + 36 a1/h²
    # p'''  = 60 D/h³ - 24 v0/h² - 36 v1/h² - 3 a0/h + 9 a1/h
    # and at its beginning:
    # p'''' = -360 D/h⁴ + 192 v0/h³ + 168 v1/h³ + 36 a0/h² - 24 a1/h²
    # p'''  = 60 D/h³ - 36 v0/h² - 24 v1/h² - 9 a0/h + 3 a1/h
    for row, terms in (
        (0, ((-168.0, 3), (-24.0, 2), (-192.0, 3), (36.0, 2), (360.0, 4))),
        (1, ((-24.0, 2), (-3.0, 1), (-36.0, 2), (9.0, 1), (60.0, 3))),
    ):
        for (block, column), (factor, power) in zip(
            ((lower, 0), (lower, 1), (middle, 0), (middle, 1)), terms[:4], strict=True
        ):
            block[:, 1:, row, column] += factor / h**power
        right[:, 1:, row] -= terms[4][0] * rise / h ** terms[4][1]
    for row, terms in (
        (0, ((192.0, 3), (36.0, 2), (168.0, 3), (-24.0, 2), (-360.0, 4))),
        (1, ((-36.0, 2), (-9.0, 1), (-24.0, 2), (3.0, 1), (60.0, 3))),
    ):
        for (block, column), (factor, power) in zip(
            ((middle, 0), (middle, 1), (upper, 0), (upper, 1)), terms[:4], strict=True
        ):
            block[:, :-1, row, column] -= factor / h**power
        right[:, :-1, row] += terms[4][0] * rise / h ** terms[4][1]
    _fix(lower, middle, upper, right, np.stack([first, second], axis=-1))
    found = _solved(lower, middle, upper, right)
    return found[..., 0], found[..., 1]


def _fix(
    lower: FloatArray, middle: FloatArray, upper: FloatArray, right: FloatArray, given: FloatArray
) -> None:
    """Replace the equations of given derivatives by their values."""
    known = ~np.isnan(given)
    for block in (lower, middle, upper):
        block[known] = 0.0
    for column in range(given.shape[-1]):
        middle[..., column, column][known[..., column]] = 1.0
    right[known] = given[known]


def _solved(
    lower: FloatArray, middle: FloatArray, upper: FloatArray, right: FloatArray
) -> FloatArray:
    """Solve k sets of block-tridiagonal equations by a forward and a backward sweep."""
    points = right.shape[1]
    found = np.empty_like(right)
    factors = np.empty_like(upper)
    try:
        for k in range(points):
            block, side = middle[:, k], right[:, k]
            if k:
                block = block - lower[:, k] @ factors[:, k - 1]
                side = side - (lower[:, k] @ found[:, k - 1, :, None])[..., 0]
            both = np.linalg.solve(block, np.concatenate([upper[:, k], side[..., None]], axis=-1))
            factors[:, k], found[:, k] = both[..., :-1], both[..., -1]
    except np.linalg.LinAlgError:
        raise UsageError(
            "the way-points do not determine the free derivatives; give one more"
        ) from None
    for k in range(points - 2, -1, -1):
        found[:, k] -= (factors[:, k] @ found[:, k + 1, :, None])[..., 0]
    return found


# ---- ranges of polynomials ----


def value_ranges(coefficients: FloatArray, lengths: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the (lowest, highest) values of polynomials over [0, length], exact to rounding.

    Shapes: coefficients (..., degree + 1), lengths and results (...).
    """
    points = _zeros(_differentiated(coefficients, 1), lengths)
    ends = np.stack([np.zeros_like(lengths), lengths], axis=-1)
    values = _at(coefficients[..., None, :], np.concatenate([ends, points], axis=-1))
    lowest: FloatArray = values.min(axis=-1)
    highest: FloatArray = values.max(axis=-1)
    return lowest, highest


def _differentiated(coefficients: FloatArray, order: int) -> FloatArray:
    """Return the coefficients of a derivative; those of 0 if the order exceeds the degree."""
    for _ in range(order):
        coefficients = coefficients[..., 1:] * np.arange(1, coefficients.shape[-1])
    return coefficients if coefficients.shape[-1] else np.zeros((*coefficients.shape[:-1], 1))


def _zeros(coefficients: FloatArray, lengths: FloatArray) -> FloatArray:
    """Return as many ascending points as the degree, which include all zeros in [0, length].

    Between two neighbouring zeros of its derivative a polynomial is monotone. It has at most one
    zero there, which is found by bisection.
    """
    degree = coefficients.shape[-1] - 1
    if degree < 1:
        return np.zeros((*lengths.shape, 0))
    turns = _zeros(_differentiated(coefficients, 1), lengths)
    ends = np.zeros((*lengths.shape, 1))
    knots = np.concatenate([ends, turns, lengths[..., None]], axis=-1)
    low, high = knots[..., :-1], knots[..., 1:]
    terms = coefficients[..., None, :]
    sign = np.sign(_at(terms, low))
    crossing = sign * np.sign(_at(terms, high)) < 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        left = np.sign(_at(terms, middle)) == sign
        low, high = np.where(left, middle, low), np.where(left, high, middle)
    return np.where(crossing, low, knots[..., :-1])


def _at(coefficients: FloatArray, points: FloatArray) -> FloatArray:
    found = np.zeros(points.shape)
    for power in range(coefficients.shape[-1] - 1, -1, -1):
        found = found * points + coefficients[..., power]
    return found


# ---- shortest times ----


def _shortest_times(course: _Course, bounds: list[tuple[int, Range]]) -> FloatArray:
    """Return the times of the way-points from 0 on, shape (m,).

    Raises:
        UsageError: all way-points are equal, or no times keep given derivatives within the limits.
    """
    rise = np.abs(course.rise)
    if not rise.any():
        raise UsageError("way-points that are all the same take no time; give times")
    steps: FloatArray = np.zeros(rise.shape)
    for order, (low, high) in bounds:
        steps = np.maximum(steps, (rise / min(-low, high)) ** (1.0 / order))
    steps = np.maximum(steps, 0.05 * steps.mean())
    steps = _nearly_scaled(course, steps[None], bounds)[0]
    if len(steps) <= _PIECES_MAX:
        steps = _searched(course, steps, bounds)
    steps = _scaled(course, steps, bounds)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _searched(course: _Course, steps: FloatArray, bounds: list[tuple[int, Range]]) -> FloatArray:
    """Return the steps, with each lengthened or shortened as long as this shortens the total."""
    changes = np.concatenate([np.eye(len(steps)), -np.eye(len(steps))])
    reach, shortest_s = _REACH, steps.sum()
    for _ in range(_ROUNDS):
        tried = _nearly_scaled(course, steps * np.exp(reach * changes), bounds)
        totals_s = tried.sum(axis=1)
        best = totals_s.argmin()
        if totals_s[best] < shortest_s * (1.0 - 1e-6):
            steps, shortest_s = tried[best], totals_s[best]
        else:
            reach *= _REACH
            if reach < _REACH_MIN:
                break
    return steps


def _nearly_scaled(
    course: _Course, steps: FloatArray, bounds: list[tuple[int, Range]]
) -> FloatArray:
    """Return k sets of steps, each scaled so that the limits are met, or nearly."""
    for _ in range(4 if course.is_moving else 1):
        steps = steps * _used(course, steps, bounds)[:, None]
    return steps


def _scaled(course: _Course, steps: FloatArray, bounds: list[tuple[int, Range]]) -> FloatArray:
    """Return the steps, scaled by one factor so that the limits are just met."""

    def used(factor: float) -> float:
        return float(_used(course, (steps * factor)[None], bounds)[0])

    if not course.is_moving:
        return steps * used(1.0) * (1.0 + 1e-15)
    high = 1.0
    while used(high) > 1.0:
        high *= 2.0
        if high > _SLOWEST:
            raise UsageError("no times keep the derivatives that are given within the limits")
    low = 0.5 * high
    for _ in range(60):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if used(middle) <= 1.0 else (middle, high)
    return steps * high


def _used(course: _Course, steps: FloatArray, bounds: list[tuple[int, Range]]) -> FloatArray:
    """Return the factor by which the limits require each set to be slower (< 1: faster), (k,)."""
    coefficients = course.coefficients(steps)
    used = np.zeros(len(steps))
    for order, (low, high) in bounds:
        lowest, highest = value_ranges(_differentiated(coefficients, order), steps)
        most = np.maximum(np.maximum(lowest / low, highest / high).max(axis=1), 0.0)
        used = np.maximum(used, most ** (1.0 / order))
    return used
