"""Piecewise functions: pieces side by side form one function."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from math import inf, isfinite, nextafter
from typing import Final, final

import numpy as np

from motorhil.motorapi.commands import as_number
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.functions.base import (
    LARGEST,
    Extrema,
    FloatArray,
    Function,
    finite,
    operations,
)
from motorhil.motorapi.functions.piece_table import PieceFinder, PieceTable
from motorhil.motorapi.functions.polynomial import Horner, Polynomial, polynomial
from motorhil.motorapi.functions.polynomial_math import Exact, nearest

_SHOWN: Final = 4  # pieces in a repr


@final
class Piecewise(Function):
    """`pieces[i]` from `breaks[i]` up to `breaks[i + 1]`, where the next one begins.

    The last piece also holds at the last break. A piece is called with the unchanged argument. To
    avoid cancellation, expand polynomials about their own left break, as `of_polynomials` does.
    Pieces that are piecewise themselves are flattened.

    Args:
        breaks: strictly ascending, one more than pieces; the first may be -inf, the last inf.
        pieces: at least one; the domain of each contains its whole interval.

    Raises:
        UsageError: an argument violates these conditions.
    """

    __slots__ = ("_derived", "_high", "_inner", "_low", "_rows", "_table", "breaks", "pieces")

    breaks: tuple[float, ...]
    pieces: tuple[Function, ...]
    _low: float
    _high: float
    _inner: tuple[float, ...]
    _rows: tuple[Horner, ...]  # () unless all pieces are polynomials
    _table: PieceTable | None  # created on first use
    _derived: dict[int, Function]  # derivatives by order, created on first use

    def __init__(self, breaks: Iterable[float], pieces: Iterable[Function]) -> None:
        try:
            told, parts = tuple(map(as_number, breaks)), tuple(pieces)
        except TypeError as error:
            raise UsageError(
                "Piecewise: breaks or pieces is not a sequence; give two sequences"
            ) from error
        _check(told, parts)
        edges, flat = _taken_apart(told, parts)
        rows = tuple(p.horner for p in flat if isinstance(p, Polynomial))
        self._keep(
            breaks=edges,
            pieces=flat,
            _low=max(edges[0], -LARGEST),
            _high=min(edges[-1], LARGEST),
            _inner=edges[1:-1],
            _rows=rows if len(rows) == len(flat) else (),
            _table=None,
            _derived={},
        )

    @classmethod
    def of_polynomials(
        cls, breaks: Sequence[float], coefficients: Iterable[Iterable[float]]
    ) -> "Piecewise":
        """Return polynomials in local arguments: `coefficients[i]`, ascending, in x - breaks[i]."""
        try:
            edges, rows = tuple(breaks), list(coefficients)
        except TypeError as error:
            raise UsageError(
                "Piecewise: breaks or coefficients is not a sequence; give two sequences"
            ) from error
        if len(edges) != len(rows) + 1:
            raise UsageError(
                f"Piecewise: {len(rows)} pieces need {len(rows) + 1} breaks, not {len(edges)}"
            )
        return cls(edges, [Polynomial(c, b) for b, c in zip(edges[:-1], rows, strict=True)])

    @classmethod
    def joined(cls, first: Function, *others: Function) -> "Piecewise":
        """Return the functions in sequence, each shifted to begin where the one before ends.

        Raises:
            UsageError: a function is unbounded on a side that has a neighbour.
        """
        edges, pieces = [first.domain[0]], [first]
        for one in others:
            end, begin = pieces[-1].domain[1], one.domain[0]
            if not (isfinite(end) and isfinite(begin)):
                raise UsageError(
                    "Piecewise: cannot join a function with an unbounded domain; restrict it first"
                )
            edges.append(end)
            pieces.append(one.shifted(end - begin))
        return cls([*edges, pieces[-1].domain[1]], pieces)

    @property
    def domain(self) -> tuple[float, float]:
        """The interval from the first break to the last."""
        return self.breaks[0], self.breaks[-1]

    def value(self, argument: float) -> float:
        """Return the value of the piece there; at a break, of the one that begins there."""
        if not self._low <= argument <= self._high:
            self._refuse(argument)
        piece = bisect_right(self._inner, argument)
        if not self._rows:
            return self.pieces[piece].value(argument)
        about, value, rest = self._rows[piece]
        local = argument - about
        for coefficient in rest:
            value = value * local + coefficient
        return value

    def _values(self, arguments: FloatArray) -> FloatArray:
        if self._rows:
            return self._as_table().values(arguments)
        result = np.empty_like(arguments)
        number = PieceFinder(self.breaks).pieces_of(arguments)
        order = np.argsort(number, kind="stable")
        ends = np.searchsorted(number[order], np.arange(len(self.pieces) + 1))
        for i in np.flatnonzero(np.diff(ends)):
            chosen = order[ends[i] : ends[i + 1]]
            result[chosen] = self.pieces[i](arguments[chosen])
        return result

    def _as_table(self) -> PieceTable:
        if self._table is None:
            coefficients = [p.coefficients for p in self.pieces if isinstance(p, Polynomial)]
            table = PieceTable(self.breaks, [row[0] for row in self._rows], coefficients)
            self._keep(_table=table)
            return table
        return self._table

    def _derivative(self, order: int) -> Function:
        found = self._derived.get(order)  # a start asks for the same ones several times
        if found is None:
            found = Piecewise(self.breaks, [piece.derivative(order) for piece in self.pieces])
            self._derived[order] = found
        return found

    def integral(self) -> Function:
        """Return the continuous integral, with polynomial pieces about their left breaks."""
        sums = self._sums()
        pieces = list[Function]()
        for i, piece in enumerate(self.pieces):
            anchor = self._anchor(i)
            if isinstance(piece, Polynomial):
                raised = piece.exact(anchor).integral().plus(Exact.of([sums[i]]))
                pieces.append(polynomial(raised.rounded(), anchor))
            else:
                whole = piece.integral()
                pieces.append(whole + nearest(sums[i] - Fraction(whole.value(anchor))))
        return Piecewise(self.breaks, pieces)

    def _anchor(self, piece: int) -> float:
        """Return the argument at which a piece's integral is known: its left end, if finite."""
        left, right = self.breaks[piece], self.breaks[piece + 1]
        if isfinite(left):
            return left
        return right if isfinite(right) else 0.0

    def _sums(self) -> list[Fraction]:
        """Return the integral up to the anchor of each piece."""
        origin = self._origin()
        sums = [-_exact(self, self._anchor(0), origin)]
        for i in range(1, len(self.pieces)):
            sums.append(sums[-1] + _exact(self.pieces[i - 1], self._anchor(i - 1), self.breaks[i]))
        return sums

    def _integrate(self, low: float, high: float) -> float:
        return nearest(_exact(self, low, high))

    @property
    def is_polynomial(self) -> bool:
        """True if all pieces are polynomials."""
        return bool(self._rows)

    def exact_integral(self, low: float, high: float) -> Fraction:
        """Return the definite integral, `low` <= `high`, rounded only in non-polynomial pieces."""
        return sum(
            (_exact(piece, left, right) for piece, left, right in self.within(low, high)),
            Fraction(0),
        )

    def within(self, low: float, high: float) -> Iterator[tuple[Function, float, float]]:
        """Yield the pieces that intersect [low, high], each with its part of the interval."""
        for i in range(bisect_right(self._inner, low), bisect_left(self._inner, high) + 1):
            yield self.pieces[i], max(self.breaks[i], low), min(self.breaks[i + 1], high)

    def _extrema(self, low: float, high: float) -> Extrema:
        parts = [
            (piece, left, right if right == high else nextafter(right, -inf))
            for piece, left, right in self.within(low, high)
        ]
        if bisect_right(self._inner, high) > bisect_left(
            self._inner, high
        ):  # the value at the break counts
            parts[-1] = (*parts[-1][:2], nextafter(high, -inf))
            parts.append((self.pieces[bisect_right(self._inner, high)], high, high))
        ends = [(piece.value(x), x) for piece, *both in parts for x in both]
        least = min(ends)
        most = max(ends, key=lambda end: (end[0], -end[1]))
        for piece, left, right in parts:
            if isinstance(piece, Polynomial) and piece.degree < 2:
                continue  # its extrema are at its ends
            lowest, highest = piece.bounds(left, right)
            if left < right and (lowest < least[0] or highest > most[0]):
                found = piece.extrema(left, right)
                least = min(least, (found.minimum, found.at_minimum))
                if found.maximum > most[0]:
                    most = (found.maximum, found.at_maximum)
        return Extrema(*least, *most)

    def _bounds(self, low: float, high: float) -> tuple[float, float]:
        parts = [piece.bounds(left, right) for piece, left, right in self.within(low, high)]
        end = self.pieces[bisect_right(self._inner, high)].value(high)
        return min(end, *(p[0] for p in parts)), max(end, *(p[1] for p in parts))

    def breaks_between(self, low: float, high: float) -> tuple[float, ...]:
        """Return its own breaks and those of its pieces."""
        found = list(self._inner[bisect_right(self._inner, low) : bisect_left(self._inner, high)])
        for piece, left, right in self.within(low, high):
            found.extend(piece.breaks_between(left, right))
        return tuple(sorted(found))

    def is_smooth(self, low: float, high: float) -> bool:
        """Return True if the interval lies in one piece that is smooth there."""
        first, last = bisect_right(self._inner, low), bisect_right(self._inner, high)
        return first == last and self.pieces[first].is_smooth(low, high)

    def _parameters(self) -> tuple[object, ...]:
        return self.breaks, self.pieces

    def times(self, number: float) -> Function:
        """Return the function with every piece multiplied by `number`."""
        return Piecewise(self.breaks, [piece.times(number) for piece in self.pieces])

    def shifted(self, offset: float) -> Function:
        """Return the function with every piece shifted."""
        way = finite("Piecewise", "offset", offset)
        return Piecewise([b + way for b in self.breaks], [p.shifted(way) for p in self.pieces])

    def scaled(self, factor: float) -> Function:
        """Return the function with every piece scaled; a negative factor reverses the order."""
        number = finite("Piecewise", "factor", factor)
        if number == 0.0:
            raise UsageError("Piecewise: the argument cannot be scaled by 0")
        breaks = [b * number for b in self.breaks]
        pieces = [p.scaled(number) for p in self.pieces]
        return Piecewise(breaks, pieces) if number > 0 else Piecewise(breaks[::-1], pieces[::-1])

    def __repr__(self) -> str:
        if len(self.pieces) <= _SHOWN:
            return f"Piecewise({self.breaks!r}, {self.pieces!r})"
        low, high = self.domain
        what = "functions"
        if self._rows:
            what = f"polynomials of degree <= {max(len(row[2]) for row in self._rows)}"
        return f"<Piecewise: {len(self.pieces)} {what}, {low!r} to {high!r}>"


