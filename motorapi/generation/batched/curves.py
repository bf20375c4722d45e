"""Many piecewise polynomials with as many pieces each, evaluated at once."""

from typing import TYPE_CHECKING, Final, final

import numpy as np
from numpy.typing import ArrayLike

from motorapi.generation.batched.limits import FloatArray

if TYPE_CHECKING:
    from motorapi.functions.piecewise import Piecewise

_HALVINGS: Final = 36
"""Of a bracket of a zero: an extremum there is known to the square of what is left."""


@final
class Curves:
    """n functions of one argument, each of m pieces; their arrays are not to be written to.

    Attributes:
        breaks: shape (n, m + 1), where the pieces meet; pieces may be of no length.
        coefficients: shape (n, m, degree + 1), ascending, of the argument since each piece began.
    """

    __slots__ = ("breaks", "coefficients")

    def __init__(self, breaks: FloatArray, coefficients: FloatArray) -> None:
        self.breaks = breaks
        self.coefficients = coefficients

    def __len__(self) -> int:
        return len(self.breaks)

    def __repr__(self) -> str:
        count, pieces, terms = self.coefficients.shape
        return f"<{count} functions of {pieces} polynomials of degree {terms - 1}>"

    @property
    def duration_s(self) -> FloatArray:
        """How long each takes, shape (n,)."""
        return self.breaks[:, -1] - self.breaks[:, 0]

    def value(self, argument: ArrayLike, order: int = 0) -> FloatArray:
        """The values, or derivatives of some order; outside, those of the nearer end.

        Args:
            argument: shape (n,) or (n, m), or one number for all.
            order: of the derivative, >= 0.
        """
        points = np.asarray(argument, dtype=np.float64)
        rows = np.arange(len(self))[:, None] if points.ndim == 2 else np.arange(len(self))
        points = np.clip(
            np.broadcast_to(points, np.broadcast_shapes(points.shape, rows.shape)),
            self.breaks[:, 0][rows],
            self.breaks[:, -1][rows],
        )
        piece = np.zeros(points.shape, dtype=np.intp)
        for edge in self.breaks.T[1:-1]:
            piece += points >= edge[rows]
        local = points - self.breaks[rows, piece]
        terms = differentiated(self.coefficients, order)[rows, piece]
        found = np.zeros(points.shape)
        for power in range(terms.shape[-1] - 1, -1, -1):
            found = found * local + terms[..., power]
        return found

    def function(self, index: int) -> "Piecewise":
        """One of them as a function of `motorapi.functions`."""
        from motorapi.functions.piecewise import Piecewise

        edges, rows = [float(self.breaks[index, 0])], []
        for piece, edge in enumerate(self.breaks[index, 1:]):
            if edge > edges[-1]:
                edges.append(float(edge))
                rows.append([float(term) for term in self.coefficients[index, piece]])
        return Piecewise.of_polynomials(edges, rows)


def differentiated(coefficients: FloatArray, order: int) -> FloatArray:
    """The coefficients of a derivative; those of 0 if the order exceeds the degree."""
    for _ in range(order):
        powers = np.arange(1, coefficients.shape[-1])
        coefficients = coefficients[..., 1:] * powers
    return coefficients if coefficients.shape[-1] else np.zeros((*coefficients.shape[:-1], 1))


def ranges(coefficients: FloatArray, lengths: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(lowest, highest) values of polynomials over [0, length]; exact to rounding.

    Shapes: coefficients (..., degree + 1), lengths (...) and so are the answers.
    """
    points = _zeros(differentiated(coefficients, 1), lengths)
    ends = np.stack([np.zeros_like(lengths), lengths], axis=-1)
    points = np.concatenate([ends, points], axis=-1)
    values = _at(coefficients[..., None, :], points)
    lowest: FloatArray = values.min(axis=-1)
    highest: FloatArray = values.max(axis=-1)
    return lowest, highest


def _zeros(coefficients: FloatArray, lengths: FloatArray) -> FloatArray:
    """As many points as the degree, ascending, all zeros in [0, length] among them.

    Between two neighbouring zeros of its derivative a polynomial is monotone and has at most one
    zero, which is halved in on.
    """
    degree = coefficients.shape[-1] - 1
    if degree < 1:
        return np.zeros((*lengths.shape, 0))
    turns = _zeros(differentiated(coefficients, 1), lengths)
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
