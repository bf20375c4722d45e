"""The polynomials of a piecewise function as one table, for whole arrays of arguments.

Column i of the table holds piece i: where it is about, and its coefficients, the missing high ones
0. Arguments are taken in blocks that stay in a core's cache: which piece, what local argument, and
Horner's scheme in place; the same operations in the same order as for one number.

Which piece: in a block in ascending order, as a sampled course has it, the few breaks are looked up
among the arguments. In any other, the domain is cut into equal cells, and a guide tells how many
breaks lie in the cells before an argument's; what lies in its own cell is compared. Cells are found
by operations that never turn two arguments round, so this is exact. Where breaks crowd too much
for that, they are searched.
"""

from collections.abc import Sequence
from math import isfinite
from typing import Final, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from motorapi.functions.function import FloatArray

Pieces: TypeAlias = NDArray[np.intp]
Runs: TypeAlias = tuple[int, int, Pieces]  # the first piece, after the last, arguments in each

_BLOCK: Final = 32768
_CELLS: Final = 4  # for each piece, but no more than
_CELLS_MAX: Final = 1 << 20
_CROWD: Final = 4  # breaks in a cell


@final
class PieceTable:
    """Evaluates many polynomials, each over its own piece.

    Args:
        breaks: ascending, one more than there are pieces.
        abouts: where each piece's local argument is 0.
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
        """The values at a flat array of arguments, all in the domain; a new array."""
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
    """Tells which piece arguments are in.

    Args:
        breaks: ascending, one more than there are pieces.
    """

    __slots__ = ("_cells", "_crowd", "_guide", "_inner", "_lowest", "_next")

    def __init__(self, breaks: Sequence[float]) -> None:
        self._inner = np.array(breaks[1:-1], dtype=np.float64)
        self._next = np.append(self._inner, np.inf)  # what an argument may be beyond, by piece
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
        """Of arguments in ascending order, at least one, the pieces; None: in any other order."""
        if not (arguments[0] <= arguments[-1] and (arguments[1:] >= arguments[:-1]).all()):
            return None
        first, last = self._inner.searchsorted(arguments[[0, -1]], side="right").tolist()
        ends = arguments.searchsorted(self._inner[first:last])
        return first, last + 1, np.diff(ends, prepend=0, append=len(arguments))

    def pieces_of(self, arguments: FloatArray) -> Pieces:
        """The number of the piece of each argument; at a break, of the one that begins there."""
        if self._crowd > _CROWD:
            return self._inner.searchsorted(arguments, side="right")
        piece = self._guide.take(self._cell(arguments), mode="clip")
        for _ in range(self._crowd):
            piece += arguments >= self._next.take(piece, mode="clip")
        return piece
