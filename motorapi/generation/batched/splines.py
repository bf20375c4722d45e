"""Polynomials through way-points, many sets of them at once.

A piece between two way-points is given by the states at both: value and first derivative make it
cubic, the second derivative too makes it quintic. What is not given is chosen so that as many
derivatives as possible go through without a step: the second for cubics (the classical spline); for
quintics the fourth where the first is free, the third where the second is. These are the conditions
for the least integral of the squared second or third derivative. Each is a linear equation that
holds the numbers of the neighbours only; all are solved in one sweep there and back.

Source: Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), 4.4
and 4.5 (cubic splines), 2.1.5 and 4.6 (polynomials of degree 5).
"""

from typing import Final

import numpy as np

from motorapi.errors import UsageError
from motorapi.generation.batched.limits import FloatArray

CUBIC: Final = 3
QUINTIC: Final = 5


def coefficients_of(
    values: FloatArray, times: FloatArray, first: FloatArray, second: FloatArray | None
) -> FloatArray:
    """The coefficients of the pieces, of the time since each began: shape (n, m - 1, degree + 1).

    Args:
        values: shape (n, m), what is gone through [U].
        times: shape (n, m), ascending [s].
        first: shape (n, m), first derivatives [U/s]; nan where they are free.
        second: likewise second ones [U/s²], for quintic pieces; None: cubic ones.
    """
    steps = np.diff(times)
    # In units of the mean step no power of a step is too large or too small.
    unit = steps.mean(axis=1, keepdims=True)
    h = steps / unit
    rise = np.diff(values)
    if second is None:
        v = _cubic_slopes(rise, h, first * unit)
        c2 = (3.0 * rise / h - 2.0 * v[:, :-1] - v[:, 1:]) / h
        c3 = (v[:, :-1] + v[:, 1:] - 2.0 * rise / h) / h**2
        rows = [values[:, :-1], v[:, :-1], c2, c3]
    else:
        v, a = _quintic_states(rise, h, first * unit, second * unit * unit)
        v0, v1, a0, a1 = v[:, :-1] * h, v[:, 1:] * h, a[:, :-1] * h * h, a[:, 1:] * h * h
        c3 = (20.0 * rise - (12.0 * v0 + 8.0 * v1) - (3.0 * a0 - a1)) / (2.0 * h**3)
        c4 = (-30.0 * rise + (16.0 * v0 + 14.0 * v1) + (3.0 * a0 - 2.0 * a1)) / (2.0 * h**4)
        c5 = (12.0 * rise - 6.0 * (v0 + v1) - (a0 - a1)) / (2.0 * h**5)
        rows = [values[:, :-1], v[:, :-1], 0.5 * a[:, :-1], c3, c4, c5]
    made = np.stack(rows, axis=-1)
    scaled: FloatArray = made / unit[:, :, None] ** np.arange(len(rows))
    return scaled


def _cubic_slopes(rise: FloatArray, h: FloatArray, first: FloatArray) -> FloatArray:
    """The first derivatives, with those that are free chosen."""
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
    """First and second derivatives, with those that are free chosen."""
    count, points = first.shape
    lower, middle, upper = (np.zeros((count, points, 2, 2)) for _ in range(3))
    right = np.zeros((count, points, 2))
    # Row 0: the fourth derivative goes through; row 1: the third. Of a piece, at its end:
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
    made = _solved(lower, middle, upper, right)
    return made[..., 0], made[..., 1]


def _fix(
    lower: FloatArray, middle: FloatArray, upper: FloatArray, right: FloatArray, given: FloatArray
) -> None:
    """Equations of numbers that are given say just that."""
    known = ~np.isnan(given)
    for block in (lower, middle, upper):
        block[known] = 0.0
    for column in range(given.shape[-1]):
        middle[..., column, column][known[..., column]] = 1.0
    right[known] = given[known]


def _solved(
    lower: FloatArray, middle: FloatArray, upper: FloatArray, right: FloatArray
) -> FloatArray:
    """The solution of block-tridiagonal equations, n of them at once: there and back."""
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
            "the way-points do not determine the derivatives that are free: give one more"
        ) from None
    for k in range(points - 2, -1, -1):
        found[:, k] -= (factors[:, k] @ found[:, k + 1, :, None])[..., 0]
    return found
