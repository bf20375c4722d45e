"""The polynomials of a piecewise function as a table, for arrays of arguments.

Column i of the table holds piece i: its expansion point and its coefficients, with zeros for
missing high powers. Arguments are processed in blocks that fit into a core's cache: find the piece,
compute the local argument, apply Horner's scheme in place. The operations and their order are the
same as for one number.

To find the piece in a block of ascending arguments, as in a sampled profile, the few breaks are
looked up among the arguments. For any other block, the domain is divided into equal cells. A guide
table gives the number of breaks in the cells before that of the argument; the breaks in its own
cell are compared. Cell numbers come from operations that never reverse the order of two arguments,
so the result is exact. If breaks are too dense for that, they are searched by bisection.
"""

from collections.abc import Sequence
from math import isfinite
from typing import Final, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from motorhil.motorapi.functions.base import FloatArray

Pieces: TypeAlias = NDArray[np.intp]
Runs: TypeAlias = tuple[
    int, int, Pieces
]  # first piece, piece after the last one, number of arguments in each

_BLOCK: Final = 32768
_CELLS: Final = 4  # per piece, up to the maximum
_CELLS_MAX: Final = 1 << 20
_CROWD: Final = 4  # breaks in a cell


@final
class PieceTable:
    """Evaluator of many polynomials, each over its own piece.

    Args:
        breaks: ascending, one more than pieces.
        abouts: expansion point of each piece.
        coefficients: of each piece, ascending.
    """

    __slots__ = ("_abouts", "_finder", "_rows")

    def __init__(
        self,
        breaks: Sequence[float],
        abouts: Sequence[float],
        coefficients: Sequence[Sequence[float]],
    ) -> None:
        self._finder = PieceFinder(breaks)
        self._abouts = np.array(abouts, dtype=np.float64)
        length = max(len(row) for row in coefficients)
        self._rows = np.zeros((length, len(coefficients)))  # the highest power first
        for i, row in enumerate(coefficients):
            self._rows[length - len(row) :, i] = row[::-1]

    def values(self, arguments: FloatArray) -> FloatArray:
        """Return the values at a flat array of arguments in the domain, as a new array."""
        result = np.empty_like(arguments)
        for start in range(0, len(arguments), _BLOCK):
            block = arguments[start : start + _BLOCK]
            value = result[start : start + _BLOCK]
            runs = self._finder.runs_of(block)
            if runs is None:
                self._by_pieces(block, self._finder.pieces_of(block), value)
            else:
                self._by_runs(block, runs, value)
        return result

    def _by_pieces(self, block: FloatArray, piece: Pieces, value: FloatArray) -> None:
        np.take(self._rows[0], piece, out=value, mode="clip")
        if len(self._rows) > 1:
            local = self._abouts.take(piece, mode="clip")
            np.subtract(block, local, out=local)
            taken = np.empty_like(local)
            for row in self._rows[1:]:
                np.take(row, piece, out=taken, mode="clip")
                np.multiply(value, local, out=value)
                np.add(value, taken, out=value)

    def _by_runs(self, block: FloatArray, runs: Runs, value: FloatArray) -> None:
        first, end, counts = runs
        value[:] = np.repeat(self._rows[0, first:end], counts)
        if len(self._rows) > 1:
            local = np.repeat(self._abouts[first:end], counts)
            np.subtract(block, local, out=local)
            for row in self._rows[1:]:
                np.multiply(value, local, out=value)
                np.add(value, np.repeat(row[first:end], counts), out=value)


@final
class PieceFinder:
    """Finder of the piece of an argument.

    Args:
        breaks: ascending, one more than pieces.
    """

    __slots__ = ("_cells", "_crowd", "_guide", "_inner", "_lowest", "_next")

    def __init__(self, breaks: Sequence[float]) -> None:
        self._inner = np.array(breaks[1:-1], dtype=np.float64)
        self._next = np.append(self._inner, np.inf)  # upper break of each piece
        self._lowest, self._cells, self._crowd = breaks[0], 0.0, _CROWD + 1
        self._guide = np.zeros(1, dtype=np.intp)
        count = min(_CELLS * (len(breaks) - 1), _CELLS_MAX)
        if len(breaks) > 2 and isfinite(breaks[0]) and isfinite(breaks[-1]):
            self._cells = count / (breaks[-1] - breaks[0])
            if 0.0 < self._cells < np.inf:
                self._guide = np.zeros(int(self._cell(np.array(breaks[-1:]))[0]) + 1, dtype=np.intp)
                held = np.bincount(self._cell(self._inner), minlength=len(self._guide))
                self._guide[1:] = np.cumsum(held)[:-1]
                self._crowd = int(held.max())

    def _cell(self, arguments: FloatArray) -> Pieces:
        ways = arguments - self._lowest
        ways *= self._cells
        return ways.astype(np.intp)

    def runs_of(self, arguments: FloatArray) -> Runs | None:
        """Return the pieces of ascending arguments, at least one; None for any other order."""
        if not (arguments[0] <= arguments[-1] and (arguments[1:] >= arguments[:-1]).all()):
            return None
        first, last = self._inner.searchsorted(arguments[[0, -1]], side="right").tolist()
        ends = arguments.searchsorted(self._inner[first:last])
        return first, last + 1, np.diff(ends, prepend=0, append=len(arguments))

    def pieces_of(self, arguments: FloatArray) -> Pieces:
        """Return the piece index of each argument; at a break, of the one that begins there."""
        if self._crowd > _CROWD:
            return self._inner.searchsorted(arguments, side="right")
        piece = self._guide.take(self._cell(arguments), mode="clip")
        for _ in range(self._crowd):
            piece += arguments >= self._next.take(piece, mode="clip")
        return piece