def _check(breaks: Sequence[float], pieces: Sequence[object]) -> None:
    if not pieces or len(breaks) != len(pieces) + 1:
        raise UsageError(
            f"Piecewise: {len(pieces)} pieces with {len(breaks)} breaks; there is one break more"
            " than pieces, and at least one piece"
        )
    for i, piece in enumerate(pieces):
        left, right = breaks[i], breaks[i + 1]
        if not left < right:
            raise UsageError(
                f"Piecewise: break {i + 1} is {right!r}, not above break {i}, {left!r}"
            )
        if not isinstance(piece, Function):
            raise UsageError(f"Piecewise: piece {i} is {piece!r}, not a function")
        low, high = piece.domain
        if not (low <= left and right <= high):
            raise UsageError(
                f"Piecewise: piece {i} is for {left!r} to {right!r}, but the domain of "
                f"{piece!r} is {low!r} to {high!r} only"
            )


def _taken_apart(
    breaks: Sequence[float], pieces: Sequence[Function]
) -> tuple[tuple[float, ...], tuple[Function, ...]]:
    """Return the same breaks and pieces with piecewise pieces flattened."""
    edges, flat = [breaks[0] + 0.0], list[Function]()
    for i, piece in enumerate(pieces):
        if isinstance(piece, Piecewise):
            for inner, _, right in piece.within(breaks[i], breaks[i + 1]):
                flat.append(inner)
                edges.append(right)
        else:
            flat.append(piece)
            edges.append(breaks[i + 1] + 0.0)
    return tuple(edges), tuple(flat)


def _exact(function: Function, low: float, high: float) -> Fraction:
    """Return the integral, unrounded for (piecewise) polynomials."""
    if low > high:
        return -_exact(function, high, low)
    if isinstance(function, Piecewise | Polynomial):
        return function.exact_integral(low, high)
    return Fraction(function.integrate(low, high))


def _restricted(function: Function, low: float, high: float) -> Piecewise:
    return Piecewise((low, high), (function,))


operations.restrict = _restricted
