"""The polynomials of a piecewise function as one table, for whole arrays of arguments.

Column i holds piece i: where it is about, and its coefficients, the missing high ones 0. The
arguments are taken in blocks that stay in a core's cache: which piece, what local argument, and
Horner's scheme in place. Arguments in ascending order, as a sampled course has them, need no
search at all: it is the few breaks that are looked up among them.
"""

from collections.abc import Sequence
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from motorapi.functions.function import FloatArray

_BLOCK: Final = 8192


@final
class PieceTable:
    """Evaluates many polynomials, each over its own piece.

    Args:
        inner: the breaks between the pieces, ascending; one less than there are pieces.
        abouts: where each piece's local argument is 0.
        coefficients: of each piece, ascending.
    """

    __slots__ = ("_abouts", "_inner", "_rows")

    def __init__(
        self,
        inner: Sequence[float],
        abouts: Sequence[float],
        coefficients: Sequence[Sequence[float]],
    ) -> None:
        self._inner = np.array(inner, dtype=np.float64)
        self._abouts = np.array(abouts, dtype=np.float64)
        length = max(len(row) for row in coefficients)
        self._rows = np.zeros((length, len(coefficients)))  # the highest power first
        for i, row in enumerate(coefficients):
            self._rows[length - len(row) :, i] = row[::-1]

    def values(self, arguments: FloatArray) -> FloatArray:
        """The values at a flat array of arguments; a new array."""
        result = np.empty_like(arguments)
        local, taken = np.empty(_BLOCK), np.empty(_BLOCK)
        for start in range(0, len(arguments), _BLOCK):
            block = arguments[start : start + _BLOCK]
            size = len(block)
            piece = pieces_of(self._inner, block)
            t, c, out = local[:size], taken[:size], result[start : start + size]
            np.take(self._abouts, piece, out=t, mode="clip")
            np.subtract(block, t, out=t)
            np.take(self._rows[0], piece, out=out, mode="clip")
            for row in self._rows[1:]:
                np.take(row, piece, out=c, mode="clip")
                np.multiply(out, t, out=out)
                np.add(out, c, out=out)
        return result


def pieces_of(inner: FloatArray, arguments: FloatArray) -> NDArray[np.intp]:
    """The number of the piece of each argument."""
    return np.searchsorted(inner, arguments, side="right")
